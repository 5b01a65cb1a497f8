"""UDP server of the autopilot: the process of an emulated drone that flies it and serves ground stations."""

import contextlib
import selectors
import socket
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.flight_records import FlightCommandRecord, FlightRecord
from sim_backends.emulated.ros.robot_motion import MotionReporter

if TYPE_CHECKING:
    from sim_backends.emulated.autopilot.autopilot import Autopilot
    from sim_backends.emulated.autopilot.flight import MakeAirframe
    from sim_backends.emulated.autopilot.mavlink_frames import Frame

_TICK_NS: Final = 20_000_000
"""Longest wait for a datagram while there are clients, or while the drone is armed or in the air."""

_MAX_BYTES: Final = 65_536
_BURST: Final = 64
"""Maximum number of datagrams between two calls that advance the flight, so that a flood does not stop the flight."""


class PhysicsFiles(NamedTuple):
    """The files by which an autopilot and the physics simulator that moves its drone communicate.

    Attributes:
        commands: File of `FlightCommandRecord`, which the autopilot writes.
        flight: File of `FlightRecord`, which the physics simulator writes.
    """

    commands: Path
    flight: Path


@dataclass(frozen=True)
class Drone:
    """Settings of an autopilot and its drone.

    Attributes:
        system: System id after power-on.
        port: UDP port, on all addresses.
        autopilot: `px4` or `ardupilot`.
        profile: Name of the robot's profile, which determines its airframe.
        max_speed_m_s: Maximum ground speed of the profile.
        max_height_m: Maximum height above home; None if the profile does not limit it.
        fence_m: Maximum horizontal distance from home; None if the profile does not limit it.
        antenna_m: Height of the antenna above the lowest point of the drone; the lab's positions are those of
            antennas.
        world: World that it flies in, as JSON; empty if there are no obstacles.
        boot_s: Time from power-on until its position estimate has an origin.
        physics: The files for the physics simulator that moves the drone; None if the autopilot moves it.
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
    physics: PhysicsFiles | None = None


def serve(drone: Drone, *, assigned_paths: Path, motion_record: Path, ready: Path) -> None:
    """Serve until the process is killed.

    Args:
        drone: Settings of the drone.
        assigned_paths: The file of the paths that the lab assigns (`assigned_path.append_path`).
        motion_record: The file in which the robot records its motion (`robot_motion.MotionReporter`).
        ready: File that is created when the port is open.

    Raises:
        OSError: The port is in use.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint, selectors.DefaultSelector() as selector:
        endpoint.bind(("", drone.port))
        endpoint.setblocking(False)
        selector.register(endpoint, selectors.EVENT_READ)
        power_on_ns = time.monotonic_ns()
        ready.touch()
        selector.select()
        autopilot, reporter = _load(drone, assigned_paths, motion_record, power_on_ns)
        while True:
            reporter.read_placement(time.monotonic_ns())
            _exchange(autopilot, endpoint)
            if drone.physics is None:
                reporter.write_motion()
            selector.select(_wait_s(autopilot))


def _load(
    drone: Drone, assigned_paths: Path, motion_record: Path, power_on_ns: int
) -> "tuple[Autopilot, DroneMotionReporter]":
    """Return the autopilot, which has been on since `power_on_ns`.

    It is loaded when the first datagram has arrived, because the dialect and the world each need 50 ms and 40 MB, and
    in most trials no client sends a datagram to the drone.
    """
    from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER  # noqa: PLC0415
    from sim_backends.emulated.autopilot.autopilot import Autopilot  # noqa: PLC0415
    from sim_backends.emulated.autopilot.parameters import DEFAULT_LIMITS_M, FlightLimits  # noqa: PLC0415
    from sim_backends.emulated.autopilot.px4 import PX4  # noqa: PLC0415
    from sim_backends.physics.ground import Ground  # noqa: PLC0415
    from sim_backends.physics.robot_limits import quadrotor  # noqa: PLC0415
    from sim_backends.world.world import World  # noqa: PLC0415

    reporter = MotionReporter(assigned_paths, motion_record, time.monotonic_ns())
    world = World.model_validate_json(drone.world) if drone.world and drone.physics is None else None
    autopilot = Autopilot(
        firmware={"px4": PX4, "ardupilot": ARDUCOPTER}[drone.autopilot],
        system=drone.system,
        limits=FlightLimits(
            drone.max_speed_m_s, drone.max_height_m or DEFAULT_LIMITS_M[0], drone.fence_m or DEFAULT_LIMITS_M[1]
        ),
        airframe_limits=quadrotor(drone.profile),
        obstacles=Ground(world, None).obstacles,
        now_ns=power_on_ns,
        boot_s=drone.boot_s,
        make_airframe=None if drone.physics is None else simulated_airframe(drone.profile, drone.physics, reporter),
    )
    return autopilot, DroneMotionReporter(autopilot, reporter, drone.antenna_m)


