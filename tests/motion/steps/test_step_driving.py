"""A robot that drives automatically in a step move: its job, refusals before the start, and its lease."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any, cast

import pytest

from fieldkit.agent.driving.drive_plan import DriveTask
from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.motion.profile_sections import drive_of
from fieldkit.motion.steps import driving
from fieldkit.motion.steps.drive_lease import DriveLease
from fieldkit.motion.steps.move import MoveStep
from fieldkit.remote import agent, jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Completed, Shell
from fieldkit.steps.scene import Scene
from fieldkit.steps.view import View
from tests.helpers.casts import CAST, TURTLEBOT, ros_of
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.movers import driving_cast

DRIVES = driving_cast(CAST)
SCENE = Scene(Protocol.TCP, DRIVES, "f")
LEASE_S = 0.05
READY = '{"ended": "", "ready": true}'
PING = "during: [{ping: {from: sender, to: receiver}}]"


def move(text: str) -> MoveStep:
    return schema.validate(schema.parse(f"{{{text}, {PING}}}", source="x.yaml"), MoveStep)


STEP = move("robot: receiver, path: [{away: 2m}, {right: 1m, towards: 1m}], speed: 0.2m/s, name: out")


def test_size_of_log_grows_with_drive_and_is_on_driving_robot_only() -> None:
    short, long = (move(f"robot: receiver, path: [{{away: {far}m}}], speed: 0.1m/s") for far in (10, 60))
    assert [role for role in DRIVES if long.stored_bytes(SCENE, role)] == [Role.RECEIVER]
    # Each direction takes 500 s more, and the log has ten lines per second, each of 200 to 250 bytes.
    grown_bytes = long.stored_bytes(SCENE, Role.RECEIVER) - short.stored_bytes(SCENE, Role.RECEIVER)
    assert 200 * 10_000 < grown_bytes < 250 * 10_000
    assert not long.stored_bytes(replace(SCENE, cast=CAST), Role.RECEIVER), "a robot moved by a person has no log"


def test_argument_of_driver_has_legs_limits_and_topics() -> None:
    first, *_ = STEP.jobs(SCENE)
    assert (first.role, first.job.name, first.job.log) == (Role.RECEIVER, "out.drive", "out.drive.log")
    argv = list(first.job.argv)
    assert argv[0] == "bash"
    assert shlex.split(argv[2])[:2] == [".", "/opt/ros/noetic/setup.bash"]
    assert argv[-3:-2] + argv[-1:] == ["drive", "out.drive.jsonl"]
    argument = json.loads(argv[-2])
    assert (argument["over"], argument["cdr"], argument["orders"]) == ("ros1", False, "out.drive.orders")
    assert (argument["command"]["name"], argument["odometry"]["name"]) == ("/cmd_vel", "/odom")
    # As `rosmsg md5` prints them.
    assert argument["command"]["md5"] == "9f195f881246fdfa2798d1d3eebca84a"
    assert argument["odometry"]["md5"] == "cd5e73d190d741a2f92e81eda573aca7"
    task = DriveTask.from_json(argument["task"])
    assert list(task.legs) == [(2.0, 0.0), (-1.0, -1.0)]
    assert (task.speed_m_s, task.turn_rad_s, task.fence_m, task.lease_s) == (0.2, 1.0, 30, 2.0)
    assert task.limit_s > 3.4 / 0.2
    assert first.job.limit_s > 2 * task.limit_s
    assert set(STEP.files()) >= {"out.drive.jsonl", "out.drive.log", "out.drive.orders", "out.drive.status"}
    (need, *_) = STEP.needs(SCENE)
    assert need.name == "ros1 for Python"


def test_without_permission_there_is_no_driver() -> None:
    scene = replace(SCENE, cast=CAST)
    assert "drive" not in [planned.job.name for planned in STEP.jobs(scene)]
    assert not list(STEP.needs(scene))
    (line, *_) = STEP.dry_run_notes(scene)
    assert "automatically" not in line
    (line, *_) = STEP.dry_run_notes(SCENE)
    assert "it stops if no order arrives for 2 s, and at 30 m from its origin" in line


def test_path_beyond_fence_or_speed_is_refused() -> None:
    long_move = move("robot: receiver, path: [{away: 25m}, {left: 20m}], speed: 0.3m/s")
    speed, fence = long_move.refusals(SCENE)
    assert speed.what == "its top speed is 0.22 m/s, but the move needs 0.3 m/s"
    assert fence.what == "its fence is 30 m from its origin, but its path leads 32.0156 m away"
    by_person = long_move.refusals(replace(SCENE, cast=CAST))
    assert [refusal.what for refusal in by_person] == [speed.what], "no fence if a person moves it"
    round_trip = move("robot: receiver, path: [{away: 25m}, {towards: 25m}, {away: 25m}], speed: 0.2m/s")
    assert not list(round_trip.refusals(SCENE)), "the fence limits the distance, not the length of the path"


def test_robots_with_one_velocity_topic_are_refused() -> None:
    shared = {role: robot.model_copy(update={"ros_master": "10.42.0.3"}) for role, robot in DRIVES.items()}
    (refusal,) = STEP.refusals(replace(SCENE, cast=shared))
    assert refusal.what == (
        "turtlebot-1 also subscribes to /cmd_vel of the ROS master at 10.42.0.3 and would drive, too"
    )


def argument_with_ros_2(*, drive: Mapping[str, Any] | None = None, **environment: str) -> Any:  # noqa: ANN401 (of JSON)
    """Return the argument of the driver of a robot with ROS 2; `drive` has keys of this section of its profile."""
    ros2 = ros_of(TURTLEBOT).model_copy(update={"variant": "ros2", "environment": environment})
    data = TURTLEBOT.model_copy(update={"ros": ros2}).model_dump(mode="json", by_alias=True)
    data["drive"] |= drive or {}
    profile = schema.validate(schema.parse(json.dumps(data), source="robots/x.yaml"), RobotProfile)
    cast_of = {**DRIVES, Role.RECEIVER: DRIVES[Role.RECEIVER].model_copy(update={"profile": profile})}
    scene = replace(SCENE, cast=cast_of)
    assert not list(STEP.refusals(scene))
    first, *_ = STEP.jobs(scene)
    (need, *_) = STEP.needs(scene)
    argument = json.loads(first.job.argv[-2])
    assert need.name == f"{argument['over']} for Python"
    return argument


def test_driver_publishes_stamped_velocities_in_the_frame_of_the_profile() -> None:
    assert "frame" not in argument_with_ros_2()
    argument = argument_with_ros_2(drive={"type": "geometry_msgs/TwistStamped"})
    assert (argument["command"]["type"], argument["frame"]) == ("geometry_msgs/msg/TwistStamped", "base_link")
    assert argument["command"]["dds_types"][argument["command"]["type"]] == "geometry_msgs::msg::dds_::TwistStamped_"
    named = argument_with_ros_2(drive={"type": "geometry_msgs/TwistStamped", "frame": "base_footprint"})
    assert named["frame"] == "base_footprint"


@pytest.mark.parametrize(
    "drive", [{"type": "geometry_msgs/Vector3"}, {"type": "geometry_msgs/msg/Twist"}, {"frame": "a b"}, {"frame": ""}]
)
def test_other_types_and_frames_of_velocities_are_refused(drive: Mapping[str, str]) -> None:
    (key,) = drive
    with pytest.raises(ConfigurationError, match=rf"drive\.{key}"):
        argument_with_ros_2(drive=drive)


def test_driver_uses_zenoh_router_of_its_robot() -> None:
    argument = argument_with_ros_2(RMW_IMPLEMENTATION="rmw_zenoh_cpp", ROS_DOMAIN_ID="7")
    assert (argument["over"], argument["cdr"]) == ("zenoh", True)
    # The profile has ROS 2 Foxy, which has no type hashes.
    assert argument["command"]["key"] == "7/cmd_vel/geometry_msgs::msg::dds_::Twist_/TypeHashNotSupported"
    assert "tcp/127.0.0.1:7447" in argument["network"]["settings"]["connect/endpoints"]
    ends = argument["command"]["tokens"]["publisher"], argument["odometry"]["tokens"]["subscription"]
    assert ends[0][0] == ends[1][0], "one node"
    assert ends[0][1] != ends[1][1]


@pytest.mark.parametrize("rmw", ["", "rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_connextdds"])
def test_driver_discovers_its_robot_over_dds_without_multicast(rmw: str) -> None:
    argument = argument_with_ros_2(RMW_IMPLEMENTATION=rmw, ROS_DOMAIN_ID="7")
    assert (argument["over"], argument["cdr"], argument["command"]["dds_topic"]) == ("dds", True, "rt/cmd_vel")
    assert argument["network"]["peers"] == [argument["network"]["address"]] == [DRIVES[Role.RECEIVER].address]
    assert argument["network"]["domain"] == 7
    assert argument["network"]["gid_bytes"] == 24, "of Foxy"


@pytest.mark.parametrize("domain", ["seven", "-1", "233", "1.5", "٣"])
def test_invalid_domain_is_reported_with_line_of_profile(domain: str) -> None:
    data = TURTLEBOT.model_dump(mode="json", by_alias=True)
    data["ros"]["environment"] = {"ROS_DOMAIN_ID": domain}
    text = json.dumps(data, indent=1, ensure_ascii=False)
    with pytest.raises(ConfigurationError, match="not a domain of ROS 2; use a whole number from 0 to 232") as caught:
        schema.validate(schema.parse(text, source="robots/x.yaml"), RobotProfile)
    line = next(number for number, line in enumerate(text.split("\n"), 1) if "ROS_DOMAIN_ID" in line)
    assert caught.value.where == f"robots/x.yaml:{line}"


def test_missing_log_makes_the_drive_void(tmp_path: Path) -> None:
    step = STEP.resolved(DRIVES)
    view = View(SCENE, AttemptEvidence(tmp_path))
    (problem,) = step.check(view)
    assert problem.startswith("out.drive.jsonl: cannot be read")
    assert {"drive_out_m", "drive_ended"} <= step.measure(view).missing.keys()
    assert not list(STEP.check(view)), "trials of older versions have no columns of the drive"
    moved = STEP.resolved(CAST)
    assert not list(moved.check(View(replace(SCENE, cast=CAST), AttemptEvidence(tmp_path))))
    assert not moved.measure(view).missing


def test_profile_with_drive_needs_a_fence() -> None:
    data = TURTLEBOT.model_dump(mode="json", by_alias=True)
    del data["limits"]["fence_m"]
    with pytest.raises(ConfigurationError, match=r"limits\.fence_m"):
        schema.validate(schema.parse(json.dumps(data), source="robots/x.yaml"), RobotProfile)


class RecordingShell:
    """A shell that records each order, and answers with a status.

    Args:
        status: The statuses, one per order; the last one is repeated.
        after: The first order that is answered with a status of `status`; earlier ones are answered with `READY`.
        broken: Whether each order fails.
    """

    robot = "turtlebot-2"

    def __init__(self, *, status: Sequence[str] = (), after: str = "", broken: bool = False) -> None:
        self.after = after
        self.written: list[str] = []
        self.status = iter(status)
        self.last = ""
        self.broken = broken
        self.was_asked = Event()

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        self.was_asked.set()
        if self.broken:
            raise LinkError("is out of range", where=self.robot, remedy="wait")
        self.written.append(argv[-2])
        if argv[-2].split()[1] == self.after:
            self.after = ""
        self.last = READY if self.after else next(self.status, self.last)
        return Completed(tuple(argv), 0, self.last.encode(), b"")


JOB = Job(folder="f", name="drive", argv=(), limit_s=1.0, log="drive.log")


def lease_of(link: RecordingShell) -> DriveLease:
    return DriveLease(cast("Shell", link), JOB, "{}", LEASE_S)


def test_lease_repeats_the_order_until_robot_is_home() -> None:
    link = RecordingShell(status=["", '{"ended": ""}', "{", '{"ended": "home"}'])
    with lease_of(link) as lease:
        assert lease.status in ({}, {"ended": ""})  # A renewal can precede this line.
        assert lease.end_state == ""
        lease.give_order("back")
        lease.wait(lambda: lease.end_state, Deadline.after(60))
        assert lease.status == {"ended": "home"}
    orders = [text.split()[1] for text in link.written]
    assert orders[0] == "wait"
    assert orders[-1] == "back"


@pytest.mark.parametrize("status_text", ["[1]", "[" * 100_000, '{"ended": ["home"]}'])
def test_invalid_status_is_ignored(status_text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with lease_of(RecordingShell(status=[status_text])) as lease:
        assert lease.end_state == ""
        monkeypatch.setattr(DriveLease, "unchanged_s", 41.0)
        assert lease.end_state == "its driver sent no status for 41 s"


def test_reason_of_driver_is_one_short_line() -> None:
    with lease_of(RecordingShell(status=[json.dumps({"ended": "\ud800\x1b[2J" + "long\n" * 1000})])) as lease:
        assert lease.end_state.startswith("??[2Jlong long ")
        assert len(lease.end_state) == 200


def test_lost_link_does_not_end_the_wait() -> None:
    link = RecordingShell(status=['{"phase": "out"}'])
    with lease_of(link) as lease:
        link.broken = True
        link.was_asked.clear()
        lease.wait(link.was_asked.is_set, Deadline.after(60))
        assert link.was_asked.is_set()
        assert lease.status == {"phase": "out"}


class DrivingTestbed(IdleTestbed):
    """A testbed with a robot that drives; records each call of `bring_back`."""

    def __init__(self, link: RecordingShell) -> None:
        super().__init__({Role.RECEIVER: cast("Shell", link)})
        self.returns: list[bool] = []

    def bring_back(self, role: Role, *, has_returned: bool) -> None:
        assert role is Role.RECEIVER
        self.returns.append(has_returned)


@pytest.fixture
def stopped(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of the jobs that were stopped."""
    names: list[str] = []

    def stop(shell: Shell, job: Job, **_: object) -> int:
        names.append(job.name)
        return 0

    monkeypatch.setattr(agent, "install", lambda shell: None)
    monkeypatch.setattr(jobs, "start", lambda shell, job: None)
    monkeypatch.setattr(jobs, "stop", stop)
    return names


