"""Process of the base of an emulated ground robot: receives velocities at a socket and drives the robot.

Each datagram contains six doubles, the fields of ROS's `Twist`. A relay that runs under Debian's Python imports this
module, so the module imports only the standard library and modules that do the same.
"""

import contextlib
import math
import select
import socket
import struct
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

from sim_backends.emulated.robot.spec import STATE, Base
from sim_backends.emulated.robot.velocity_command import VELOCITY_COMMAND, VelocityCommand, VelocityCommandRecord
from sim_backends.emulated.ros.robot_motion import MotionReporter

if TYPE_CHECKING:
    from sim_backends.emulated.robot.base_controller import BaseController

_TICK_S: Final = 0.02
"""Time between two records of the motion while the robot moves."""


def serve(base: Base, *, assigned_paths: Path, motion_record: Path, ready: Path) -> None:
    """Serve until the process is killed; while the robot is idle, the process sleeps.

    Args:
        base: Settings of the robot's base.
        assigned_paths: The file of the paths that the lab assigns (`assigned_path.append_path`).
        motion_record: The file in which the robot records its motion (`robot_motion.MotionReporter`).
        ready: File that is created when the base accepts velocities.

    Raises:
        OSError: The socket cannot be created.
    """
    CHANNEL.unlink(missing_ok=True)  # the file remains if an earlier process was killed
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.bind(str(CHANNEL))
        if base.is_simulated:
            ready.touch()
            _record_velocities(channel)
        channel.setblocking(False)
        reporter = MotionReporter(assigned_paths, motion_record, time.monotonic_ns())
        ready.touch()
        select.select([channel], [], [])
        # The physics need numpy, which uses 20 MB; most robots of most trials are never driven.
        from sim_backends.emulated.robot.base_controller import BaseController  # noqa: PLC0415

        controller = BaseController(base, time.monotonic_ns())
        while True:
            select.select([channel], [], [], None if controller.is_idle else _TICK_S)
            now_ns = time.monotonic_ns()
            if (placement := reporter.poll_placement(now_ns)) is not None:
                controller.reset(placement)
            _receive_velocities(channel, controller, now_ns)
            controller.advance(now_ns)
            _write_motion(reporter, controller, now_ns)


def _record_velocities(channel: socket.socket) -> NoReturn:
    """Record each velocity for the physics simulator, which limits it and stops the robot after the last one."""
    record = VelocityCommandRecord.open(VELOCITY_COMMAND)
    while True:
        velocity = unpack(channel.recv(BYTES + 1))
        if velocity is not None and all(map(math.isfinite, velocity)):
            record.write(VelocityCommand(time.monotonic_ns(), *velocity))


def _receive_velocities(channel: socket.socket, controller: "BaseController", now_ns: int) -> None:
    """Receive the pending velocities; the last one is used."""
    with contextlib.suppress(BlockingIOError):
        while True:
            if (velocity := unpack(channel.recv(BYTES + 1))) is not None:
                controller.set_velocity(now_ns, *velocity)


def _write_motion(reporter: MotionReporter, controller: "BaseController", now_ns: int) -> None:
    """Record the pose and the odometry of the robot."""
    pose = controller.pose
    reporter.write(
        now_ns,
        pose.place_m,
        pose.velocity_m_s,
        heading_rad=pose.heading_rad,
        turn_rad_s=pose.turn_rad_s,
        odometry=controller.odometry,
    )


CHANNEL: Final = Path(STATE, "velocities")
"""Socket at which the base receives velocities."""

_TWIST: Final = struct.Struct("<6d")
BYTES: Final = _TWIST.size
"""Length of a datagram. A receiver reads one byte more, so that it can detect and reject a longer datagram."""

STAMPED: Final = "geometry_msgs/TwistStamped"
"""Type of velocity messages with a time stamp."""

_MAX_AGE_NS: Final = 500_000_000
"""ROS's default `cmd_vel_timeout`."""


def is_outdated(stamp_ns: int, now_ns: int) -> bool:
    """Return True if a stamped velocity is too old for a base, by the rule of ROS 2's `diff_drive_controller`.

    A stamp of 0 means the time of arrival (`DiffDriveController::on_configure`).
    """
    return stamp_ns != 0 and now_ns - stamp_ns >= _MAX_AGE_NS


def pack(twist: Any) -> bytes:  # noqa: ANN401 (a `geometry_msgs/Twist` of rospy or of rosbags)
    """Return the datagram of a velocity: metres per second along x, y, z, and radians per second about them."""
    linear, angular = twist.linear, twist.angular
    return _TWIST.pack(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)


def unpack(datagram: bytes) -> tuple[float, float] | None:
    """Return forward speed and turn rate to the left, or None if the datagram has the wrong length."""
    if len(datagram) != BYTES:
        return None
    ahead_m_s, _, _, _, _, turn_rad_s = _TWIST.unpack(datagram)
    return ahead_m_s, turn_rad_s
