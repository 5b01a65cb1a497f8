"""The emulated autopilot as ArduCopter: the modes of pymavlink, its behaviour, and a flight with MAVProxy."""

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
POSITION_ONLY, VELOCITY_ONLY = 0b110111111000, 0b110111000111


@pytest.fixture
def gcs() -> GroundStation:
    station = GroundStation(firmware=ARDUCOPTER)
    station.wait(1)
    station.request_rate(10, d.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    station.request_rate(1, d.MAVLINK_MSG_ID_SYS_STATUS)
    return station


def flight_mode(gcs: GroundStation) -> str:
    gcs.wait(1.1)
    return str(mavutil.mode_mapping_acm[gcs.last("HEARTBEAT").custom_mode])


def change_mode(gcs: GroundStation, name: str) -> int:
    return gcs.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, NUMBERS[name])


def take_off(gcs: GroundStation, height_m: float = 3.0) -> None:
    assert change_mode(gcs, "GUIDED") == OK
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    assert gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m) == OK
    gcs.wait(13)


def send_set_point(gcs: GroundStation, mask: int, vector: tuple[float, float, float], yaw_rad: float = 0.0) -> None:
    zeros = (0.0, 0.0, 0.0)
    place, speed = (vector, zeros) if mask == POSITION_ONLY else (zeros, vector)
    gcs.send_message(
        d.MAVLink_set_position_target_local_ned_message(
            *(0, SYSTEM, 1, d.MAV_FRAME_LOCAL_NED, mask, *place, *speed, *zeros, yaw_rad, 0)
        )
    )


def status_texts(gcs: GroundStation) -> list[str]:
    gcs.wait(0.1)
    return [text for severity, text in gcs.texts() if severity <= d.MAV_SEVERITY_NOTICE]


def test_heartbeat_identifies_arducopter(gcs: GroundStation) -> None:
    assert gcs.last("HEARTBEAT").autopilot == d.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert mavutil.mode_mapping_bynumber(gcs.last("HEARTBEAT").type) == mavutil.mode_mapping_acm
    assert flight_mode(gcs) == "STABILIZE"


def test_take_off_fly_and_land(gcs: GroundStation) -> None:
    take_off(gcs)
    assert flight_mode(gcs) == "GUIDED"
    assert -gcs.last("LOCAL_POSITION_NED").z == pytest.approx(3.0, abs=0.15)
    send_set_point(gcs, POSITION_ONLY, (2.0, 1.0, -3.0))
    gcs.wait(20)  # much longer than GUID_TIMEOUT: the drone stays at the set point
    position = gcs.last("LOCAL_POSITION_NED")
    assert math.dist((position.x, position.y, -position.z), (2.0, 1.0, 3.0)) < 0.15
    assert flight_mode(gcs) == "GUIDED"
    assert change_mode(gcs, "LAND") == OK
    gcs.wait(14)
    assert not gcs.last("HEARTBEAT").base_mode & d.MAV_MODE_FLAG_SAFETY_ARMED
    assert flight_mode(gcs) == "LAND"


def test_the_drone_returns_at_the_height_of_its_parameter(gcs: GroundStation) -> None:
    gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, b"RTL_ALT", 500, d.MAV_PARAM_TYPE_REAL32))
    take_off(gcs)
    send_set_point(gcs, POSITION_ONLY, (8.0, 0.0, -3.0))
    gcs.wait(15)
    assert change_mode(gcs, "RTL") == OK
    messages = [message for message in gcs.wait(60) if message.get_type() in {"LOCAL_POSITION_NED", "HEARTBEAT"}]
    positions = [message for message in messages if message.get_type() == "LOCAL_POSITION_NED"]
    assert max(-message.z for message in positions) == pytest.approx(5.0, abs=0.2)
    assert {message.custom_mode for message in messages if message.get_type() == "HEARTBEAT"} == {NUMBERS["RTL"]}
    assert math.hypot(positions[-1].x, positions[-1].y) < 0.3
    assert positions[-1].z == pytest.approx(0.0, abs=0.01)


