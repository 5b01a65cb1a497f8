"""A drone in a physics simulator: a flight to a wall, a fall without power, and a lost autopilot."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.autopilot import Autopilot
from sim_backends.emulated.autopilot.flight import SetPoint
from sim_backends.emulated.autopilot.mavlink_server import DroneMotionReporter, PhysicsFiles, simulated_airframe
from sim_backends.emulated.autopilot.modes import Mode
from sim_backends.emulated.autopilot.px4 import PX4
from sim_backends.emulated.autopilot.vehicle import Vehicle
from sim_backends.emulated.cosimulated.simulators import RobotBody
from sim_backends.emulated.emulated_options import SyncOptions
from sim_backends.emulated.robot.base_controller import TIMEOUT_NS
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.flight_records import FlightMotion, FlightRecord
from sim_backends.emulated.ros.robot_motion import MotionReporter
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.named import command_line, default_options
from sim_backends.gazebo.sdf import SdfRobot, world_sdf
from sim_backends.physics.ground import Ground
from sim_backends.physics.robot_limits import DUCKIEDRONE
from sim_backends.world.motion import GRAVITY_M_S2
from sim_backends.world.world import load_world
from tests.helpers.cosim_benches import BODY, PLACES, ControlFiles, CosimBench, cosim_bench
from tests.helpers.gazebo_server import gazebo_server, missing_libraries
from tests.helpers.ground_station import LIMITS

pytestmark = pytest.mark.emulated

DRONE = RobotBody("duckiedrone", DUCKIEDRONE)
START_M: Vector = (2.5, 18.0, 0.0)
WALL_M = 3.9
"""East coordinate of the lawn's wall, which is 2 m high."""
HEIGHT_M = 1.0


@dataclass
class Drone:
    """An autopilot whose drone is in a physics simulator.

    Attributes:
        bench: The bench.
        autopilot: The autopilot.
        reporter: Reads the placements of the drone and reports its motion.
        advanced_ns: Time before the last advance of the autopilot, and thus before its last command.
    """

    bench: CosimBench
    autopilot: Autopilot
    reporter: DroneMotionReporter
    advanced_ns: int = 0

    @property
    def vehicle(self) -> Vehicle:
        return self.autopilot.vehicle

    def fly(self, until: Callable[[], bool], limit_s: float = 60.0) -> None:
        """Run the autopilot as its process does, until a condition is true."""
        deadline = Deadline.after(limit_s)
        while not until():
            assert not deadline.expired, f"{self.vehicle.mode} at {self.vehicle.body.place_m}"
            self.reporter.read_placement(time.monotonic_ns())
            self.advanced_ns = time.monotonic_ns()
            list(self.autopilot.advance(self.advanced_ns))
            time.sleep(0.02)

    def take_off(self) -> None:
        self.fly(lambda: self.vehicle.body.place_m == START_M)
        self.vehicle.arm()
        self.vehicle.take_off(HEIGHT_M)
        self.fly(lambda: self.vehicle.mode is Mode.LOITER)

    def flight(self) -> FlightMotion:
        """Return the motion that the physics simulator recorded last."""
        record = FlightRecord.open(self.bench.control_files.folder / "flown")
        try:
            flight = record.read()
        finally:
            record.close()
        assert flight is not None
        return flight

    def fall_to_ground(self) -> list[FlightMotion]:
        """Return the recorded motion until it has landed, without the autopilot."""
        flights, deadline = [self.flight()], Deadline.after(30)
        while not (flights[-1].is_supported and flights[-1].velocity_m_s == (0.0, 0.0, 0.0)):
            assert not deadline.expired, flights[-1]
            time.sleep(0.005)
            if (flight := self.flight()) != flights[-1]:
                flights.append(flight)
        return flights


@contextmanager
def physics_of(folder: Path, simulator: str) -> Iterator[dict[str, Any]]:
    """Start Gazebo if it is the simulator; yield the arguments of `cosim_bench` that choose the simulator."""
    if simulator != "gazebo":
        yield {"physics": simulator}
        return
    robots = {
        "a": SdfRobot(DUCKIEDRONE, START_M, 0.0),
        "b": SdfRobot(BODY.limits, (*PLACES["b"][:2], 0.0), 0.0),
    }
    (folder / "gazebo").mkdir()
    with gazebo_server(folder / "gazebo", world_sdf(load_world("lawn"), robots)) as server:
        yield {
            "physics": command_line("gazebo", PHYSICS),
            "physics_options": default_options("gazebo", PHYSICS) | server.options | {"velocity": "window"},
            "sync": SyncOptions.model_validate({"name": "sliding_window", "window": "10ms"}),
        }


