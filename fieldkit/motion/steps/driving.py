"""Drive a robot by its velocity topic while other steps run.

The agent, fieldkit's program on the robot, steers it. Orders of the laptop are valid for a limited time, the lease.
The laptop renews them; otherwise the robot stops (`fieldkit.motion.steps.lease`).
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import MappingProxyType
from typing import Any, Final

from fieldkit.agent.driving import drive_plan
from fieldkit.agent.driving.drive_plan import DriveTask
from fieldkit.backends.protocols import Robot, Testbed
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, LinkError, MotionHeldError, RobotError, describe_exception
from fieldkit.core.model import Move
from fieldkit.motion import driven_paths
from fieldkit.motion.logs import drive_log
from fieldkit.motion.origins import RobotMotion, origins_of
from fieldkit.motion.profile_sections import TWIST_STAMPED, Drive, drive_of
from fieldkit.motion.steps import lease
from fieldkit.motion.steps.drive_lease import START_S, STATUS, DriveLease
from fieldkit.motion.steps.lease import orders_file
from fieldkit.motion.steps.robot_mover import RobotMover
from fieldkit.remote import agent, jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.ros.middlewares.middleware import MiddlewareName
from fieldkit.steps import agent_commands
from fieldkit.steps.scene import BY_EXIT, BY_FIELDKIT, Planned, Refusal, Scene

ODOMETRY_S: Final = 0.5
"""The robot stops if it receives no odometry for this time."""

_TURN_S: Final = 12.0
"""Maximum duration of a turn at a corner: half a turn at 0.3 rad/s."""
_SLACK_S: Final = 20.0
"""Additional time in the time limit of a move."""
_GRACE_S: Final = 3.0
"""Time in which a driver must stop the robot and exit; then it is killed."""

_ZENOH_PORT: Final = 7447
"""Default port of Zenoh, on which the router of rmw_zenoh listens."""

_TOPIC_KEYS: Final = MappingProxyType(
    {
        MiddlewareName.ROS1: ("md5", "definition"),
        MiddlewareName.DDS: ("members", "dds_topic", "dds_types", "user_data"),
        MiddlewareName.ZENOH: ("key", "tokens"),
    }
)
"""Keys of a topic description that each middleware needs; others are omitted to keep command lines readable."""

_LOG: Final = "drive.log"


def middleware_of(robot: Robot) -> MiddlewareName:
    """Return the middleware through which a robot's base receives velocities."""
    ros = robot.profile.ros
    if ros is None or ros.variant == "ros1":
        return MiddlewareName.ROS1
    return MiddlewareName(ros.middleware)


def limit_s(move: Move) -> float:
    """Return the maximum duration of a move in one direction, in seconds; the robot stops after this time."""
    return 2 * driven_paths.length_m(move) / move.speed_m_s + _TURN_S * (len(move.legs) + 1) + _SLACK_S


def path_duration_s(robot: Robot, move: Move) -> float:
    """Return the duration of the path of a move in one direction with its turns, in s, rounded to milliseconds."""
    return round(drive_plan.path_duration_s(DriveTask.from_json(_task(robot, move))), 3)


def drive_job(scene: Scene, move: Move, inside_s: float, name_pattern: str) -> Planned:
    """Return the job that drives a robot.

    Args:
        scene: The attempt.
        move: Path and speed.
        inside_s: Maximum duration of the inner steps, which run during the drive.
        name_pattern: Pattern of the names of the step's jobs and files, from `Step.prefixed_name`; `{}` is replaced.
    """
    robot = scene.robot(move.role)
    argv = (
        robot.profile.tools.python,
        agent.path_from_job(),
        "drive",
        _driver_arguments(scene, move, name_pattern),
        name_pattern.format(drive_log.FILE),
    )
    setup = agent_commands.setup(robot)
    job = Job(
        folder=scene.folder,
        name=name_pattern.format("drive"),
        argv=with_environment(argv, setup=setup, environment=robot.ros_environment),
        limit_s=START_S + 2 * limit_s(move) + inside_s,
        log=name_pattern.format(_LOG),
        ready="log:up,",
        ready_s=jobs.AGENT_READY_S,
    )
    program = robot.profile.tools.python
    return Planned(move.role, job, program=program, setup=setup, permitted_causes=BY_EXIT | BY_FIELDKIT)


def refusals(scene: Scene, move: Move) -> Iterator[Refusal]:
    """Yield the reasons why a robot must not drive automatically."""
    robot = scene.robot(move.role)
    limits = robot.profile.limits
    farthest_m = driven_paths.farthest_m(move.legs)
    if limits.fence_m is not None and farthest_m > limits.fence_m:
        yield Refusal(
            move.role,
            f"its fence is {limits.fence_m:g} m from its origin, but its path leads {farthest_m:g} m away",
            "shorten the path in the procedure, or increase limits.fence_m in its profile if the area allows it",
        )
    drive = drive_of(robot.profile)
    if drive is not None and (reason := drive.topic_conflict(robot, scene.cast.values())):
        remedy = "use separate topics, ROS domains or masters; or move it by hand, without --allow-motion"
        yield Refusal(move.role, reason, remedy)


