"""Missions, fences and failsafes of drones that a physics simulator moves; the clock is simulated."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as d

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.flight import SetPoint
from sim_backends.emulated.autopilot.modes import LANDING, RETURNING, Mode
from sim_backends.emulated.autopilot.px4 import PX4
from sim_backends.emulated.cosimulated.velocity_flights import VelocityFlights
from sim_backends.physics.body import Velocity
from sim_backends.physics.quadrotor import ROTORS_OFF, FlightTarget, Quadrotor
from sim_backends.physics.robot_limits import DUCKIEDRONE
from sim_backends.world.motion import GRAVITY_M_S2, State
from tests.helpers.ground_station import HOME_M, GroundStation, item, upload
from tests.helpers.nightly import mark_nightly
from tests.helpers.simulated_drones import NAME, START_M, VelocityPhysics, physics_station

SIMULATORS = ("none", "kinematic", "mujoco", "velocities")
FIRMWARES = {"px4": PX4, "arducopter": ARDUCOPTER}


def cases(*in_ci: str) -> pytest.MarkDecorator:
    """Parametrize a test with all simulators and the firmwares of `in_ci`; all other cases are marked `nightly`."""
    firmwares = dict.fromkeys(case.split()[1] for case in in_ci)
    names = [f"{simulator} {firmware}" for simulator in SIMULATORS for firmware in firmwares]
    return pytest.mark.parametrize("case", mark_nightly(names, in_ci=in_ci))


@pytest.fixture
def station(case: str, tmp_path: Path) -> Iterator[GroundStation]:
    simulator, firmware = case.split()
    with physics_station(tmp_path, simulator, FIRMWARES[firmware]) as started_station:
        yield started_station


OK = d.MAV_RESULT_ACCEPTED
HEIGHT_M = 2.0


def wait_until(
    station: GroundStation, condition: Callable[[], bool], limit_s: float = 60.0, *, heartbeats: bool = True
) -> None:
    """Advance the time until a condition is true."""
    until_ns = station.now_ns + round(limit_s * 1e9)
    while not condition():
        assert station.now_ns < until_ns, f"{station.autopilot.vehicle.mode} at {place_m(station)}"
        station.wait(0.1, heartbeats=heartbeats)


def place_m(station: GroundStation) -> Vector:
    """Return the position of the drone relative to home."""
    return station.autopilot.vehicle.body.position_m


def take_off(station: GroundStation) -> None:
    """Take off, and hold the position."""
    vehicle = station.autopilot.vehicle
    if vehicle.firmware.is_ardupilot:
        vehicle.change_mode(Mode.OFFBOARD)
    assert station.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    assert station.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT_M) == OK
    wait_until(station, lambda: place_m(station)[2] > 0.95 * HEIGHT_M)


def has_landed(station: GroundStation, distance_m: float = 0.7) -> bool:
    """Return True if the drone has landed near home and is disarmed."""
    east_m, north_m, up_m = place_m(station)
    is_down = not station.autopilot.vehicle.is_armed and abs(up_m) < 0.02
    assert not is_down or math.hypot(east_m, north_m) < distance_m
    return is_down


@cases("mujoco px4", "velocities arducopter")
def test_a_mission_is_uploaded_and_flown(station: GroundStation) -> None:
    corners_m = ((4.0, 0.0, HEIGHT_M), (4.0, 3.0, HEIGHT_M + 1.0))
    vehicle = station.autopilot.vehicle
    firmware = vehicle.firmware
    plan = [(0.0, 0.0, HEIGHT_M, d.MAV_CMD_NAV_TAKEOFF)] * (1 + firmware.first_item)
    plan += [*((*corner_m, d.MAV_CMD_NAV_WAYPOINT) for corner_m in corners_m), (4.0, 3.0, 0.0, d.MAV_CMD_NAV_LAND)]
    items = [item(number, *place_and_command) for number, place_and_command in enumerate(plan)]
    assert upload(station, items) == d.MAV_MISSION_ACCEPTED
    if firmware.is_ardupilot:
        vehicle.change_mode(Mode.OFFBOARD)  # it cannot be armed in AUTO
    assert station.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    assert station.command(d.MAV_CMD_MISSION_START) == OK
    nearest_m = dict.fromkeys(corners_m, math.inf)

    def is_done() -> bool:
        for corner_m, distance_m in nearest_m.items():
            nearest_m[corner_m] = min(distance_m, math.dist(corner_m, place_m(station)))
        return not vehicle.is_armed

    wait_until(station, is_done)
    assert max(nearest_m.values()) < (2.3 if firmware.is_ardupilot else 0.8), "the acceptance radius and a margin"
    assert place_m(station) == pytest.approx((4.0, 3.0, 0.0), abs=0.7)
    reached_items = [message.seq for message in station.received if message.get_type() == "MISSION_ITEM_REACHED"]
    assert list(dict.fromkeys(reached_items)) == list(range(firmware.first_item, len(items)))


def push_out(station: GroundStation) -> float:
    """Fly east until the mode changes; return the greatest distance from home."""
    vehicle, farthest_m = station.autopilot.vehicle, 0.0

    def push() -> bool:
        nonlocal farthest_m
        farthest_m = max(farthest_m, math.hypot(*place_m(station)[:2]))
        vehicle.accept_set_point(SetPoint((2.5, 0.0, 0.0), is_position=False))
        return vehicle.mode is not Mode.OFFBOARD

    push()
    vehicle.change_mode(Mode.OFFBOARD)
    wait_until(station, push)
    return farthest_m


@pytest.mark.parametrize("action", [2, 3])
@cases("velocities px4", "mujoco px4")
def test_px4_does_not_cross_its_fence_and_acts_as_its_parameter_requires(station: GroundStation, action: int) -> None:
    station.set("GF_MAX_HOR_DIST", 6.0)
    station.set("GF_ACTION", action)
    take_off(station)
    farthest_m = push_out(station)
    text = "hold" if action == 2 else "return"
    assert (d.MAV_SEVERITY_CRITICAL, f"Geofence: {text}") in station.texts()
    vehicle = station.autopilot.vehicle
    if action == 2:
        station.wait(6)
        assert 5.0 < place_m(station)[0] < 6.1
        assert vehicle.mode is Mode.LOITER
    else:
        assert vehicle.mode in RETURNING
        wait_until(station, lambda: has_landed(station))
    assert farthest_m < 6.0


@cases("kinematic arducopter")
def test_a_breach_of_arducopters_fence_returns_home(station: GroundStation) -> None:
    station.set("FENCE_RADIUS", 6.0)
    station.set("FENCE_ACTION", 1)
    take_off(station)
    push_out(station)
    assert station.autopilot.vehicle.mode is Mode.RTL
    assert "Circle fence breached" in [text for _, text in station.texts()]
    wait_until(station, lambda: has_landed(station, 2.5))


@cases("kinematic px4", "mujoco arducopter")
def test_without_its_ground_station_the_drone_returns_and_lands(station: GroundStation) -> None:
    vehicle = station.autopilot.vehicle
    station.set(*(("FS_GCS_ENABLE", 1) if vehicle.firmware.is_ardupilot else ("NAV_DLL_ACT", 2)))
    take_off(station)
    vehicle.go_to((4.0, 0.0, HEIGHT_M))
    wait_until(station, lambda: place_m(station)[0] > 3.5)
    wait_until(station, lambda: vehicle.mode in RETURNING, 20, heartbeats=False)
    wait_until(station, lambda: has_landed(station, 2.5), heartbeats=False)


@cases("velocities px4", "kinematic arducopter")
def test_a_low_battery_lands_the_drone(station: GroundStation) -> None:
    is_ardupilot = station.autopilot.vehicle.firmware.is_ardupilot
    actions: dict[str, float] = {"COM_LOW_BAT_ACT": 2, "SIM_BAT_MIN_PCT": 6.0}
    if is_ardupilot:
        actions = {"BATT_LOW_VOLT": 11.0, "BATT_FS_LOW_ACT": 1, "BATT_LOW_TIMER": 2}
    for name, value in actions.items():
        station.set(name, value)
    take_off(station)
    station.set(*(("SIM_BATT_VOLTAGE", 10.8) if is_ardupilot else ("SIM_BAT_DRAIN", 5.0)))
    wait_until(station, lambda: station.autopilot.vehicle.mode in LANDING, 20)
    wait_until(station, lambda: has_landed(station))


class TestVelocityFlights:
    """A drone that a physics simulator moves at commanded velocities."""

    TARGET = FlightTarget(Velocity((1.0, 0.0, 0.0)), 3.0, (3.0, 4.0))

    def flights(self, height_m: float, wall_m: float = math.inf) -> VelocityFlights:
        east_m, north_m, up_m = START_M
        physics = VelocityPhysics(State((east_m, north_m, up_m + height_m)), wall_m)
        body = Quadrotor(DUCKIEDRONE, (*HOME_M[:2], height_m), antenna_m=START_M[2])
        return VelocityFlights(physics, {NAME: body}, None)

    def test_the_drone_accelerates_as_in_the_model(self) -> None:
        flights = self.flights(5.0)
        body, pose = Quadrotor(DUCKIEDRONE, (*HOME_M[:2], 5.0)), None
        for step in range(1, 101):
            pose = body.course(pose or body.initial_pose(), self.TARGET, 0.01).at(1)
            state = flights.advance(step * 10_000_000, {} if step > 1 else {NAME: self.TARGET})[NAME]
        assert pose is not None
        assert state.velocity_m_s == pytest.approx(pose.velocity_m_s, abs=0.03)
        assert state.position_m[0] == pytest.approx(pose.place_m[0], abs=0.03)
        status = flights.flight_status(NAME)
        assert (status.roll_rad, status.pitch_rad) == pytest.approx((pose.roll_rad, pose.pitch_rad), abs=0.02)
        assert not status.is_supported

    def test_windows_of_any_length_give_the_same_flight(self) -> None:
        places_m = []
        for window_ns in (3_700_000, 10_000_000, 50_000_000):
            flights = self.flights(5.0)
            states = flights.advance(0, {NAME: self.TARGET})
            for number in range(1, 1_000_000_000 // window_ns + 1):
                states = flights.advance(number * window_ns, {})
            states = flights.advance(1_000_000_000, {})
            places_m.append(states[NAME].position_m)
        assert max(math.dist(place_m, places_m[0]) for place_m in places_m) < 0.03

    def test_a_drone_without_power_falls_until_the_ground_supports_it(self) -> None:
        flights, fall_s = self.flights(2.0), math.sqrt(2 * 2.0 / GRAVITY_M_S2)
        flights.advance(0, {NAME: ROTORS_OFF})
        assert not flights.flight_status(NAME).is_supported
        landed_s = next(
            number / 100
            for number in range(1, 200)
            if flights.advance(number * 10_000_000, {}) and flights.flight_status(NAME).is_supported
        )
        assert landed_s == pytest.approx(fall_s, rel=0.1)
        state = flights.advance(3_000_000_000, {})[NAME]
        assert state.velocity_m_s == (0.0, 0.0, 0.0)
        assert flights.flight_status(NAME).place_m[2] == pytest.approx(0.0, abs=1e-6)

    def test_a_wall_stops_the_model_too(self) -> None:
        wall_m = START_M[0] + 0.5
        flights = self.flights(2.0, wall_m)
        flights.advance(0, {NAME: self.TARGET})
        flights.advance(3_000_000_000, {})
        away = FlightTarget(Velocity((-1.0, 0.0, 0.0)), 3.0, (3.0, 4.0))
        flights.advance(3_200_000_000, {NAME: away})
        states = flights.advance(3_600_000_000, {})
        assert states[NAME].position_m[0] < wall_m - 0.02, "the model has no velocity against the wall left"
