"""Drive a robot by its own velocity topic while other steps run: its agent steers, this laptop holds the lease."""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import MappingProxyType
from typing import Any, Final

from typing_extensions import override

from fieldkit.agent import drive_plan
from fieldkit.agent.drive_plan import DriveTask
from fieldkit.backends.driven import disturbed
from fieldkit.backends.protocols import Robot, Testbed
from fieldkit.config.profiles import Drive
from fieldkit.core import geometry
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, LinkError, MotionHeldError, RobotError
from fieldkit.core.model import MotionOrigin, Move
from fieldkit.core.text import JSON_ERRORS, brief
from fieldkit.measure.motion import drive_log
from fieldkit.remote import agent, jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import lease, streams
from fieldkit.steps.lease import HeldLease, orders_file
from fieldkit.steps.middlewares import Over
from fieldkit.steps.motions import Mover
from fieldkit.steps.origins import RobotMotion
from fieldkit.steps.scene import BY_FIELDKIT, BY_ITSELF, Planned, Refusal, Scene

ODOMETRY_S: Final = 0.5
"""A robot whose odometry is silent for so long stands."""

_TURN_S: Final = 12.0
"""What a turn at a corner may take: half a turn at 0.3 rad/s."""
_SLACK_S: Final = 20.0
_START_S: Final = 40.0
"""Starting Python, the middleware, and both topics."""
_RENEWALS: Final = 5
"""So often a lease is renewed in its time."""
_GRACE_S: Final = 3.0
_SILENT_S: Final = 10.0

_ZENOH_PORT: Final = 7447
"""Zenoh's own, at which rmw_zenoh's router listens."""

_NAMED: Final = MappingProxyType(
    {
        Over.ROS1: ("md5", "definition"),
        Over.DDS: ("members", "dds_topic", "dds_types", "user_data"),
        Over.ZENOH: ("key", "tokens"),
    }
)
"""What each middleware wants to know of a topic: command lines are for people, too."""

_STATUS: Final = "drive.status"
_TEXT: Final = "drive.log"


def over(robot: Robot) -> Over:
    """Return the middleware that a robot's base listens to."""
    ros = robot.profile.ros
    if ros is None or ros.variant == "ros1":
        return Over.ROS1
    return Over(ros.middleware)


def limit_s(move: Move) -> float:
    """Return how long one way of a move may take, in seconds, before the robot stops."""
    return 2 * geometry.length_m(move) / move.speed_m_s + _TURN_S * (len(move.legs) + 1) + _SLACK_S


def way_s(robot: Robot, move: Move) -> float:
    """Return how long a robot takes for one way of a move, with its turns, to the millisecond."""
    return round(drive_plan.way_s(DriveTask.from_json(_task(robot, move))), 3)


def planned(scene: Scene, move: Move, inside_s: float, name: str) -> Planned:
    """Return the job that drives a robot.

    Args:
        scene: The attempt.
        move: Where it drives, and how fast.
        inside_s: How long the steps inside may take.
        name: What names of the step's jobs and files begin with, as `Step.own_name` has it: `{}` stands for the rest.
    """
    robot = scene.robot(move.role)
    argv = (
        robot.profile.tools.python,
        agent.path_from_job(),
        "drive",
        _told(scene, move, name),
        name.format(drive_log.FILE),
    )
    setup = streams.setup(robot)
    job = Job(
        folder=scene.folder,
        name=name.format("drive"),
        argv=with_environment(argv, setup=setup, environment=robot.ros_environment),
        limit_s=_START_S + 2 * limit_s(move) + inside_s,
        log=name.format(_TEXT),
        ready="log:up,",
    )
    program = robot.profile.tools.python
    return Planned(move.role, job, program=program, setup=setup, ends=BY_ITSELF | BY_FIELDKIT)