def files(name_pattern: str) -> tuple[str, ...]:
    """Return the files that a drive writes; see `drive_job` for `name_pattern`."""
    return tuple(name_pattern.format(file) for file in (drive_log.FILE, orders_file("drive"), STATUS, _LOG))


def _drive_section(robot: Robot) -> Drive:
    """Return the section `drive` of a robot's profile.

    Raises:
        RobotError: The profile has no such section.
    """
    if (drive := drive_of(robot.profile)) is None:
        raise RobotError(
            "it cannot be driven", where=robot.name, remedy="add drive: and limits.fence_m to its profile"
        )
    return drive


def _origin_fields(scene: Scene, move: Move) -> dict[str, Any]:
    """Return the keys of a drive task that depend on the origin of the robot in this trial."""
    origins = origins_of(scene)
    origin, last = origins.get(move.role), origins.last(move.role)
    if origin is None or not origins.robots_stay:
        return {}
    origin_fields = {"origin": (origin.x_m, origin.y_m, origin.heading_rad)}
    if last is not None:
        origin_fields["last"] = (last.x_m, last.y_m, last.heading_rad)
    return {**origin_fields, "frame_id": origin.frame_id, "may_return": origins.may_return}


def _task(robot: Robot, move: Move) -> dict[str, Any]:
    """Return the fields of a `fieldkit.agent.driving.drive_plan.DriveTask`."""
    drive = _drive_section(robot)
    return {
        "legs": [(leg.away_m, leg.left_m) for leg in move.legs],
        "speed_m_s": move.speed_m_s,
        "turn_rad_s": drive.turn_rad_s,
        "acceleration_m_s2": drive.acceleration_m_s2,
        "fence_m": robot.profile.limits.fence_m,  # required in a profile with `drive`
        "lease_s": drive.lease,
        "odometry_s": ODOMETRY_S,
        "limit_s": limit_s(move),
    }


def _driver_arguments(scene: Scene, move: Move, name_pattern: str) -> str:
    """Return the argument of the driver program, as JSON."""
    from fieldkit.ros.interfaces import topics, types  # noqa: PLC0415 (takes 50 ms and is needed only here)
    from fieldkit.ros.interfaces.qos import PROFILES  # noqa: PLC0415

    robot = scene.robot(move.role)
    drive = _drive_section(robot)
    middleware, ros = middleware_of(robot), robot.profile.ros
    message_types = (
        types.MessageTypes(types.Distribution.of(ros.command.distribution)) if ros else types.standard_types()
    )
    network = _network(robot, middleware) | {"gid_bytes": message_types.distribution.gid_bytes}

    def topic(topic_name: str, kind: str, profile: str, number: int) -> dict[str, Any]:
        description = topics.describe(
            message_types,
            topic_name,
            kind,
            PROFILES[profile],
            domain=network["domain"],
            node=network["node"],
            number=number,
        )
        return {key: description[key] for key in ("name", "type", "quality", *_TOPIC_KEYS[middleware])}

    arguments = {
        "over": middleware.value,
        "network": network,
        "cdr": middleware is not MiddlewareName.ROS1,
        "command": topic(drive.topic, drive.type, "default", 1),
        **({"frame": drive.frame} if drive.type == TWIST_STAMPED else {}),
        "odometry": topic(drive.odometry, "nav_msgs/msg/Odometry", "sensor_data", 2),
        "task": {**_task(robot, move), **_origin_fields(scene, move)},
        "orders": orders_file(name_pattern.format("drive")),
        "status": name_pattern.format(STATUS),
        "stationary": jobs.stationary_file(name_pattern.format("drive")),
    }
    return agent_commands.compact(arguments)


def _network(robot: Robot, middleware: MiddlewareName) -> dict[str, Any]:
    """Return the network settings of the driver, which discovers the nodes of its robot without multicast."""
    network = {
        "address": robot.address,
        "domain": robot.profile.ros.domain if robot.profile.ros else 0,
        "node": f"fieldkit_drive_{robot.name}".replace("-", "_"),
    }
    if middleware is not MiddlewareName.ZENOH:
        return network | {"peers": [robot.address]}
    # The router of rmw_zenoh on the robot announces all sessions of the robot. If there is no router, another session
    # may listen on its port.
    endpoints = [f"tcp/{address}:{_ZENOH_PORT}" for address in ("127.0.0.1", robot.address)]
    settings = {
        "connect/endpoints": agent_commands.compact(endpoints),
        "listen/endpoints": f'["tcp/{robot.address}:0"]',
    }
    return network | {"settings": settings}


