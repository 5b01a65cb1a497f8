"""The emulated autopilot as ArduCopter: its modes by pymavlink's table, its manners, and MAVProxy, which flies it."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as d

from fieldkit.core.deadline import Deadline
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.modes import Mode
from tests.helpers import drones
from tests.helpers.ground_station import SYSTEM, GroundStation
from tests.helpers.mavproxy_flight import mavproxy
from tests.helpers.sshd import wait_until

OK, FAILED = d.MAV_RESULT_ACCEPTED, d.MAV_RESULT_FAILED
CUSTOM = d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
NUMBERS = {name: number for number, name in mavutil.mode_mapping_acm.items()}
PLACE_ALONE, VELOCITY_ALONE = 0b110111111000, 0b110111000111


@pytest.fixture
def gcs() -> GroundStation:
    station = GroundStation(firmware=ARDUCOPTER)
    station.wait(1)
    station.ask(10, d.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    station.ask(1, d.MAVLINK_MSG_ID_SYS_STATUS)
    return station


def mode(gcs: GroundStation) -> str:
    gcs.wait(1.1)
    return str(mavutil.mode_mapping_acm[gcs.last("HEARTBEAT").custom_mode])


def change(gcs: GroundStation, name: str) -> int:
    return gcs.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, NUMBERS[name])


def take_off(gcs: GroundStation, height_m: float = 3.0) -> None:
    assert change(gcs, "GUIDED") == OK
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    assert gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m) == OK
    gcs.wait(13)


def lead(gcs: GroundStation, mask: int, vector: tuple[float, float, float], yaw_rad: float = 0.0) -> None:
    zeros = (0.0, 0.0, 0.0)
    place, speed = (vector, zeros) if mask == PLACE_ALONE else (zeros, vector)
    gcs.say(
        d.MAVLink_set_position_target_local_ned_message(
            *(0, SYSTEM, 1, d.MAV_FRAME_LOCAL_NED, mask, *place, *speed, *zeros, yaw_rad, 0)
        )
    )


def texts(gcs: GroundStation) -> list[str]:
    gcs.wait(0.1)
    return [text for severity, text in gcs.texts() if severity <= d.MAV_SEVERITY_NOTICE]


def test_it_says_what_it_is(gcs: GroundStation) -> None:
    assert gcs.last("HEARTBEAT").autopilot == d.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert mavutil.mode_mapping_bynumber(gcs.last("HEARTBEAT").type) == mavutil.mode_mapping_acm
    assert mode(gcs) == "STABILIZE"


def test_up_along_and_down(gcs: GroundStation) -> None:
    take_off(gcs)
    assert mode(gcs) == "GUIDED"
    assert -gcs.last("LOCAL_POSITION_NED").z == pytest.approx(3.0, abs=0.15)
    lead(gcs, PLACE_ALONE, (2.0, 1.0, -3.0))
    gcs.wait(20)  # GUID_TIMEOUT is long over: it stays
    here = gcs.last("LOCAL_POSITION_NED")
    assert math.dist((here.x, here.y, -here.z), (2.0, 1.0, 3.0)) < 0.15
    assert mode(gcs) == "GUIDED"
    assert change(gcs, "LAND") == OK
    gcs.wait(14)
    assert not gcs.last("HEARTBEAT").base_mode & d.MAV_MODE_FLAG_SAFETY_ARMED
    assert mode(gcs) == "LAND"


def test_it_returns_as_high_as_it_is_told(gcs: GroundStation) -> None:
    gcs.say(d.MAVLink_param_set_message(SYSTEM, 1, b"RTL_ALT", 500, d.MAV_PARAM_TYPE_REAL32))
    take_off(gcs)
    lead(gcs, PLACE_ALONE, (8.0, 0.0, -3.0))
    gcs.wait(15)
    assert change(gcs, "RTL") == OK
    heard = [one for one in gcs.wait(60) if one.get_type() in {"LOCAL_POSITION_NED", "HEARTBEAT"}]
    places = [one for one in heard if one.get_type() == "LOCAL_POSITION_NED"]
    assert max(-one.z for one in places) == pytest.approx(5.0, abs=0.2)
    assert {one.custom_mode for one in heard if one.get_type() == "HEARTBEAT"} == {NUMBERS["RTL"]}
    assert math.hypot(places[-1].x, places[-1].y) < 0.3
    assert places[-1].z == pytest.approx(0.0, abs=0.01)


def test_what_it_refuses_has_an_answer_and_no_more(gcs: GroundStation) -> None:
    def rise() -> int:
        return gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3)

    assert change(gcs, "GUIDED") == OK
    assert rise() == FAILED, "not armed"
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    assert change(gcs, "LOITER") == OK
    assert rise() == FAILED, "not in GUIDED"
    assert change(gcs, "GUIDED") == OK
    assert gcs.command(d.MAV_CMD_NAV_TAKEOFF) == FAILED, "to no height"
    assert rise() == OK
    gcs.wait(2)
    assert rise() == OK, "it has not lifted off yet"
    gcs.wait(6)
    assert rise() == FAILED, "it flies"
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 0) == FAILED
    assert change(gcs, "AUTO") == FAILED, "it has no mission"
    assert texts(gcs) == ["Mode change to AUTO failed: init failed"]


def test_no_set_point_lifts_it_and_none_leads_beyond_its_fence(gcs: GroundStation) -> None:
    assert change(gcs, "GUIDED") == OK
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    lead(gcs, PLACE_ALONE, (0.0, 0.0, -3.0))
    gcs.wait(5)
    assert gcs.last("LOCAL_POSITION_NED").z == pytest.approx(0.0, abs=0.01)
    take_off(gcs)
    lead(gcs, PLACE_ALONE, (500.0, 0.0, -3.0))
    gcs.wait(5)
    assert abs(gcs.last("LOCAL_POSITION_NED").x) < 0.2


def test_a_velocity_lapses_and_over_the_fence_it_returns(gcs: GroundStation) -> None:
    gcs.say(d.MAVLink_param_set_message(SYSTEM, 1, b"FENCE_RADIUS", 10, d.MAV_PARAM_TYPE_REAL32))
    take_off(gcs)
    lead(gcs, VELOCITY_ALONE, (1.0, 0.0, 0.0))
    gcs.wait(10)
    assert 2.0 < gcs.last("LOCAL_POSITION_NED").x < 6.0
    assert mode(gcs) == "GUIDED"
    for _ in range(10):
        lead(gcs, VELOCITY_ALONE, (2.0, 0.0, 0.0))
        gcs.wait(1)
    assert mode(gcs) == "RTL"
    assert (d.MAV_SEVERITY_NOTICE, "Circle fence breached") in gcs.texts()


@pytest.mark.parametrize("seconds", [0, 200])
def test_it_says_why_it_may_not_be_armed(gcs: GroundStation, seconds: int) -> None:
    gcs.autopilot.vehicle.battery.left -= seconds / 1000
    gcs.say(d.MAVLink_param_set_message(SYSTEM, 1, b"BATT_ARM_VOLT", 12.5, d.MAV_PARAM_TYPE_REAL32))
    low = bool(seconds)
    assert gcs.command(d.MAV_CMD_RUN_PREARM_CHECKS) == OK
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == (FAILED if low else OK)
    why = "Battery 1 below minimum arming voltage"
    assert texts(gcs) == [f"PreArm: {why}", f"Arm: {why}"] * low
    gcs.wait(1)
    assert bool(gcs.last("SYS_STATUS").onboard_control_sensors_health & d.MAV_SYS_STATUS_PREARM_CHECK) != low


def test_mavproxy_flies_it_in_its_own_modes(tmp_path: Path) -> None:
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot), mavproxy(port, str(tmp_path)) as terminal:
        (type_line, said), drone = terminal, autopilot.vehicle

        def typed(line: str, done: Callable[[], bool]) -> None:
            type_line(line)
            wait_until(done, Deadline.after(60))

        wait_until(lambda: b"STABILIZE>" in said, Deadline.after(60))
        typed("mode guided", lambda: drone.mode is Mode.OFFBOARD and b"GUIDED>" in said)
        typed("param set RTL_ALT 100", lambda: b"RTL_ALT" in said)
        typed("arm throttle", lambda: drone.armed)
        typed("takeoff 2", lambda: drone.body.position_m[2] > 1.9)
        typed("mode rtl", lambda: not drone.armed and b"RTL>" in said)
        assert drone.body.on_ground
        assert b"DISARMED" in said