def refusals(scene: Scene, move: Move) -> Iterator[Refusal]:
    """Yield why a robot may not drive by itself."""
    robot = scene.robot(move.role)
    limits = robot.profile.limits
    farthest_m = geometry.farthest_m(move.legs)
    if limits.fence_m is not None and farthest_m > limits.fence_m:
        yield Refusal(
            move.role,
            f"its fence is {limits.fence_m:g} m from its place, and it is to drive {farthest_m:g} m away",
            "a shorter way in the procedure; limits.fence_m in its profile says it, and the lawn must be as wide",
        )
    if why := disturbed(robot, scene.cast.values()):
        remedy = "give each its own topics, or ROS domain or master; or let somebody move it: without --allow-motion"
        yield Refusal(move.role, why, remedy)


def files(name: str) -> tuple[str, ...]:
    """Return the files that a drive leaves; see `planned` for the name."""
    return tuple(name.format(one) for one in (drive_log.FILE, orders_file("drive"), _STATUS, _TEXT))


def _drive(robot: Robot) -> Drive:
    """Return how a robot is driven.

    Raises:
        RobotError: Its profile does not say.
    """
    if robot.profile.drive is None:
        raise RobotError(
            "it cannot be driven", where=robot.name, remedy="add drive: and limits.fence_m to its profile"
        )
    return robot.profile.drive


def _origin(scene: Scene, move: Move) -> dict[str, Any]:
    """Return what of a task depends on the place of the robot in this trial."""
    origin, last = scene.origins.get(move.role), scene.origins.last(move.role)
    if origin is None or not scene.origins.kept:
        return {}
    places = {"origin": (origin.x_m, origin.y_m, origin.heading_rad)}
    if last is not None:
        places["last"] = (last.x_m, last.y_m, last.heading_rad)
    return {**places, "frame_id": origin.frame_id, "may_return": scene.origins.may_return}


def _task(robot: Robot, move: Move) -> dict[str, Any]:
    """Return what a robot is to drive, as `fieldkit.agent.steering.DriveTask` has it."""
    drive = _drive(robot)
    return {
        "legs": [(leg.away_m, leg.left_m) for leg in move.legs],
        "speed_m_s": move.speed_m_s,
        "turn_rad_s": drive.turn_rad_s,
        "acceleration_m_s2": drive.acceleration_m_s2,
        "fence_m": robot.profile.limits.fence_m,  # of which a profile that drives has one
        "lease_s": drive.lease,
        "odometry_s": ODOMETRY_S,
        "limit_s": limit_s(move),
    }


def _told(scene: Scene, move: Move, name: str) -> str:
    """Return the argument of the driver, as JSON."""
    from fieldkit.ros import topics, types  # noqa: PLC0415 (50 ms, and only a robot that drives needs it)
    from fieldkit.ros.qos import PROFILES  # noqa: PLC0415

    robot = scene.robot(move.role)
    drive = _drive(robot)
    way, ros = over(robot), robot.profile.ros
    known = types.MessageTypes(types.Distribution.of(ros.command.distribution)) if ros else types.shipped()
    network = _network(robot, way) | {"gid_bytes": known.distribution.gid_bytes}

    def topic(called: str, kind: str, profile: str, number: int) -> dict[str, Any]:
        described = topics.describe(
            known, called, kind, PROFILES[profile], domain=network["domain"], node=network["node"], number=number
        )
        return {key: described[key] for key in ("name", "type", "quality", *_NAMED[way])}

    told = {
        "over": way.value,
        "network": network,
        "cdr": way is not Over.ROS1,
        "command": topic(drive.topic, "geometry_msgs/msg/Twist", "default", 1),
        "odometry": topic(drive.odometry, "nav_msgs/msg/Odometry", "sensor_data", 2),
        "task": {**_task(robot, move), **_origin(scene, move)},
        "orders": orders_file(name.format("drive")),
        "status": name.format(_STATUS),
        "stationary": jobs.stationary_file(name.format("drive")),
    }
    return streams.compact(told)


