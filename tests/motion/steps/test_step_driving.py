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
    short_move, long_move = (
        move(f"robot: receiver, path: [{{away: {distance_m}m}}], speed: 0.1m/s") for distance_m in (10, 60)
    )
    assert [role for role in DRIVES if long_move.stored_bytes(SCENE, role)] == [Role.RECEIVER]
    # Both directions together take 1000 s longer, and the log has ten lines of 200 to 250 bytes per second.
    increase_bytes = long_move.stored_bytes(SCENE, Role.RECEIVER) - short_move.stored_bytes(SCENE, Role.RECEIVER)
    assert 200 * 10_000 < increase_bytes < 250 * 10_000
    assert not long_move.stored_bytes(replace(SCENE, cast=CAST), Role.RECEIVER), (
        "a robot moved by a person has no log"
    )


def test_argument_of_driver_has_legs_limits_and_topics() -> None:
    driver_job, *_ = STEP.jobs(SCENE)
    assert (driver_job.role, driver_job.job.name, driver_job.job.log) == (Role.RECEIVER, "out.drive", "out.drive.log")
    argv = list(driver_job.job.argv)
    assert argv[0] == "bash"
    assert shlex.split(argv[2])[:2] == [".", "/opt/ros/noetic/setup.bash"]
    assert argv[-3:-2] + argv[-1:] == ["drive", "out.drive.jsonl"]
    argument = json.loads(argv[-2])
    assert (argument["over"], argument["cdr"], argument["orders"]) == ("ros1", False, "out.drive.orders")
    assert (argument["command"]["name"], argument["odometry"]["name"]) == ("/cmd_vel", "/odom")
    # The output of `rosmsg md5`.
    assert argument["command"]["md5"] == "9f195f881246fdfa2798d1d3eebca84a"
    assert argument["odometry"]["md5"] == "cd5e73d190d741a2f92e81eda573aca7"
    task = DriveTask.from_json(argument["task"])
    assert list(task.legs) == [(2.0, 0.0), (-1.0, -1.0)]
    assert (task.speed_m_s, task.turn_rad_s, task.fence_m, task.lease_s) == (0.2, 1.0, 30, 2.0)
    assert task.limit_s > 3.4 / 0.2
    assert driver_job.job.limit_s > 2 * task.limit_s
    assert set(STEP.files()) >= {"out.drive.jsonl", "out.drive.log", "out.drive.orders", "out.drive.status"}
    (need, *_) = STEP.needs(SCENE)
    assert need.name == "ros1 for Python"


def test_there_is_no_driver_without_permission() -> None:
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
    refusals_for_person = long_move.refusals(replace(SCENE, cast=CAST))
    assert [refusal.what for refusal in refusals_for_person] == [speed.what], (
        "the fence does not apply if a person moves the robot"
    )
    round_trip = move("robot: receiver, path: [{away: 25m}, {towards: 25m}, {away: 25m}], speed: 0.2m/s")
    assert not list(round_trip.refusals(SCENE)), "the fence limits the distance, not the length of the path"


def test_robots_that_share_a_velocity_topic_are_refused() -> None:
    robots_with_one_master = {
        role: robot.model_copy(update={"ros_master": "10.42.0.3"}) for role, robot in DRIVES.items()
    }
    (refusal,) = STEP.refusals(replace(SCENE, cast=robots_with_one_master))
    assert refusal.what == (
        "turtlebot-1 also subscribes to /cmd_vel of the ROS master at 10.42.0.3 and would drive, too"
    )


def argument_with_ros_2(*, drive: Mapping[str, Any] | None = None, **environment: str) -> Any:  # noqa: ANN401 (any JSON)
    """Return the argument of the driver of a robot with ROS 2; `drive` has keys of this section of its profile."""
    ros2 = ros_of(TURTLEBOT).model_copy(update={"variant": "ros2", "environment": environment})
    data = TURTLEBOT.model_copy(update={"ros": ros2}).model_dump(mode="json", by_alias=True)
    data["drive"] |= drive or {}
    profile = schema.validate(schema.parse(json.dumps(data), source="robots/x.yaml"), RobotProfile)
    robots = {**DRIVES, Role.RECEIVER: DRIVES[Role.RECEIVER].model_copy(update={"profile": profile})}
    scene = replace(SCENE, cast=robots)
    assert not list(STEP.refusals(scene))
    driver_job, *_ = STEP.jobs(scene)
    (need, *_) = STEP.needs(scene)
    argument = json.loads(driver_job.job.argv[-2])
    assert need.name == f"{argument['over']} for Python"
    return argument


