"""A drone in a physics simulator, whose time is that of a simulated clock."""

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from typing_extensions import override

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.mavlink_server import PhysicsFiles, simulated_airframe
from sim_backends.emulated.cosimulated.clock import RealTime
from sim_backends.emulated.cosimulated.lab_physics import LabPhysics, StartPhysics
from sim_backends.emulated.cosimulated.simulators import LabSettings, RobotBody, Simulators, start_physics
from sim_backends.emulated.cosimulated.steering import FlightSteering
from sim_backends.emulated.cosimulated.velocity_flights import VelocityFlights
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.robot_motion import MotionReporter
from sim_backends.federates.protocols import PhysicsFederate
from sim_backends.physics.body import Velocity
from sim_backends.physics.quadrotor import Quadrotor
from sim_backends.physics.robot_limits import DUCKIEDRONE
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State
from tests.helpers.cosim_benches import ControlFiles
from tests.helpers.ground_station import HOME_M, GroundStation

DRONE: Final = RobotBody("duckiedrone", DUCKIEDRONE)
NAME: Final = "drone"
START_M: Final[Vector] = (*HOME_M[:2], HOME_M[2] + ANTENNA_M)
"""Start of its antenna."""


class VelocityPhysics:
    """A physics simulator like Gazebo: it moves a drone at its last commanded velocity, from one step later on.

    Args:
        start: State of the drone's antenna at time 0.
        wall_m: East coordinate that the antenna cannot pass.

    Attributes:
        step_ns: Time step.
        limits_m_s2: Acceleration limit of the drone.
        velocities: The commanded velocities.
    """

    def __init__(self, start: State, wall_m: float = math.inf) -> None:
        self.step_ns = 1_000_000
        self.limits_m_s2: Mapping[str, float] = {NAME: math.inf}
        self.velocities: list[Velocity] = []
        self._wall_m = wall_m
        self._position_m = start.position_m
        self._heading_rad = start.heading_rad or 0.0
        self._velocity = Velocity()
        self._step = 0

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Implement `PhysicsFederate.advance`."""
        self.velocities += commands.values()
        before_m, steps, elapsed_s = self._position_m, to_ns // self.step_ns - self._step, self.step_ns / 1e9
        for _ in range(steps):
            east_m, north_m, up_m = (
                position + elapsed_s * speed
                for position, speed in zip(self._position_m, self._velocity.velocity_m_s, strict=True)
            )
            self._position_m = min(east_m, self._wall_m), north_m, max(up_m, ANTENNA_M)
            self._velocity = self.velocities[-1] if self.velocities else Velocity()
            if self._velocity.yaw_rad is not None:
                self._heading_rad = self._velocity.yaw_rad
        self._step += steps
        east, north, up = (
            (now - before) / (max(steps, 1) * elapsed_s)
            for now, before in zip(self._position_m, before_m, strict=True)
        )
        return {NAME: State(self._position_m, (east, north, up), self._heading_rad)}


def start_velocity_physics(states: Mapping[str, State]) -> PhysicsFederate:
    """Start a `VelocityPhysics` whose drone follows an autopilot."""
    state = states[NAME]
    (east_m, north_m, up_m), heading_rad = state.position_m, state.heading_rad or 0.0
    body = Quadrotor(DUCKIEDRONE, (east_m, north_m, up_m - ANTENNA_M), heading_rad, antenna_m=ANTENNA_M)
    return VelocityFlights(VelocityPhysics(state), {NAME: body}, None)


def starter(simulator: str) -> StartPhysics:
    """Return the function that starts a physics simulator: `kinematic`, `mujoco` or `velocities`."""
    if simulator == "velocities":
        return start_velocity_physics
    settings = LabSettings(
        Simulators(simulator, "builtin"),
        seed=1,
        options=RadioOptions(),
        world=None,
        antennas={},
        bodies={NAME: DRONE},
        relay=None,
    )
    return lambda states: start_physics(settings, states)


class _Clock(RealTime):
    """A clock whose simulated time is the monotonic time.

    Args:
        now_ns: Returns the current time.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        super().__init__()
        self.epoch_ns = 0
        self._now_ns = now_ns

    @override
    def now_ns(self) -> int:
        return self._now_ns()


class PhysicsStation(GroundStation):
    """A ground station of a drone that a physics simulator moves.

    Args:
        files: Files between the autopilot and the physics simulator; the drone is placed at `START_M`.
        simulator: The physics simulator, as in `starter`.
        firmware: Family of the autopilot.
    """

    def __init__(self, files: ControlFiles, simulator: str, firmware: Firmware) -> None:
        folder = files.folder
        reporter = MotionReporter(folder / "motion", folder / "steered", 0)
        assert reporter.poll_placement(0) is not None
        physics_files = PhysicsFiles(folder / "flight_command", folder / "flown")
        super().__init__(firmware=firmware, make_airframe=simulated_airframe("duckiedrone", physics_files, reporter))
        self._physics = LabPhysics(
            starter(simulator),
            {NAME: FlightSteering(files.descriptors, 0)},
            (NAME,),
            (NAME,),
            step_ns=1_000_000,
            clock=_Clock(lambda: self.now_ns),
        )
        self._physics.place({NAME: State(START_M)}, frozenset({NAME}))

    @override
    def advance_world(self) -> None:
        self._physics.advance(self.now_ns, {})


@contextmanager
def physics_station(folder: Path, simulator: str, firmware: Firmware) -> Iterator[GroundStation]:
    """Yield a ground station, 2 s after its drone was switched on.

    Args:
        folder: An empty folder.
        simulator: The physics simulator, as in `starter`; `none` if the autopilot moves the drone itself.
        firmware: Family of the autopilot.
    """
    if simulator == "none":
        own_station = GroundStation(firmware=firmware)
        own_station.wait(2)
        yield own_station
        return
    files = ControlFiles.make(folder / NAME, "flight_command", "flown")
    files.assign(START_M, math.pi / 2)
    try:
        station = PhysicsStation(files, simulator, firmware)
        station.wait(2)
        yield station
    finally:
        for fd in files.descriptors[:2]:  # the records close the others
            os.close(fd)
