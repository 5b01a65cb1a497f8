"""Drive a ground robot along its path through its velocity topic, in a closed loop with its odometry.

The laptop renews its order repeatedly (`orders`). If no order arrives within the lease of the task, the robot stops,
because the laptop or the link to it is probably lost. Velocities are published `RATE_HZ` times per second. If this
program is killed, only the base can stop the robot: it must have a timeout for velocities (docs/stopping.md).
"""

from __future__ import annotations

import json
import math
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Callable, Mapping

from fieldkit.agent.boot_clock import boot_id, now_s
from fieldkit.agent.driving.drive_messages import VelocityEncoder, read_odometry
from fieldkit.agent.driving.drive_plan import ORDERS, DriveTask
from fieldkit.agent.driving.standstill import Standstill
from fieldkit.agent.driving.steering import ZERO_VELOCITY, Driver, DriveVelocity, OdometryPose
from fieldkit.agent.messaging.middleware import Middleware, MiddlewareError, Publisher, Topic
from fieldkit.agent.numbered_lines import NumberedLines
from fieldkit.agent.orders import Orders

RATE_HZ = 20.0
_MIN_STOP_S = 0.5
"""Minimum time for which zero velocities are published at the end, because a single message may be lost."""
_MAX_STOP_S = 1.5
"""Maximum time for which zero velocities are published if odometry does not show that the robot is stationary."""
_TIMEOUT_S = 15.0
"""Timeout for a subscription to the velocity topic, and for the first odometry."""
_LOG_INTERVAL_S = 0.1


def drive(middleware: Middleware, arguments: Mapping[str, Any], log: Path, stop_event: threading.Event) -> str:
    """Drive until the robot is back at its origin, a limit or the order `end` stops it, or `stop_event` is set.

    Args:
        middleware: The started middleware.
        arguments: `command` and `odometry`, the topics; `frame`, the frame id of velocities (needed only if they have
            a header); `task`, the `DriveTask`; `orders`, the file that the laptop writes; `status`, the file with the
            progress, which the laptop reads; `stationary`, a file that is created when the robot is stationary at the
            end (optional); `cdr`, True if messages are encoded in CDR as in ROS 2, False for ROS 1.
        log: The log file: a line of JSON ten times per second while the robot is on its path, and a last line.
        stop_event: Set when the drive must end.

    Returns:
        The reason why the drive ended early; empty if the robot is back at its origin.

    Raises:
        DriveCancelledError: `stop_event` was set before the start; no velocity was published.
        MiddlewareError: The velocity topic has no subscription, or no odometry arrives.
        OSError: The log or the status file cannot be written; the robot was stopped if it was driving.
    """
    cdr = bool(arguments["cdr"])
    command = Topic.from_json(arguments["command"])
    publisher = _VelocityPublisher(
        middleware.publisher(command), VelocityEncoder(command.type, arguments.get("frame", ""), cdr=cdr)
    )
    poses: list[tuple[float, OdometryPose]] = []

    def on_odometry(data: bytes, _at_ns: int) -> None:
        pose = read_odometry(data, cdr=cdr)
        if pose is not None:
            poses.append((now_s(), pose))

    middleware.subscribe(Topic.from_json(arguments["odometry"]), on_odometry)
    _wait_for_subscription(middleware, publisher, command, stop_event)
    if not _wait_until(lambda: bool(poses), stop_event):
        raise MiddlewareError("no odometry arrives on " + arguments["odometry"]["name"])
    task = DriveTask.from_json(arguments["task"])
    driver = Driver(task, now_s())
    orders, status = Orders(arguments["orders"], ORDERS, task.lease_s), Path(arguments["status"])
    with log.open("w", encoding="ascii") as file:
        lines = NumberedLines(file)
        logged_s, velocity = -math.inf, ZERO_VELOCITY
        if task.origin is not None and task.frame_id != boot_id():
            driver.on_odometry(*poses.pop(0))
            driver.refuse(
                "its computer was restarted after its origin was recorded, so its odometry uses another frame"
            )
        try:
            while not driver.is_finished and not stop_event.is_set():
                iteration_s = now_s()
                while poses:
                    driver.on_odometry(*poses.pop(0))
                if orders.poll():
                    driver.on_order(iteration_s, orders.order)
                velocity = driver.tick(iteration_s)
                if stop_event.is_set():  # the signal may have arrived while this process was suspended
                    velocity = ZERO_VELOCITY
                publisher.write(velocity)
                if iteration_s - logged_s >= _LOG_INTERVAL_S:
                    logged_s = iteration_s
                    _report(driver, velocity, lines, status)
                stop_event.wait(1 / RATE_HZ)
        finally:
            _stop_robot(publisher, poses, arguments.get("stationary", ""))
        stop_reason = driver.stop_reason or ("" if driver.phase == "home" else "ordered to stop")
        _report(driver, ZERO_VELOCITY, lines, status, end_reason=stop_reason or "home")
    return stop_reason