@contextmanager
def drone(folder: Path, physics: str) -> Iterator[Drone]:
    place_m = (*START_M[:2], ANTENNA_M)
    places_m: dict[str, Vector] = {**PLACES, "a": place_m}
    control_files = ControlFiles.make(folder / "a", "flight_command", "flown")
    with (
        physics_of(folder, physics) as choice,
        cosim_bench(
            folder, world=load_world("lawn"), places_m=places_m, control_files=control_files, body=DRONE, **choice
        ) as bench,
    ):
        now_ns = time.monotonic_ns()
        motion = MotionReporter(control_files.folder / "motion", control_files.folder / "steered", now_ns)
        files = PhysicsFiles(control_files.folder / "flight_command", control_files.folder / "flown")
        autopilot = Autopilot(
            firmware=PX4,
            system=1,
            limits=LIMITS,
            airframe_limits=DUCKIEDRONE,
            obstacles=Ground(None, None).obstacles,
            now_ns=now_ns,
            make_airframe=simulated_airframe("duckiedrone", files, motion),
        )
        yield Drone(bench, autopilot, DroneMotionReporter(autopilot, motion, ANTENNA_M))


GAZEBO = pytest.param(
    "gazebo",
    marks=[pytest.mark.quiet, pytest.mark.skipif(bool(missing_libraries()), reason=missing_libraries())],
)
"""Without real-time priority, Gazebo is late on a busy machine, and a drone whose position is late oscillates."""


@pytest.mark.parametrize("physics", ["kinematic", "mujoco", GAZEBO])
def test_a_wall_stops_the_drone_and_without_its_autopilot_the_drone_falls(physics: str, tmp_path: Path) -> None:
    """Its rotors stop `TIMEOUT_NS` after the last command, and it falls for sqrt(2 h / g)."""
    with drone(tmp_path, physics) as simulated_drone:
        simulated_drone.take_off()
        vehicle = simulated_drone.vehicle
        assert vehicle.body.place_m == pytest.approx((*START_M[:2], HEIGHT_M), abs=0.15)
        nearest_m = WALL_M - DUCKIEDRONE.radius_m

        def push() -> bool:
            vehicle.accept_set_point(SetPoint((1.0, 0.0, 0.0), is_position=False))
            return vehicle.body.place_m[0] > nearest_m - 0.03

        push()
        vehicle.change_mode(Mode.OFFBOARD)
        simulated_drone.fly(push)
        end_ns = time.monotonic_ns() + 500_000_000
        simulated_drone.fly(lambda: not push() or time.monotonic_ns() > end_ns)
        assert time.monotonic_ns() > end_ns, "it stays at the wall"
        assert vehicle.body.place_m[0] < nearest_m + 0.02
        assert not vehicle.body.on_ground

        last_ns = simulated_drone.advanced_ns
        flights = simulated_drone.fall_to_ground()
        contact = next(flight for flight in flights if flight.is_supported)
        fall_s = math.sqrt(2 * flights[0].place_m[2] / GRAVITY_M_S2)
        # A busy machine detects the end of the commands later.
        assert fall_s - 0.1 < (contact.time_ns - last_ns - TIMEOUT_NS) / 1e9 < fall_s + 2.0
        for flight in flights:
            if (down_m_s := -flight.velocity_m_s[2]) > 2.0 and not flight.is_supported:
                fallen_m = flights[0].place_m[2] - flight.place_m[2]
                assert down_m_s == pytest.approx(math.sqrt(2 * GRAVITY_M_S2 * fallen_m), rel=0.15)
        assert flights[-1].place_m[2] == pytest.approx(0.0, abs=0.005)

        simulated_drone.bench.control_files.assign((*START_M[:2], ANTENNA_M))
        simulated_drone.bench.medium.place({**PLACES, "a": (*START_M[:2], ANTENNA_M)})
        simulated_drone.fly(lambda: not vehicle.is_armed)
        assert vehicle.body.place_m == START_M
        simulated_drone.take_off()
