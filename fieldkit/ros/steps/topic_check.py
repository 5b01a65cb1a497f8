"""Check the rate of each recorded topic with a short recording by the robot's recorder."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import RepeatId, Role
from fieldkit.core.units import format_count
from fieldkit.measure.evidence.recordings import RecordingContents
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.command import printable
from fieldkit.remote.shell import Shell
from fieldkit.ros.bags import bag
from fieldkit.ros.steps.record import RecordStep
from fieldkit.steps.capabilities import Subscribes
from fieldkit.steps.scene import Scene
from fieldkit.trial.check import software
from fieldkit.trial.check.report import Report
from fieldkit.trial.check.software import ProbeResult
from fieldkit.trial.check.system import judge_battery
from fieldkit.trial.plan import Plan

RECORD_S: Final = 2.0
LONGEST_S: Final = 20.0
"""Shortest and longest duration of the recording, without `_START_S`."""
MESSAGES: Final = 2
"""The recording is long enough for this number of messages of the slowest topic, within these limits."""
TOLERANCE: Final = 0.5
"""Allowed deviation of a topic's rate, as a fraction of the rate."""

# Added for a recorder that has no option for the duration. Its duration starts with its first subscription; the other
# subscriptions may take seconds on a small computer.
_START_S: Final = 4.0
# Limit of a recording that is needed only for the battery. A recorder would wait longer if its ROS master is missing.
_SHORT_LIMIT_S: Final = 6.0
_END_BYTES: Final = 4096
"""Number of bytes that are read from the end of a log."""
_BATTERY: Final = "sensor_msgs/BatteryState"


def check_topics(plan: Plan, role: Role, shell: Shell, probe_result: ProbeResult, report: Report) -> None:
    """Record for a short time; report whether each recorded topic is published, and the charge of the battery.

    It is the entry point `topics` of `fieldkit.checks`.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The recorder did not start.
    """
    robot = plan.cast[role]
    topics_to_check, battery = (
        required_topics(plan, role),
        "" if has_shared_battery(plan, role) else battery_of(robot),
    )
    topics = tuple(dict.fromkeys((*topics_to_check, *((battery,) if battery else ()))))
    if not topics or not can_record(plan, role, probe_result):
        return
    step = recording_step(role, robot, topics)
    scene = plan.scene(
        RepeatId(plan.protocols[0], 1), jobs.work_folder(plan.trial, "check"), {role: probe_result.variants}
    )
    with tempfile.TemporaryDirectory() as into:
        try:
            path, recorded_bag = _record(scene, step, shell, Path(into), waits_full_time=bool(topics_to_check))
        except EvidenceError as error:
            judge(robot, topics_to_check, None, report, reason=error.what)
            return
        finally:
            evidence.discard(shell, plan.trial)
        judge(robot, topics_to_check, recorded_bag, report)
        _check_battery(path, battery, report)


def can_record(plan: Plan, role: Role, probe_result: ProbeResult) -> bool:
    """Return False if the robot lacks the record program that the procedure requires."""
    ros = plan.cast[role].profile.ros
    if ros is None or not required_topics(plan, role):
        return True
    return probe_result.has_program(ros.command.record[0], software.needs_of(plan, role))


def _check_battery(path: Path, topic: str, report: Report) -> None:
    try:
        share = bag.battery_share(path, topic)
    except EvidenceError as error:
        report.ok("battery", f"unknown: {error.what}")
        return
    if share is not None:
        judge_battery(topic, 100 * share, report)


def required_topics(plan: Plan, role: Role) -> tuple[str, ...]:
    """Return the topics that the procedure requires to be published on the robot in `role`."""
    steps = (placed.step for placed in plan.procedure.walk() if isinstance(placed.step, Subscribes))
    topics = (topic for step in steps for topic in step.live_topics(role))
    return tuple(dict.fromkeys(topics))


def battery_of(robot: Robot) -> str:
    """Return the topic of the robot's battery state; empty if its profile has none."""
    return next((topic.name for topic in robot.profile.topics if topic.type == _BATTERY), "")