def quick_scene() -> Scene:
    """Return the scene with a short lease."""
    drive = drive_of(TURTLEBOT)
    assert drive is not None
    profile = TURTLEBOT.model_copy(update={"drive": drive.model_copy(update={"lease": LEASE_S})})
    robot = Robot(name="r", address="10.0.0.1", profile=profile, abilities=frozenset({"drive"}))
    return replace(SCENE, cast={**DRIVES, Role.RECEIVER: robot})


def driven(field: DrivingTestbed, body: Any) -> None:  # noqa: ANN401
    scene = quick_scene()
    first, *_ = STEP.jobs(scene)
    with driving.drive_robot(scene, field, first, STEP.motion, "out.{}"):
        body()


def test_robot_that_returns_is_not_brought_back(stopped: list[str]) -> None:
    field = DrivingTestbed(RecordingShell(after="back", status=['{"ended": "home", "ready": true}']))
    driven(field, lambda: None)
    assert field.returns == [True]
    assert stopped == ["out.drive"]


def test_robot_that_stopped_is_brought_back_and_attempt_fails(stopped: list[str]) -> None:
    field = DrivingTestbed(RecordingShell(after="out", status=['{"ended": "no odometry for 0.5 s", "ready": true}']))
    with pytest.raises(RobotError, match="it stopped on its path: no odometry"):
        driven(field, lambda: None)
    assert field.returns == [False]
    assert stopped == ["out.drive"]


