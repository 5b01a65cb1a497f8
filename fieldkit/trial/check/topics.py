"""Check that each recorded topic is alive at its rate: a short recording by the robot's own recorder."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import PublishedTopic
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import RepeatId, Role
from fieldkit.measure.evidence import bag
from fieldkit.measure.evidence.bag import Bag
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.command import printable
from fieldkit.remote.shell import Shell
from fieldkit.steps.kinds.record import RecordStep
from fieldkit.steps.scene import Scene
from fieldkit.steps.variants import Variants
from fieldkit.trial.check.report import Report
from fieldkit.trial.check.system import judge_battery
from fieldkit.trial.plan import Plan

RECORD_S: Final = 2.0
LONGEST_S: Final = 20.0
MESSAGES: Final = 2
"""A slow topic is recorded until so many messages are due, for `LONGEST_S` at most."""
TOLERANCE: Final = 0.5
"""Share of its rate by which a topic may be off."""

# One that is ended from outside spends its time on its start too: on a small computer ros2 takes 3 s to load.
_START_S: Final = 4.0
# A recorder waits for a master that is not there; where only the battery is asked for, no longer than this.
_PATIENCE_S: Final = 6.0
_END_BYTES: Final = 4096
_BATTERY: Final = "sensor_msgs/BatteryState"


def look(plan: Plan, role: Role, shell: Shell, variants: Variants, report: Report) -> None:
    """Record for a moment; add whether each topic that the procedure records is alive, and how full the battery is.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The recorder did not start.
    """
    robot = plan.cast[role]
    wanted, battery = recorded(plan, role), "" if has_shared_battery(plan, role) else battery_of(robot)
    topics = tuple(dict.fromkeys((*wanted, *((battery,) if battery else ()))))
    if not topics:
        return
    step = recording(role, robot, topics)
    scene = plan.scene(RepeatId(plan.protocols[0], 1), jobs.work_folder(plan.trial, "check"), {role: variants})
    with tempfile.TemporaryDirectory() as into:
        try:
            path, found = _record(scene, step, shell, Path(into), patient=bool(wanted))
        except EvidenceError as error:
            judge(robot, wanted, None, report, why=error.what)
            return
        finally:
            evidence.discard(shell, plan.trial)
        judge(robot, wanted, found, report)
        _look_at_battery(path, battery, report)


def _look_at_battery(path: Path, topic: str, report: Report) -> None:
    try:
        share = bag.battery_share(path, topic)
    except EvidenceError as error:
        report.ok("battery", f"not known: {error.what}")
        return
    if share is not None:
        judge_battery(topic, 100 * share, report)


def recorded(plan: Plan, role: Role) -> tuple[str, ...]:
    """Return the topics that the procedure wants alive on the robot in `role`."""
    topics = (topic for placed in plan.procedure.walk() for topic in placed.step.live_topics(role))
    return tuple(dict.fromkeys(topics))


def _topics(robot: Robot) -> tuple[PublishedTopic, ...]:
    return robot.profile.ros.topics if robot.profile.ros else ()


def battery_of(robot: Robot) -> str:
    """Return the topic on which the robot tells its battery; empty if its profile has none."""
    return next((topic.name for topic in _topics(robot) if topic.type == _BATTERY), "")


def has_shared_battery(plan: Plan, role: Role) -> bool:
    """Return whether nobody knows whose battery a robot's topic tells of: another on its ROS master has the same."""
    robot = plan.cast[role]
    others = (other for one, other in plan.cast.items() if one is not role and other.ros_master)
    return any(
        other.ros_master == robot.ros_master and battery_of(other) == battery_of(robot) != "" for other in others
    )


def rate_of(robot: Robot, topic: str) -> float | None:
    """Return the rate in Hz that the robot's profile gives for a topic, None if it names no such topic."""
    return next((one.rate for one in _topics(robot) if one.name == topic), None)


def recording(role: Role, robot: Robot, topics: Sequence[str]) -> RecordStep:
    """Return a recording that is just long enough for every topic."""
    slowest_s = max((1 / rate_hz for topic in topics if (rate_hz := rate_of(robot, topic))), default=0.0)
    duration_s = max(RECORD_S, min(MESSAGES * slowest_s, LONGEST_S))
    if robot.profile.ros and robot.profile.ros.command.ends == "sigint":
        duration_s += _START_S
    return RecordStep.model_validate({"robot": role, "topics": topics, "duration": f"{duration_s}s"})


def _record(scene: Scene, step: RecordStep, shell: Shell, into: Path, *, patient: bool) -> tuple[Path, Bag]:
    """Carry out a recording; return the bag that was fetched, and what it holds.

    Raises:
        EvidenceError: There is no bag, or no message in it; says how the recorder's log ends.
    """
    robot = scene.robot(step.robot)
    where = (scene.folder, step.robot, robot.profile.radio.interface)
    (planned,) = step.jobs(scene)
    job = planned.job if patient else replace(planned.job, limit_s=min(planned.job.limit_s, _PATIENCE_S))
    evidence.begin(shell, *where)
    jobs.run(shell, job)
    fetching.fetch(shell, *where, into)
    path, log = into / step.bag(robot), into / job.log
    try:
        return path, bag.read(path)
    except EvidenceError as error:
        raise EvidenceError(f"{error.what}; the recorder: {_end(log) or 'said nothing'}") from error


def _end(log: Path) -> str:
    """Return how a log ends."""
    if not log.is_file():
        return ""
    with log.open("rb") as file:
        file.seek(-min(file.seek(0, 2), _END_BYTES), 2)
        return printable(file.read(), limit=120)


def judge(robot: Robot, topics: Sequence[str], found: Bag | None, report: Report, *, why: str = "") -> None:
    """Add whether each of `topics` is alive, and at its rate, by a recording or by `why` there is none."""
    for topic in topics:
        check, rate_hz = f"topic {topic}", rate_of(robot, topic)
        count = 0 if found is None else found.messages_by_topic.get(topic, 0)
        if found is None or not count:
            tool = "rostopic hz" if robot.profile.ros and robot.profile.ros.variant == "ros1" else "ros2 topic hz"
            report.fail(
                check,
                f"silent: {why}" if why else "silent",
                f"{tool} {topic}   # start what publishes it, or correct the procedure",
            )
        elif rate_hz is None:
            report.ok(check, f"{count} messages in {found.duration_s:.1f} s; the profile gives no rate")
        else:
            _judge_rate(check, count, found.duration_s, rate_hz, report)


def _judge_rate(check: str, count: int, span_s: float, rate_hz: float, report: Report) -> None:
    # A message more or less may fall into the span, which is from the first message of any topic to the last.
    low, high = ((count + sign) / max(span_s, 1e-9) for sign in (-1, 1))
    detail = f"{count} messages in {span_s:.1f} s, of {rate_hz:g} Hz"
    if high < (1 - TOLERANCE) * rate_hz or (count > 1 and low > (1 + TOLERANCE) * rate_hz):
        report.warn(check, detail, "correct the rate in the profile, or find out what slows the topic: top")
    else:
        report.ok(check, detail)