def has_shared_battery(plan: Plan, role: Role) -> bool:
    """Return True if a battery topic is ambiguous: another robot on the same ROS master has the same topic."""
    robot = plan.cast[role]
    others = (other for other_role, other in plan.cast.items() if other_role is not role and other.ros_master)
    return any(
        other.ros_master == robot.ros_master and battery_of(other) == battery_of(robot) != "" for other in others
    )


def rate_of(robot: Robot, topic: str) -> float | None:
    """Return the rate in Hz that the robot's profile gives for a topic, or None if it has no such topic."""
    return next((entry.rate for entry in robot.profile.topics if entry.name == topic), None)


def recording_step(role: Role, robot: Robot, topics: Sequence[str]) -> RecordStep:
    """Return the step of a recording in which each topic of known rate should have `MESSAGES` messages.

    The limits of its duration, `RECORD_S` and `LONGEST_S`, may result in more or fewer messages.
    """
    slowest_s = max((1 / rate_hz for topic in topics if (rate_hz := rate_of(robot, topic))), default=0.0)
    duration_s = max(RECORD_S, min(MESSAGES * slowest_s, LONGEST_S))
    if robot.profile.ros and robot.profile.ros.command.ends == "sigint":
        duration_s += _START_S
    return RecordStep.model_validate({"robot": role, "topics": topics, "duration": f"{duration_s}s"})


def _record(
    scene: Scene, step: RecordStep, shell: Shell, into: Path, *, waits_full_time: bool
) -> tuple[Path, RecordingContents]:
    """Run a recording; return the path and the content of the fetched bag.

    Without `waits_full_time` the recording ends after at most `_SHORT_LIMIT_S`.

    Raises:
        EvidenceError: There is no bag, or no message in it; the error includes the end of the recorder's log.
    """
    robot = scene.robot(step.robot)
    location = (scene.folder, step.robot, robot.profile.radio.interface)
    (planned,) = step.jobs(scene)
    job = planned.job if waits_full_time else replace(planned.job, limit_s=min(planned.job.limit_s, _SHORT_LIMIT_S))
    evidence.begin(shell, *location)
    jobs.run(shell, job)
    fetching.fetch(shell, *location, into)
    path, log = into / step.bag(robot), into / job.log
    try:
        return path, bag.read(path)
    except EvidenceError as error:
        raise EvidenceError(f"{error.what}; the recorder: {_end_of_log(log) or 'printed nothing'}") from error


def _end_of_log(log: Path) -> str:
    """Return the end of a log."""
    if not log.is_file():
        return ""
    with log.open("rb") as file:
        file.seek(-min(file.seek(0, 2), _END_BYTES), 2)
        return printable(file.read(), limit=120)


def judge(
    robot: Robot, topics: Sequence[str], content: RecordingContents | None, report: Report, *, reason: str = ""
) -> None:
    """Report whether each topic is published at its rate, from a recording or the reason why there is none."""
    for topic in topics:
        check, rate_hz = f"topic {topic}", rate_of(robot, topic)
        count = 0 if content is None else content.messages_by_topic.get(topic, 0)
        if content is None or not count:
            tool = "rostopic hz" if robot.profile.ros and robot.profile.ros.variant == "ros1" else "ros2 topic hz"
            report.fail(
                check,
                f"no message: {reason}" if reason else "no message",
                f"{tool} {topic}   # start the node that publishes it, or correct the procedure",
            )
        elif rate_hz is None:
            text = f"{format_count(count, 'message')} in {content.duration_s:.1f} s"
            report.ok(check, f"{text}; the profile gives no rate")
        else:
            _judge_rate(check, count, content.duration_s, rate_hz, report)


def _judge_rate(check: str, count: int, span_s: float, rate_hz: float, report: Report) -> None:
    # The span is from the first message of any topic to the last one, so the count may be wrong by one.
    low, high = ((count + sign) / max(span_s, 1e-9) for sign in (-1, 1))
    detail = f"{format_count(count, 'message')} in {span_s:.1f} s, expected {rate_hz:g} Hz"
    if high < (1 - TOLERANCE) * rate_hz or (count > 1 and low > (1 + TOLERANCE) * rate_hz):
        report.warn(check, detail, "correct the rate in the profile, or find the program that slows it down: top")
    else:
        report.ok(check, detail)
