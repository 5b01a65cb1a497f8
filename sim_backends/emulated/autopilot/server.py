"""The autopilot at its UDP port: the process in an emulated drone that flies it and talks with ground stations."""

import contextlib
import selectors
import socket
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sim_backends.emulated.ros.helm import Helm

if TYPE_CHECKING:
    from sim_backends.emulated.autopilot.autopilot import Autopilot
    from sim_backends.emulated.autopilot.port import Frame

_TICK_NS: Final = 20_000_000
"""How often it flies on while somebody listens, or while it flies."""

_MOST_BYTES: Final = 65_536
_AT_ONCE: Final = 64
"""Datagrams to take before it flies on: whoever floods it does not stop it in the air."""


@dataclass(frozen=True)
class Drone:
    """What an autopilot is told about the robot that it flies.

    Attributes:
        system: Its system id after power-on.
        port: Of UDP, at every address.
        autopilot: `px4` or `ardupilot`.
        profile: The name of its profile, by which its body is known.
        max_speed_m_s: Speed over the ground that the profile allows.
        max_height_m: Height above home that it allows; None where it does not say.
        fence_m: Distance from home that it allows; None as above.
        antenna_m: How far its antenna, which is where the lab says it is, is above its lowest point.
        world: What it flies in, as JSON.
        boot_s: Time from power-on until its position estimate has an origin.
    """

    system: int
    port: int
    autopilot: str
    profile: str
    max_speed_m_s: float
    max_height_m: float | None
    fence_m: float | None
    antenna_m: float
    world: str
    boot_s: float = 0.0


def serve(drone: Drone, *, motion: Path, steered: Path, ready: Path) -> None:
    """Serve for ever.

    Args:
        drone: What it flies.
        motion: The file in which the lab says where the robot stands (`own_motion.append_path`).
        steered: The file in which the robot says where it flies (`helm.Helm`).
        ready: Made when it serves.

    Raises:
        OSError: The port is taken.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint, selectors.DefaultSelector() as selector:
        endpoint.bind(("", drone.port))
        endpoint.setblocking(False)
        selector.register(endpoint, selectors.EVENT_READ)
        on_ns = time.monotonic_ns()
        ready.touch()
        selector.select()
        autopilot, helm = _load(drone, motion, steered, on_ns)
        while True:
            helm.look(time.monotonic_ns())
            _turn(autopilot, endpoint)
            helm.tell()
            selector.select(_wait_s(autopilot))


def _load(drone: Drone, motion: Path, steered: Path, on_ns: int) -> "tuple[Autopilot, DroneHelm]":
    """Return the autopilot, which has been on since `on_ns`.

    It is loaded when a client appears: the dialect takes 50 ms and 40 MB, the world as much, and most trials never
    connect to the drone.
    """
    from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER  # noqa: PLC0415
    from sim_backends.emulated.autopilot.autopilot import Autopilot  # noqa: PLC0415
    from sim_backends.emulated.autopilot.parameters import USUAL_M, FlightLimits  # noqa: PLC0415
    from sim_backends.emulated.autopilot.px4 import PX4  # noqa: PLC0415
    from sim_backends.physics.ground import Ground  # noqa: PLC0415
    from sim_backends.physics.known import quadrotor  # noqa: PLC0415
    from sim_backends.world.world import World  # noqa: PLC0415

    world = World.model_validate_json(drone.world) if drone.world else None
    autopilot = Autopilot(
        firmware={"px4": PX4, "ardupilot": ARDUCOPTER}[drone.autopilot],
        system=drone.system,
        limits=FlightLimits(drone.max_speed_m_s, drone.max_height_m or USUAL_M[0], drone.fence_m or USUAL_M[1]),
        can=quadrotor(drone.profile),
        around=Ground(world, None).around,
        now_ns=on_ns,
        boot_s=drone.boot_s,
    )
    return autopilot, DroneHelm(autopilot, Helm(motion, steered, time.monotonic_ns()), drone.antenna_m)


class DroneHelm:
    """Sees where the lab puts the drone, and tells it where it flies.

    Args:
        autopilot: Flies it.
        helm: How the lab is told.
        antenna_m: How far its antenna is above its lowest point.
    """

    def __init__(self, autopilot: "Autopilot", helm: Helm, antenna_m: float) -> None:
        self._vehicle = autopilot.vehicle
        self._helm = helm
        self._antenna_m = antenna_m
        self._flew = False

    def look(self, now_ns: int) -> None:
        """Begin anew where the lab has put the drone, if it has."""
        put = self._helm.put(now_ns)
        if put is not None:
            east_m, north_m, up_m = put.place_m
            self._vehicle.place((east_m, north_m, up_m - self._antenna_m), put.heading_rad, now_ns)
            self._flew = False

    def tell(self) -> None:
        """Tell the lab where the drone is while it flies, and once where it has come to stand."""
        body = self._vehicle.body
        if body.on_ground and not self._flew:
            return
        self._flew = not body.on_ground
        east_m, north_m, up_m = body.place_m
        antenna_m = (east_m, north_m, up_m + self._antenna_m)
        self._helm.say(
            body.now_ns, antenna_m, body.velocity_m_s, heading_rad=body.yaw_rad, turn_rad_s=body.turn_rad_s
        )


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
    vehicle = autopilot.vehicle
    if autopilot.next_ns() is None and not vehicle.armed and vehicle.body.on_ground:
        return None
    return _TICK_NS / 1e9
