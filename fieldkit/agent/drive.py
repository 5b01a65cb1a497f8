"""Drive a ground robot along its way by its velocity topic, in a closed loop on its odometry.

The laptop says again and again what it wants (`orders`). Where it does not for the lease of the task the robot
stands: its laptop is gone, or the link to it. Twists go out `RATE_HZ` times a second; a robot's own base stops when
they end.
"""

from __future__ import annotations

import json
import math
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Callable, Mapping

from fieldkit.agent.boot_clock import boot_id, now_s
from fieldkit.agent.drive_plan import ORDERS, DriveTask
from fieldkit.agent.middleware import Middleware, MiddlewareError, Publisher, Topic
from fieldkit.agent.numbered_lines import NumberedLines
from fieldkit.agent.orders import Orders
from fieldkit.agent.standstill import Standstill
from fieldkit.agent.steering import STAND, Driver, DriveVelocity, OdometryPose

RATE_HZ = 20.0
_ENDS_S = 0.5
"""For so long zero Twists are sent at the end: one may be lost."""
_BRAKES_S = 1.5
"""And for this long at most while odometry shows that the robot still moves."""
_PATIENCE_S = 15.0
"""Within this somebody hears the velocity, and odometry comes."""
_LOG_S = 0.1

_CDR_HEADER = b"\0\1\0\0"
_TWIST = struct.Struct("<6d")
_POSE = struct.Struct("<7d")
_LENGTH = struct.Struct("<I")
_LONGEST_TEXT = 1 << 16


def drive(middleware: Middleware, told: Mapping[str, Any], log: Path, over: threading.Event) -> str:
    """Drive until the robot is back home, something stops it, or `over` is set.

    Args:
        middleware: It has started.
        told: `command` and `odometry`, the topics; `task`, what is driven; `orders`, the laptop's file, and
            `status`, the file in which it finds how far the robot is; `stationary`, a file that is made when the
            robot is stationary at the end (it may be missing); `cdr`, whether messages are encoded as in
            ROS 2.
        log: What is written down, a line of JSON ten times a second.
        over: Set when it is to end.

    Returns:
        Why it ended before its end; empty where the robot is back home.

    Raises:
        MiddlewareError: Nobody hears the velocity topic, or no odometry comes.
        OSError: The log cannot be written; the robot stands.
    """
    cdr = bool(told["cdr"])
    publisher = middleware.publisher(Topic.from_json(told["command"]))
    heard: list[tuple[float, OdometryPose]] = []

    def take(data: bytes, _at_ns: int) -> None:
        pose = read_odometry(data, cdr=cdr)
        if pose is not None:
            heard.append((now_s(), pose))

    middleware.subscribe(Topic.from_json(told["odometry"]), take)
    _wait("nobody hears " + told["command"]["name"], lambda: publisher.matched() > 0, over)
    _wait("nothing comes from " + told["odometry"]["name"], lambda: bool(heard), over)
    task = DriveTask.from_json(told["task"])
    driver = Driver(task, now_s())
    orders, status = Orders(told["orders"], ORDERS, task.lease_s), Path(told["status"])
    with log.open("w", encoding="ascii") as file:
        lines = NumberedLines(file)
        logged_s, velocity = -math.inf, STAND
        if task.origin is not None and task.frame_id != boot_id():
            driver.odometry(*heard.pop(0))
            driver.refuse("its computer was restarted since its place was recorded, so its odometry is another one")
        try:
            while not driver.over and not over.is_set():
                turn_s = now_s()
                while heard:
                    driver.odometry(*heard.pop(0))
                if orders.look():
                    driver.renewed(turn_s, orders.order)
                velocity = driver.tick(turn_s)
                if over.is_set():  # the signal may have come while this process was suspended
                    velocity = STAND
                publisher.write(twist(velocity, cdr=cdr))
                if turn_s - logged_s >= _LOG_S:
                    logged_s = turn_s
                    _report(driver, velocity, lines, status)
                over.wait(1 / RATE_HZ)
        finally:
            _stand(publisher, heard, told.get("stationary", ""), cdr=cdr)
        stopped = driver.stopped or ("" if driver.phase == "home" else "ordered to stop")
        _report(driver, STAND, lines, status, ended=stopped or "home")
    return stopped