def _network(robot: Robot, way: Over) -> dict[str, Any]:
    """Return how the driver finds the nodes of its own robot, also where nobody hears multicast."""
    found = {
        "address": robot.address,
        "domain": robot.profile.ros.domain if robot.profile.ros else 0,
        "node": f"fieldkit_drive_{robot.name}".replace("-", "_"),
    }
    if way is not Over.ZENOH:
        return found | {"peers": [robot.address]}
    # rmw_zenoh's router on the robot tells it of all sessions there; a session may be where a router would be.
    near = [f"tcp/{address}:{_ZENOH_PORT}" for address in ("127.0.0.1", robot.address)]
    own = {"connect/endpoints": streams.compact(near), "listen/endpoints": f'["tcp/{robot.address}:0"]'}
    return found | {"settings": own}


class DriveLease(HeldLease):
    """Holds the program that drives a robot, which waits at first.

    Args:
        shell: The robot.
        job: The program, which runs.
        name: See `planned`.
        lease_s: The robot stops where it was not renewed for so long.
    """

    def __init__(self, shell: Shell, job: Job, name: str, lease_s: float) -> None:
        super().__init__(
            shell, job, says=name.format(_STATUS), order=drive_plan.WAIT, lease_s=lease_s, renewals=_RENEWALS
        )

    def turn_back(self) -> None:
        """Want the robot at its place again; where it does not hear of it now, it does with a renewal, or stops."""
        with suppress(LinkError, RobotError):
            self.order(drive_plan.BACK)

    @property
    def is_ready(self) -> bool:
        """Whether the robot is stationary, and where it must be to start."""
        return self.status.get("ready") is True

    @property
    def is_refused(self) -> bool:
        """Whether the robot did not start because it is not where it must be."""
        return self.status.get("refused") is True

    @property
    def pose(self) -> MotionOrigin | None:
        """Where the robot was when it reported last, in the frame of its odometry; None if it did not report that."""
        status = self.status
        try:
            x_m, y_m, yaw_rad = map(float, status["pose"])
            frame_id = status["frame_id"]
        except (KeyError, TypeError, ValueError):
            return None
        if not isinstance(frame_id, str) or not all(map(math.isfinite, (x_m, y_m, yaw_rad))):
            return None
        return MotionOrigin("odometry", brief(frame_id), x_m, y_m, yaw_rad)

    @property
    def status(self) -> dict[str, Any]:
        """What the program said last of how far the robot is; empty before that."""
        return _read(self.said)

    @property
    def why(self) -> str:
        """Why the robot is at its end, `home` where it is back; empty while it is not.

        A driver writes its status ten times a second: one that does not has ended, or is out of reach.
        """
        status, silent_s = self.status, self.unchanged_s
        if isinstance(ended := status.get("ended"), str) and ended:
            return brief(ended)
        if silent_s > (_SILENT_S if status else _START_S):
            return f"nothing was heard of its driver for {silent_s:.0f} s"
        return super().over

    @property
    @override
    def over(self) -> str:
        return "" if self.why in {"", drive_log.HOME} else f"it stopped on its way: {self.why}"

    def wait(self, condition: Callable[[], object], deadline: Deadline) -> None:
        """Wait until something holds, or the deadline has passed."""
        while not condition() and not deadline.expired:
            self.pause()
            # Where the link is gone the robot stops by itself, and its driver says why; the link may come back.
            with suppress(LinkError, RobotError):
                self.look()


def _read(said: bytes) -> dict[str, Any]:
    """Return what a driver wrote of itself; nothing where it is not whole."""
    try:
        found = json.loads(said)
    except JSON_ERRORS:
        return {}
    return found if isinstance(found, dict) else {}