class DriveCancelledError(Exception):
    """`stop_event` was set before the start: the robot was not driven."""


class _VelocityPublisher:
    """Publishes velocities with the time of the robot's clock."""

    def __init__(self, publisher: Publisher, encoder: VelocityEncoder) -> None:
        self.matched = publisher.matched
        self._publisher = publisher
        self._encoder = encoder

    def write(self, velocity: DriveVelocity) -> None:
        self._publisher.write(self._encoder.encode(velocity, time.time_ns()))


def _wait_for_subscription(
    middleware: Middleware, publisher: _VelocityPublisher, command: Topic, stop_event: threading.Event
) -> None:
    """Wait until the base of the robot has subscribed to the velocity topic.

    Raises:
        DriveCancelledError: `stop_event` was set.
        MiddlewareError: The base has not subscribed in time. If the topic has endpoints of other types, the message
            lists these types.
    """
    if _wait_until(lambda: publisher.matched() > 0, stop_event):
        return
    other_types = middleware.other_types(command)
    hint = (
        f", but it has endpoints of type {', '.join(sorted(other_types))}: change drive.type in the robot's profile"
    )
    raise MiddlewareError(f"{command.name} has no subscription of {command.type}{hint if other_types else ''}")


def _wait_until(condition: Callable[[], bool], stop_event: threading.Event) -> bool:
    """Return True when the condition is true, False after `_TIMEOUT_S`.

    Raises:
        DriveCancelledError: `stop_event` was set.
    """
    deadline_s = time.monotonic() + _TIMEOUT_S
    while not condition():
        if stop_event.wait(0.02):
            raise DriveCancelledError
        if time.monotonic() > deadline_s:
            return False
    return True


def _stop_robot(publisher: _VelocityPublisher, poses: list[tuple[float, OdometryPose]], stationary_file: str) -> None:
    """Publish zero velocities until the robot is stationary, for at least `_MIN_STOP_S` and at most `_MAX_STOP_S`.

    Args:
        publisher: The publisher of the velocity topic.
        poses: Poses of the odometry, which other threads append.
        stationary_file: A file that is created when the robot is stationary; empty to create none.
    """
    start_s, standstill, is_confirmed = time.monotonic(), Standstill(), False
    poses.clear()  # these poses are older than the first zero velocity
    while True:
        publisher.write(ZERO_VELOCITY)
        while poses:
            standstill.add_pose(*poses.pop(0))
        if standstill.stationary and not is_confirmed:
            is_confirmed = True
            if stationary_file:
                with suppress(OSError):  # zero velocities must be published even if the disk is full
                    Path(stationary_file).touch()
        elapsed_s = time.monotonic() - start_s
        if elapsed_s >= _MAX_STOP_S or (is_confirmed and elapsed_s >= _MIN_STOP_S):
            return
        time.sleep(1 / RATE_HZ)


def _report(
    driver: Driver, velocity: DriveVelocity, lines: NumberedLines, status: Path, end_reason: str = ""
) -> None:
    """Write the state of the drive to the status file for the laptop, and to the log while the robot is on its path.

    The last state, which has an `end_reason`, is written to the log in any phase. Nothing is written before the
    origin is known. The status also contains `pose`, the pose in the frame of the odometry; `frame_id`, the boot ID,
    which identifies this frame because odometry restarts at each boot; `ready`, True if the robot is stationary and
    may start; and `refused`, True if it did not start because it is not at the required place, or because its
    odometry uses another frame than its origin.
    """
    relative_pose, pose = driver.relative_pose, driver.pose
    if relative_pose is None or pose is None:
        return  # its origin is not known yet
    line = {
        "utc_ns": time.time_ns(),
        "at_s": round(driver.elapsed_s, 3),
        "phase": driver.phase,
        "x_m": round(relative_pose.x_m, 4),
        "y_m": round(relative_pose.y_m, 4),
        "yaw_rad": round(relative_pose.yaw_rad, 4),
        "forward_m_s": round(velocity.forward_m_s, 4),
        "turn_rad_s": round(velocity.turn_rad_s, 4),
        "driven_m": round(driver.driven_m, 3),
        "left_m": round(driver.remaining_m, 4),
        "ended": end_reason,
    }
    if end_reason:
        lines.end(line)
    elif driver.phase not in ("waits", "returns"):
        lines.write(line)
    status_fields = {
        "pose": [round(value, 6) for value in pose],
        "frame_id": boot_id(),
        "ready": driver.ready,
        "refused": driver.refused,
    }
    new_status = status.with_name(status.name + ".new")
    new_status.write_text(json.dumps({**line, **status_fields}) + "\n", encoding="ascii")
    new_status.replace(status)