@contextmanager
def drive_robot(scene: Scene, testbed: Testbed, plan: Planned, move: Move, name_pattern: str) -> Iterator[DriveLease]:
    """Drive a robot along its path while the body runs, and back to its place afterwards; yield its lease.

    After an error in the body the robot drives back, too. A real robot that cannot drive back stays where it is; no
    robot moves again before a person has put it at its place and confirmed this. After an interruption (Ctrl-C) the
    robot stops where it is.

    Raises:
        LinkError: The robot did not answer.
        RobotError: It could not be driven, or stopped before the body had ended.
        MotionHeldError: It is not at its start position, or a person must confirm before robots may move again.
        OSError: The journal of motions cannot be written; the robot does not start.
    """
    shell, robot = testbed.shells[move.role], scene.robot(move.role)
    lease_s = _drive_section(robot).lease
    mover = RobotMover(robot.name, shell, scene.folder, f"it stops automatically within {lease_s:g} s")
    drive_lease = DriveLease(shell, plan.job, name_pattern, lease_s)
    with scene.motions.moving(mover), lease.start_program(shell, plan.job), drive_lease, ExitStack() as stack:
        try:
            _wait_until_ready(scene, drive_lease, move)
            motion = stack.enter_context(origins_of(scene).moving(move.role))
        except BaseException:
            _stop_driver(shell, plan.job)
            raise
        yield from _out_and_back(scene, testbed, shell, plan.job, drive_lease, move, motion)


def _wait_until_ready(scene: Scene, drive_lease: DriveLease, move: Move) -> None:
    """Wait until a robot is stationary at its place, and record its origin before its first start there.

    Raises the same errors as `drive_robot`.
    """
    drive_lease.wait(lambda: drive_lease.is_ready or drive_lease.final_state, Deadline.after(START_S))
    if drive_lease.is_refused:
        origins_of(scene).refuse(move.role, drive_lease.final_state)
        raise MotionHeldError(
            f"it does not start: {drive_lease.final_state}",
            where=scene.robot(move.role).name,
            remedy="put it at its place with its initial direction, then resume without --yes and confirm it",
        )
    drive_lease.check_running()
    if not drive_lease.is_ready:
        raise drive_lease.failure(f"it did not report within {START_S:g} s that it is stationary at its place")
    if origins_of(scene).robots_stay and origins_of(scene).get(move.role) is None:
        pose = drive_lease.pose
        if pose is None:
            raise drive_lease.failure("its driver does not report its position")
        origins_of(scene).record(move.role, pose)


def _out_and_back(  # noqa: PLR0917 (all of them belong to one motion)
    scene: Scene, testbed: Testbed, shell: Shell, job: Job, drive_lease: DriveLease, move: Move, motion: RobotMotion
) -> Iterator[DriveLease]:
    """Drive a robot along its path while the body runs, then back; see `drive_robot`."""

    def bring_back() -> str:
        final_state = _bring_back(testbed, shell, job, drive_lease, move, in_lab=not origins_of(scene).robots_stay)
        if final_state == drive_log.HOME:
            motion.mark_ended(drive_lease.pose)
        elif drive_lease.status.get("ended"):  # the robot has stopped on its path, and reported its pose
            motion.at = drive_lease.pose
        return final_state

    try:
        with suppress(LinkError, RobotError):  # each renewal repeats the order
            drive_lease.give_order(drive_plan.OUT)
        yield drive_lease
    except Exception as error:
        try:
            bring_back()
        except FieldkitError as second_error:
            second_error.what += f"; before that, the steps failed: {describe_exception(error)}"
            raise
        raise
    except BaseException:
        _stop_driver(shell, job)
        raise
    early_end = drive_lease.end_reason
    final_state = bring_back()
    if early_end or final_state != drive_log.HOME:
        reason = early_end or drive_lease.end_reason or "it stopped on its path: it was not back in time"
        raise drive_lease.failure(reason)


def _bring_back(
    testbed: Testbed, shell: Shell, job: Job, drive_lease: DriveLease, move: Move, *, in_lab: bool
) -> str:
    """Order a robot back, and return `DriveLease.final_state`.

    In a lab the testbed then puts the robot at its exact place, whether it came back or not. A real robot that did
    not come back stays where it is: before robots move again, a person is asked to put it at its place
    (`fieldkit.motion.running.permission`).
    """
    drive_lease.turn_back()
    drive_lease.wait(lambda: drive_lease.final_state, Deadline.after(START_S + limit_s(move)))
    final_state = drive_lease.final_state
    _stop_driver(shell, job)
    if in_lab or final_state == drive_log.HOME:
        testbed.bring_back(move.role, has_returned=final_state == drive_log.HOME)
    return final_state


def _stop_driver(shell: Shell, job: Job) -> None:
    """Stop the driver, which stops the robot; without the link, the robot stops when its lease expires."""
    with suppress(FieldkitError):
        jobs.stop(shell, job, grace_s=_GRACE_S)