def test_driver_publishes_stamped_velocities_in_the_frame_of_the_profile() -> None:
    assert "frame" not in argument_with_ros_2()
    argument = argument_with_ros_2(drive={"type": "geometry_msgs/TwistStamped"})
    assert (argument["command"]["type"], argument["frame"]) == ("geometry_msgs/msg/TwistStamped", "base_link")
    assert argument["command"]["dds_types"][argument["command"]["type"]] == "geometry_msgs::msg::dds_::TwistStamped_"
    argument_with_frame = argument_with_ros_2(drive={"type": "geometry_msgs/TwistStamped", "frame": "base_footprint"})
    assert argument_with_frame["frame"] == "base_footprint"


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
    tokens = argument["command"]["tokens"]["publisher"], argument["odometry"]["tokens"]["subscription"]
    assert tokens[0][0] == tokens[1][0], "the publisher and the subscription are of the same node"
    assert tokens[0][1] != tokens[1][1]


@pytest.mark.parametrize("rmw", ["", "rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_connextdds"])
def test_driver_discovers_its_robot_over_dds_without_multicast(rmw: str) -> None:
    argument = argument_with_ros_2(RMW_IMPLEMENTATION=rmw, ROS_DOMAIN_ID="7")
    assert (argument["over"], argument["cdr"], argument["command"]["dds_topic"]) == ("dds", True, "rt/cmd_vel")
    assert argument["network"]["peers"] == [argument["network"]["address"]] == [DRIVES[Role.RECEIVER].address]
    assert argument["network"]["domain"] == 7
    assert argument["network"]["gid_bytes"] == 24, "the size in Foxy"


@pytest.mark.parametrize("domain", ["seven", "-1", "233", "1.5", "٣"])
def test_invalid_domain_is_reported_with_line_of_profile(domain: str) -> None:
    data = TURTLEBOT.model_dump(mode="json", by_alias=True)
    data["ros"]["environment"] = {"ROS_DOMAIN_ID": domain}
    text = json.dumps(data, indent=1, ensure_ascii=False)
    with pytest.raises(
        ConfigurationError, match="not a domain of ROS 2; use a whole number from 0 to 232"
    ) as error_info:
        schema.validate(schema.parse(text, source="robots/x.yaml"), RobotProfile)
    line = next(number for number, line in enumerate(text.split("\n"), 1) if "ROS_DOMAIN_ID" in line)
    assert error_info.value.where == f"robots/x.yaml:{line}"


def test_missing_log_makes_the_drive_void(tmp_path: Path) -> None:
    step = STEP.resolved(DRIVES)
    view = View(SCENE, AttemptEvidence(tmp_path))
    (problem,) = step.check(view)
    assert problem.startswith("out.drive.jsonl: cannot be read")
    assert {"drive_out_m", "drive_ended"} <= step.measure(view).missing.keys()
    assert not list(STEP.check(view)), "trials of older versions have no columns of the drive"
    moved_by_person = STEP.resolved(CAST)
    assert not list(moved_by_person.check(View(replace(SCENE, cast=CAST), AttemptEvidence(tmp_path))))
    assert not moved_by_person.measure(view).missing


def test_profile_with_drive_needs_a_fence() -> None:
    data = TURTLEBOT.model_dump(mode="json", by_alias=True)
    del data["limits"]["fence_m"]
    with pytest.raises(ConfigurationError, match=r"limits\.fence_m"):
        schema.validate(schema.parse(json.dumps(data), source="robots/x.yaml"), RobotProfile)


class RecordingShell:
    """A shell that records each order, and answers with a status.

    Args:
        status: The statuses, one per order; the last status is repeated.
        after: The first order that is answered with a status of `status`; earlier orders are answered with `READY`.
        is_broken: If True, each order fails.
    """

    robot = "turtlebot-2"

    def __init__(self, *, status: Sequence[str] = (), after: str = "", is_broken: bool = False) -> None:
        self.after = after
        self.orders: list[str] = []
        self.status = iter(status)
        self.last = ""
        self.is_broken = is_broken
        self.was_called = Event()

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        self.was_called.set()
        if self.is_broken:
            raise LinkError("is out of range", where=self.robot, remedy="wait")
        self.orders.append(argv[-2])
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
        assert lease.final_state == ""
        lease.give_order("back")
        lease.wait(lambda: lease.final_state, Deadline.after(60))
        assert lease.status == {"ended": "home"}
    orders = [text.split()[1] for text in link.orders]
    assert orders[0] == "wait"
    assert orders[-1] == "back"