def twist(velocity: DriveVelocity, *, cdr: bool) -> bytes:
    """Return a `geometry_msgs/Twist`, serialized: linear x, y, z, then angular x, y, z."""
    body = _TWIST.pack(velocity.forward_m_s, 0.0, 0.0, 0.0, 0.0, velocity.turn_rad_s)
    return (_CDR_HEADER if cdr else b"") + body


def read_odometry(data: bytes, *, cdr: bool) -> OdometryPose | None:
    """Return the pose in a `nav_msgs/Odometry`; None where it is none.

    Before it stand a header (in ROS 1 with a number before its time), the name of its frame and that of the robot's;
    the strings have their length before them, in CDR with the zero at their end, and doubles are aligned to 8 there.
    """
    if cdr and data[:4] != _CDR_HEADER:
        return None
    body = data[4:] if cdr else data
    at = 8 if cdr else 12
    try:
        for _ in range(2):
            at += -at % 4 if cdr else 0
            (length,) = _LENGTH.unpack_from(body, at)
            if length > _LONGEST_TEXT:
                return None
            at += 4 + length
        x_m, y_m, _, x, y, z, w = _POSE.unpack_from(body, at + (-at % 8 if cdr else 0))
    except struct.error:
        return None
    if not all(map(math.isfinite, (x_m, y_m, x, y, z, w))):
        return None
    return OdometryPose(x_m, y_m, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _wait(what: str, condition: Callable[[], bool], over: threading.Event) -> None:
    deadline_s = time.monotonic() + _PATIENCE_S
    while not condition():
        if over.wait(0.02) or time.monotonic() > deadline_s:
            raise MiddlewareError(what)


def _stand(publisher: Publisher, heard: list[tuple[float, OdometryPose]], confirm: str, *, cdr: bool) -> None:
    """Send zero velocities until the robot is stationary, for `_ENDS_S` at least and `_BRAKES_S` at most.

    Args:
        publisher: Of the velocity topic.
        heard: Poses of the odometry, which other threads append.
        confirm: File that is made when the robot is stationary; empty for none.
        cdr: See `twist`.
    """
    began_s, standstill, confirmed = time.monotonic(), Standstill(), False
    heard.clear()  # poses from before the first zero
    while True:
        publisher.write(twist(STAND, cdr=cdr))
        while heard:
            standstill.odometry(*heard.pop(0))
        if standstill.stationary and not confirmed:
            confirmed = True
            if confirm:
                with suppress(OSError):  # a full disk is no reason to send no more zeros
                    Path(confirm).touch()
        lasted_s = time.monotonic() - began_s
        if lasted_s >= _BRAKES_S or (confirmed and lasted_s >= _ENDS_S):
            return
        time.sleep(1 / RATE_HZ)


def _report(driver: Driver, velocity: DriveVelocity, lines: NumberedLines, status: Path, ended: str = "") -> None:
    """Write where the robot is, to the log from its start on, and to the status for the laptop.

    The status has in addition: `pose`, in the frame of the odometry; `frame_id`; `ready`, whether the robot is
    stationary and may start; `refused`, whether it did not start because it is not where it must be.
    """
    here, pose = driver.here, driver.pose
    if here is None or pose is None:
        return  # before its origin is known
    line = {
        "utc_ns": time.time_ns(),
        "at_s": round(driver.lasted_s, 3),
        "phase": driver.phase,
        "x_m": round(here.x_m, 4),
        "y_m": round(here.y_m, 4),
        "yaw_rad": round(here.yaw_rad, 4),
        "forward_m_s": round(velocity.forward_m_s, 4),
        "turn_rad_s": round(velocity.turn_rad_s, 4),
        "driven_m": round(driver.driven_m, 3),
        "left_m": round(driver.left_m, 4),
        "ended": ended,
    }
    if ended:
        lines.end(line)
    elif driver.phase not in ("waits", "returns"):
        lines.write(line)
    more = {
        "pose": [round(value, 6) for value in pose],
        "frame_id": boot_id(),
        "ready": driver.ready,
        "refused": driver.refused,
    }
    beside = status.with_name(status.name + ".new")
    beside.write_text(json.dumps({**line, **more}) + "\n", encoding="ascii")
    beside.replace(status)