def test_early_stop_aborts_steps_inside(stopped: list[str]) -> None:
    waiting_step = STEP.model_dump(mode="json", by_alias=True) | {"during": [{"wait": {"duration": "60min"}}]}
    step = schema.validate(schema.parse(json.dumps(waiting_step), source="x.yaml"), MoveStep)
    field = DrivingTestbed(RecordingShell(after="out", status=[READY] * 4 + ['{"ended": "beyond the fence"}']))
    with pytest.raises(RobotError, match="it stopped on its path: beyond the fence") as caught:
        step.run(quick_scene(), field, lambda *_: None)
    assert "the wait was interrupted" in str(caught.value.__cause__)
    assert field.returns == [False]
    assert stopped == ["out.drive"]


def test_interrupted_robot_stays_where_it_is(stopped: list[str]) -> None:
    link = RecordingShell(status=['{"ended": "", "ready": true}'])
    field = DrivingTestbed(link)

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        driven(field, interrupt)
    assert field.returns == []
    assert stopped == ["out.drive"]
    assert not any(" back " in text for text in link.written)


def test_robot_returns_after_error_inside(stopped: list[str]) -> None:
    field = DrivingTestbed(RecordingShell(after="back", status=['{"ended": "home", "ready": true}']))

    def fail() -> None:
        raise RobotError("it broke", remedy="repair it")

    with pytest.raises(RobotError, match="it broke"):
        driven(field, fail)
    assert field.returns == [True]
    assert stopped == ["out.drive"]


def test_an_error_inside_is_reported_even_if_the_robot_does_not_return(
    stopped: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def bring_back(*_: object, **__: object) -> str:
        raise LinkError("it does not answer")

    def fail() -> None:
        raise RobotError("ping exited with 2")

    monkeypatch.setattr(driving, "_bring_back", bring_back)
    field = DrivingTestbed(RecordingShell(status=['{"ended": "", "ready": true}']))
    with pytest.raises(LinkError) as caught:
        driven(field, fail)
    assert caught.value.what.startswith("it does not answer; before that, the steps failed: RobotError: ")
    assert "ping exited with 2" in caught.value.what