@pytest.mark.parametrize("status_text", ["[1]", "[" * 100_000, '{"ended": ["home"]}'])
def test_invalid_status_is_ignored(status_text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with lease_of(RecordingShell(status=[status_text])) as lease:
        assert lease.final_state == ""
        monkeypatch.setattr(DriveLease, "unchanged_s", 41.0)
        assert lease.final_state == "its driver sent no status for 41 s"


def test_reason_of_driver_is_one_short_line() -> None:
    with lease_of(RecordingShell(status=[json.dumps({"ended": "\ud800\x1b[2J" + "long\n" * 1000})])) as lease:
        assert lease.final_state.startswith("??[2Jlong long ")
        assert len(lease.final_state) == 200


def test_lost_link_does_not_stop_the_wait() -> None:
    link = RecordingShell(status=['{"phase": "out"}'])
    with lease_of(link) as lease:
        link.is_broken = True
        link.was_called.clear()
        lease.wait(link.was_called.is_set, Deadline.after(60))
        assert link.was_called.is_set()
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
def stopped_jobs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
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
    drive_section = drive_of(TURTLEBOT)
    assert drive_section is not None
    profile = TURTLEBOT.model_copy(update={"drive": drive_section.model_copy(update={"lease": LEASE_S})})
    robot = Robot(name="r", address="10.0.0.1", profile=profile, abilities=frozenset({"drive"}))
    return replace(SCENE, cast={**DRIVES, Role.RECEIVER: robot})


def drive(testbed: DrivingTestbed, body: Any) -> None:  # noqa: ANN401
    scene = quick_scene()
    driver_job, *_ = STEP.jobs(scene)
    with driving.drive_robot(scene, testbed, driver_job, STEP.motion, "out.{}"):
        body()


def test_robot_that_returns_is_not_brought_back(stopped_jobs: list[str]) -> None:
    testbed = DrivingTestbed(RecordingShell(after="back", status=['{"ended": "home", "ready": true}']))
    drive(testbed, lambda: None)
    assert testbed.returns == [True]
    assert stopped_jobs == ["out.drive"]


def test_robot_that_stopped_is_brought_back_and_attempt_fails(stopped_jobs: list[str]) -> None:
    testbed = DrivingTestbed(
        RecordingShell(after="out", status=['{"ended": "no odometry for 0.5 s", "ready": true}'])
    )
    with pytest.raises(RobotError, match="it stopped on its path: no odometry"):
        drive(testbed, lambda: None)
    assert testbed.returns == [False]
    assert stopped_jobs == ["out.drive"]


def test_early_stop_aborts_the_nested_steps(stopped_jobs: list[str]) -> None:
    waiting_step = STEP.model_dump(mode="json", by_alias=True) | {"during": [{"wait": {"duration": "60min"}}]}
    step = schema.validate(schema.parse(json.dumps(waiting_step), source="x.yaml"), MoveStep)
    testbed = DrivingTestbed(RecordingShell(after="out", status=[READY] * 4 + ['{"ended": "beyond the fence"}']))
    with pytest.raises(RobotError, match="it stopped on its path: beyond the fence") as error_info:
        step.run(quick_scene(), testbed, lambda *_: None)
    assert "the wait was interrupted" in str(error_info.value.__cause__)
    assert testbed.returns == [False]
    assert stopped_jobs == ["out.drive"]


def test_robot_is_not_moved_back_after_an_interruption(stopped_jobs: list[str]) -> None:
    link = RecordingShell(status=['{"ended": "", "ready": true}'])
    testbed = DrivingTestbed(link)

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        drive(testbed, interrupt)
    assert testbed.returns == []
    assert stopped_jobs == ["out.drive"]
    assert not any(" back " in text for text in link.orders)


def test_robot_returns_after_an_error_in_a_nested_step(stopped_jobs: list[str]) -> None:
    testbed = DrivingTestbed(RecordingShell(after="back", status=['{"ended": "home", "ready": true}']))

    def fail() -> None:
        raise RobotError("it broke", remedy="repair it")

    with pytest.raises(RobotError, match="it broke"):
        drive(testbed, fail)
    assert testbed.returns == [True]
    assert stopped_jobs == ["out.drive"]


def test_an_error_in_a_nested_step_is_reported_even_if_the_robot_does_not_return(
    stopped_jobs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def bring_back(*_: object, **__: object) -> str:
        raise LinkError("it does not answer")

    def fail() -> None:
        raise RobotError("ping exited with 2")

    monkeypatch.setattr(driving, "_bring_back", bring_back)
    testbed = DrivingTestbed(RecordingShell(status=['{"ended": "", "ready": true}']))
    with pytest.raises(LinkError) as error_info:
        drive(testbed, fail)
    assert error_info.value.what.startswith("it does not answer; before that, the steps failed: RobotError: ")
    assert "ping exited with 2" in error_info.value.what
