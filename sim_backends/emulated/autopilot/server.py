"""The autopilot at its UDP port: the process in an emulated drone that ground stations talk with."""

import contextlib
import selectors
import socket
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sim_backends.emulated.ros.own_motion import Odometer

if TYPE_CHECKING:
    from sim_backends.emulated.autopilot.autopilot import Autopilot, Frame

_TICK_NS: Final = 20_000_000
"""How often it flies on while somebody listens, or while it flies."""

_MOST_BYTES: Final = 65_536
_AT_ONCE: Final = 64
"""Datagrams to take before it flies on: whoever floods it does not stop it in the air."""


def serve(*, system: int, port: int, max_speed_m_s: float, motion: Path, ready: Path) -> None:
    """Serve for ever.

    Args:
        system: Its MAVLink id.
        port: Of UDP, at every address.
        max_speed_m_s: Speed over the ground that the robot's profile allows.
        motion: The file in which the lab says where the robot stands (`own_motion.say`).
        ready: Made when it serves.

    Raises:
        OSError: The port is taken.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint, selectors.DefaultSelector() as selector:
        endpoint.bind(("", port))
        endpoint.setblocking(False)
        selector.register(endpoint, selectors.EVENT_READ)
        ready.touch()
        selector.select()
        # Loading the dialect takes 50 ms and 40 MB: most trials never talk with the drone.
        from sim_backends.emulated.autopilot.autopilot import Autopilot  # noqa: PLC0415

        now_ns = time.monotonic_ns()
        odometer = Odometer(motion, now_ns)
        home_m = odometer.at(now_ns).place_m
        autopilot = Autopilot(system=system, max_speed_m_s=max_speed_m_s, home_m=home_m, now_ns=now_ns)
        while True:
            if not autopilot.vehicle.armed:  # home is where the lab has put it
                autopilot.vehicle.home_m = odometer.at(time.monotonic_ns()).place_m
            _turn(autopilot, endpoint)
            selector.select(_wait_s(autopilot))


def _turn(autopilot: "Autopilot", endpoint: socket.socket) -> None:
    """Take what has come, and send what is due."""
    with contextlib.suppress(BlockingIOError):
        for _ in range(_AT_ONCE):
            datagram, sender = endpoint.recvfrom(_MOST_BYTES)
            _send(endpoint, autopilot.receive(datagram, sender, time.monotonic_ns()))
    _send(endpoint, autopilot.advance(time.monotonic_ns()))


def _send(endpoint: socket.socket, frames: "Iterable[Frame]") -> None:
    for address, frame in frames:
        # The radio is off, full, or nobody is there any more: a datagram is lost, as on the air.
        with contextlib.suppress(OSError):
            endpoint.sendto(frame, address)


def _wait_s(autopilot: "Autopilot") -> float | None:
    """Return how long to wait at most; a drone on the ground that nobody listens to takes no time."""
    if autopilot.next_ns() is None and not autopilot.vehicle.armed:
        return None
    return _TICK_NS / 1e9