def test_refused_commands_are_answered_without_a_status_text(gcs: GroundStation) -> None:
    def take_off_again() -> int:
        return gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3)

    assert change_mode(gcs, "GUIDED") == OK
    assert take_off_again() == FAILED, "not armed"
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    assert change_mode(gcs, "LOITER") == OK
    assert take_off_again() == FAILED, "not in GUIDED"
    assert change_mode(gcs, "GUIDED") == OK
    assert gcs.command(d.MAV_CMD_NAV_TAKEOFF) == FAILED, "without a height"
    assert take_off_again() == OK
    gcs.wait(2)
    assert take_off_again() == OK, "it has not lifted off yet"
    gcs.wait(6)
    assert take_off_again() == FAILED, "it is flying"
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 0) == FAILED
    assert change_mode(gcs, "AUTO") == FAILED, "it has no mission"
    assert status_texts(gcs) == ["Mode change to AUTO failed: init failed"]


def test_set_points_cause_neither_a_take_off_nor_a_flight_outside_the_fence(gcs: GroundStation) -> None:
    assert change_mode(gcs, "GUIDED") == OK
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    send_set_point(gcs, POSITION_ONLY, (0.0, 0.0, -3.0))
    gcs.wait(5)
    assert gcs.last("LOCAL_POSITION_NED").z == pytest.approx(0.0, abs=0.01)
    take_off(gcs)
    send_set_point(gcs, POSITION_ONLY, (500.0, 0.0, -3.0))
    gcs.wait(5)
    assert abs(gcs.last("LOCAL_POSITION_NED").x) < 0.2


def test_a_velocity_times_out_and_a_fence_breach_returns_home(gcs: GroundStation) -> None:
    gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, b"FENCE_RADIUS", 10, d.MAV_PARAM_TYPE_REAL32))
    take_off(gcs)
    send_set_point(gcs, VELOCITY_ONLY, (1.0, 0.0, 0.0))
    gcs.wait(10)
    assert 2.0 < gcs.last("LOCAL_POSITION_NED").x < 6.0
    assert flight_mode(gcs) == "GUIDED"
    for _ in range(10):
        send_set_point(gcs, VELOCITY_ONLY, (2.0, 0.0, 0.0))
        gcs.wait(1)
    assert flight_mode(gcs) == "RTL"
    assert (d.MAV_SEVERITY_NOTICE, "Circle fence breached") in gcs.texts()


@pytest.mark.parametrize("used_permille", [0, 200])
def test_the_autopilot_reports_the_reason_if_it_cannot_be_armed(gcs: GroundStation, used_permille: int) -> None:
    gcs.autopilot.vehicle.battery.charge -= used_permille / 1000
    gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, b"BATT_ARM_VOLT", 12.5, d.MAV_PARAM_TYPE_REAL32))
    is_low = bool(used_permille)
    assert gcs.command(d.MAV_CMD_RUN_PREARM_CHECKS) == OK
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == (FAILED if is_low else OK)
    reason = "Battery 1 below minimum arming voltage"
    assert status_texts(gcs) == [f"PreArm: {reason}", f"Arm: {reason}"] * is_low
    gcs.wait(1)
    assert bool(gcs.last("SYS_STATUS").onboard_control_sensors_health & d.MAV_SYS_STATUS_PREARM_CHECK) != is_low


def test_mavproxy_flies_the_drone_with_the_modes_of_arducopter(tmp_path: Path) -> None:
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot), mavproxy(port, str(tmp_path)) as terminal:
        (type_line, output), drone = terminal, autopilot.vehicle

        def enter(line: str, condition: Callable[[], bool]) -> None:
            type_line(line)
            wait_until(condition, Deadline.after(60))

        wait_until(lambda: b"STABILIZE>" in output, Deadline.after(60))
        enter("mode guided", lambda: drone.mode is Mode.OFFBOARD and b"GUIDED>" in output)
        enter("param set RTL_ALT 100", lambda: b"RTL_ALT" in output)
        enter("arm throttle", lambda: drone.is_armed)
        enter("takeoff 2", lambda: drone.body.position_m[2] > 1.9)
        enter("mode rtl", lambda: not drone.is_armed and b"RTL>" in output)
        assert drone.body.on_ground
        assert b"DISARMED" in output