def simulated_airframe(profile: str, files: PhysicsFiles, reporter: MotionReporter) -> "MakeAirframe":
    """Return the function that creates the airframe of a drone that a physics simulator moves."""
    from sim_backends.emulated.autopilot.simulated_airframe import SimulatedAirframe  # noqa: PLC0415 (see `_load`)
    from sim_backends.physics.robot_limits import quadrotor  # noqa: PLC0415

    limits = quadrotor(profile)
    commands, flight_record = FlightCommandRecord.open(files.commands), FlightRecord.open(files.flight)

    def make_airframe(place_m: Vector, facing_rad: float, now_ns: int) -> SimulatedAirframe:
        path_start_ns = reporter.path_start_ns
        return SimulatedAirframe(
            limits,
            place_m,
            facing_rad,
            now_ns,
            commands=commands,
            flight_record=flight_record,
            path_start_ns=path_start_ns,
        )

    return make_airframe


class DroneMotionReporter:
    """Reads the placements of the drone by the lab, and records its motion.

    Args:
        autopilot: The autopilot of the drone.
        reporter: Motion reporter of the robot.
        antenna_m: Height of the antenna above the lowest point of the drone.
    """

    def __init__(self, autopilot: "Autopilot", reporter: MotionReporter, antenna_m: float) -> None:
        self._vehicle = autopilot.vehicle
        self._reporter = reporter
        self._antenna_m = antenna_m
        self._was_flying = False

    def read_placement(self, now_ns: int) -> None:
        """Restart the drone at its new position if the lab has moved it."""
        placement = self._reporter.poll_placement(now_ns)
        if placement is not None:
            east_m, north_m, up_m = placement.position_m
            self._vehicle.place((east_m, north_m, up_m - self._antenna_m), placement.heading_rad, now_ns)
            self._was_flying = False

    def write_motion(self) -> None:
        """Record the motion of the drone while it flies, and once after it has come to rest."""
        body = self._vehicle.body
        if body.on_ground and not self._was_flying:
            return
        self._was_flying = not body.on_ground
        east_m, north_m, up_m = body.place_m
        antenna_m = (east_m, north_m, up_m + self._antenna_m)
        roll_rad, nose_up_rad = body.tilt_rad
        self._reporter.write(
            body.now_ns,
            antenna_m,
            body.velocity_m_s,
            heading_rad=body.yaw_rad,
            turn_rad_s=body.turn_rad_s,
            tilt_rad=(roll_rad, -nose_up_rad),
        )


def _exchange(autopilot: "Autopilot", endpoint: socket.socket) -> None:
    """Receive the pending datagrams, and send the frames that are due."""
    with contextlib.suppress(BlockingIOError):
        for _ in range(_BURST):
            datagram, sender = endpoint.recvfrom(_MAX_BYTES)
            _send(endpoint, autopilot.receive(datagram, sender, time.monotonic_ns()))
    _send(endpoint, autopilot.advance(time.monotonic_ns()))


def _send(endpoint: socket.socket, frames: "Iterable[Frame]") -> None:
    for address, frame in frames:
        # If the radio is off or full, or the client has exited, the datagram is lost, as on the air.
        with contextlib.suppress(OSError):
            endpoint.sendto(frame, address)


def _wait_s(autopilot: "Autopilot") -> float | None:
    """Return the maximum time to wait for a datagram.

    There is no limit (None) for a disarmed drone on the ground without clients.
    """
    vehicle = autopilot.vehicle
    if autopilot.next_ns() is None and not vehicle.is_armed and vehicle.body.on_ground:
        return None
    return _TICK_NS / 1e9