@contextmanager
def driven(scene: Scene, testbed: Testbed, plan: Planned, move: Move, name: str) -> Iterator[DriveLease]:
    """Let a robot drive while the body runs, which is given its lease, and come back to its place afterwards.

    Whatever ends the body but an interruption, the robot drives back; one that cannot is brought by the operator.
    One that is interrupted stands where it is.

    Raises:
        LinkError: The robot did not answer.
        RobotError: It could not be driven, or stopped by itself before the body had ended.
        MotionHeldError: It is not where it must be to start, or robots may not move before a person confirms it.
        OSError: The journal of motions cannot be written; the robot does not start.
    """
    shell, robot = testbed.shells[move.role], scene.robot(move.role)
    lease_s = robot.profile.drive.lease if robot.profile.drive else 0.0
    mover = Mover(robot.name, shell, scene.folder, f"it stops by itself within {lease_s:g} s")
    held = DriveLease(shell, plan.job, name, lease_s)
    with scene.motions.moving(mover), lease.started(shell, plan.job), held, ExitStack() as stack:
        try:
            _commit(scene, held, move)
            motion = stack.enter_context(scene.origins.moving(move.role))
        except BaseException:
            _end(shell, plan.job)
            raise
        yield from _moving(scene, testbed, shell, plan.job, held, move, motion)


def _commit(scene: Scene, held: DriveLease, move: Move) -> None:
    """Wait until a robot is stationary at its place, and record its origin before its first start there."""
    held.wait(lambda: held.is_ready or held.why, Deadline.after(_START_S))
    if held.is_refused:
        scene.origins.refuse(move.role, held.why)
        raise MotionHeldError(
            f"it does not start: {held.why}",
            where=scene.robot(move.role).name,
            remedy="put it at its place, facing as in the beginning, then resume without --yes and confirm it",
        )
    held.demand()
    if not held.is_ready:
        raise held.failure(f"it was not stationary for {_START_S:g} s")
    if scene.origins.kept and scene.origins.get(move.role) is None:
        pose = held.pose
        if pose is None:
            raise held.failure("its driver does not report where it is")
        scene.origins.record(move.role, pose)


def _moving(  # noqa: PLR0917 (the parts of one motion)
    scene: Scene, testbed: Testbed, shell: Shell, job: Job, held: DriveLease, move: Move, motion: RobotMotion
) -> Iterator[DriveLease]:
    """Let a robot drive while the body runs, and back; see `driven`."""

    def bring_back() -> str:
        came = _bring_back(testbed, shell, job, held, move, by_hand=not scene.origins.kept)
        if came == drive_log.HOME:
            motion.ended(held.pose)
        elif held.status.get("ended"):
            motion.at = held.pose
        return came

    try:
        with suppress(LinkError, RobotError):  # it is given again with each renewal
            held.order(drive_plan.OUT)
        yield held
    except Exception:
        bring_back()
        raise
    except BaseException:
        _end(shell, job)
        raise
    early = held.over
    came = bring_back()
    if early or came != drive_log.HOME:
        raise held.failure(early or held.over or "it stopped on its way: it is not back in time")


def _bring_back(testbed: Testbed, shell: Shell, job: Job, held: DriveLease, move: Move, *, by_hand: bool) -> str:
    """Let a robot drive back, or be brought; return `DriveLease.why`.

    With `by_hand` false a robot that did not come back stays where it is: before robots move again a person is asked
    to put it at its place (`fieldkit.trial.running.motion_leave`).
    """
    held.turn_back()
    held.wait(lambda: held.why, Deadline.after(_START_S + limit_s(move)))
    why = held.why
    _end(shell, job)
    if by_hand or why == drive_log.HOME:
        testbed.bring_back(move.role, by_itself=why == drive_log.HOME)
    return why


def _end(shell: Shell, job: Job) -> None:
    """End the driver, which lets the robot stand; where the link is gone it does that by itself."""
    with suppress(FieldkitError):
        jobs.stop(shell, job, grace_s=_GRACE_S)
