"""The emulated autopilots compared with real firmware: boot, rates, modes, failsafes (docs/emulated-autopilot.md)."""

import math
from collections import Counter
from collections.abc import Iterator

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as d

from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.autopilot import Autopilot
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.flight import SetPoint
from sim_backends.emulated.autopilot.mission_plan import Item
from sim_backends.emulated.autopilot.modes import RETURNING, Mode
from sim_backends.emulated.autopilot.px4 import PX4
from tests.helpers.ground_station import HOME_M, SYSTEM, GroundStation

OK, FAILED, DENIED = d.MAV_RESULT_ACCEPTED, d.MAV_RESULT_FAILED, d.MAV_RESULT_DENIED
CUSTOM = d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
COPTER_MODES = {name: number for number, name in mavutil.mode_mapping_acm.items()}
CRITICAL, WARNING, INFO = d.MAV_SEVERITY_CRITICAL, d.MAV_SEVERITY_WARNING, d.MAV_SEVERITY_INFO
LOCAL, STATUS, EKF = (
    d.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    d.MAVLINK_MSG_ID_SYS_STATUS,
    d.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
)


class Station(GroundStation):
    """A ground station with methods for modes, flights and heartbeats."""

    def __init__(self, firmware: Firmware, boot_s: float = 0.0) -> None:
        super().__init__(firmware=firmware, boot_s=boot_s)
        self._reader = d.MAVLink(None)

    @property
    def mode(self) -> str:
        return str(mavutil.mode_mapping_acm[self.last("HEARTBEAT").custom_mode])

    def change_mode(self, name: str) -> int:
        return self.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, COPTER_MODES[name])

    def arm(self) -> int:
        return self.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def take_off(self, height_m: float) -> int:
        return self.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m)

    def wait_silently(self, seconds: float) -> None:
        """Advance the time without heartbeats."""
        for _ in range(round(seconds * 10)):
            self.now_ns += 100_000_000
            self._receive(frame for _, frame in self.autopilot.advance(self.now_ns))

    def wait_with_heartbeats(self, system: int, seconds: int) -> None:
        """Advance the time while only a station of this system id sends heartbeats."""
        link = d.MAVLink(None, srcSystem=system, srcComponent=190)
        for _ in range(seconds):
            heartbeat = d.MAVLink_heartbeat_message(d.MAV_TYPE_GCS, 8, 0, 0, 4, 3).pack(link)
            list(self.autopilot.receive(heartbeat, ("gcs", 1), self.now_ns))
            self.wait_silently(1)

    def poll(self, condition: str, limit_s: float) -> Iterator[None]:
        """Yield every 0.1 s of virtual time; fail after `limit_s`."""
        for _ in range(round(limit_s * 10)):
            self.wait(0.1)
            yield
        raise AssertionError(f"{condition}: not within {limit_s:g} s")

    def fly(self, height_m: float = 3.0) -> None:
        """Take off in the guided mode of ArduCopter, or by PX4's TAKEOFF."""
        if self.autopilot.vehicle.firmware.is_ardupilot:
            assert self.change_mode("GUIDED") == OK
        assert self.arm() == OK
        assert self.take_off(height_m) == OK
        for _ in self.poll("up", 30):
            if self.autopilot.vehicle.body.position_m[2] > 0.95 * height_m:
                return


@pytest.fixture
def copter() -> Station:
    station = Station(ARDUCOPTER)
    station.wait(1)
    return station


@pytest.fixture
def px4() -> Station:
    station = Station(PX4)
    station.wait(1)
    return station


def test_arducopter_sends_only_heartbeat_and_timesync_without_a_request(copter: Station) -> None:
    counts = Counter(message.get_type() for message in copter.wait(60))
    assert counts.keys() == {"HEARTBEAT", "TIMESYNC"}
    assert counts["HEARTBEAT"] == 60
    assert counts["TIMESYNC"] == 6


@pytest.mark.parametrize("source", ["parameter", "request"])
def test_stream_rates_of_arducopter_are_parameters(copter: Station, source: str) -> None:
    if source == "parameter":
        copter.set("SR0_POSITION", 4)
    else:
        copter.send_message(d.MAVLink_request_data_stream_message(SYSTEM, 1, d.MAV_DATA_STREAM_POSITION, 4, 1))
        assert (
            copter.send_message(d.MAVLink_param_request_read_message(SYSTEM, 1, b"SR0_POSITION", -1))[0].param_value
            == 4
        )
    counts = Counter(message.get_type() for message in copter.wait(10))
    assert abs(counts["LOCAL_POSITION_NED"] - 40) <= 1
    copter.request_rate(10, LOCAL)
    assert abs(Counter(message.get_type() for message in copter.wait(10))["LOCAL_POSITION_NED"] - 100) <= 1
    assert copter.command(d.MAV_CMD_SET_MESSAGE_INTERVAL, LOCAL, 0) == OK
    assert abs(Counter(message.get_type() for message in copter.wait(10))["LOCAL_POSITION_NED"] - 40) <= 1, (
        "the default"
    )


def send_from_other_client(
    autopilot: Autopilot, now_ns: int, system: int, message: object
) -> dict[int, Counter[str]]:
    """Send a message from another client; return the message types that each client port received as answers."""
    link = d.MAVLink(None, srcSystem=system, srcComponent=190)
    readers = {port: d.MAVLink(None) for port in (1, 2)}
    counts: dict[int, Counter[str]] = {1: Counter(), 2: Counter()}
    for (_, port), frame in autopilot.receive(message.pack(link), ("gcs", 2), now_ns):  # type: ignore[attr-defined]
        counts[port].update(answer.get_type() for answer in readers[port].parse_buffer(frame))
    return counts


def test_rates_belong_to_the_port_and_acknowledgements_to_the_sender(copter: Station) -> None:
    copter.request_rate(10, LOCAL)
    stop = d.MAVLink_command_long_message(SYSTEM, 1, d.MAV_CMD_SET_MESSAGE_INTERVAL, 0, LOCAL, -1, 0, 0, 0, 0, 0)
    counts = send_from_other_client(copter.autopilot, copter.now_ns, 245, stop)
    assert counts == {1: Counter(), 2: Counter(COMMAND_ACK=1)}
    assert "LOCAL_POSITION_NED" not in {message.get_type() for message in copter.wait(5)}, (
        "the other client stopped it"
    )
    read_request = d.MAVLink_param_request_read_message(SYSTEM, 1, b"RTL_ALT", -1)
    counts = send_from_other_client(copter.autopilot, copter.now_ns, 245, read_request)
    assert counts == {1: Counter(PARAM_VALUE=1), 2: Counter(PARAM_VALUE=1)}, (
        "a message without a target goes to all clients"
    )


def test_arducopter_has_a_position_when_its_estimate_has_an_origin() -> None:
    copter = Station(ARDUCOPTER, boot_s=10)
    copter.request_rate(5, LOCAL, EKF, d.MAVLINK_MSG_ID_GPS_RAW_INT)
    early_messages = copter.wait(9)
    assert copter.arm() == FAILED
    late_messages = copter.wait(5)
    assert {message.flags for message in early_messages if message.get_type() == "EKF_STATUS_REPORT"} == {0xA7}
    assert copter.last("EKF_STATUS_REPORT").flags == 831
    assert "LOCAL_POSITION_NED" not in {message.get_type() for message in early_messages}
    assert copter.last("LOCAL_POSITION_NED").z == 0
    assert (
        next(message.fix_type for message in early_messages if message.get_type() == "GPS_RAW_INT")
        == d.GPS_FIX_TYPE_NO_FIX
    )
    assert copter.last("GPS_RAW_INT").fix_type == d.GPS_FIX_TYPE_RTK_FIXED == 6
    texts = [message.text for message in early_messages + late_messages if message.get_type() == "STATUSTEXT"]
    assert texts == [
        "PreArm: Need Position Estimate",
        "Arm: Need Position Estimate",
        "EKF3 IMU0 origin set",
        "EKF3 IMU0 is using GPS",
    ]
    assert (CRITICAL, texts[0]) in copter.texts()
    assert (INFO, texts[2]) in copter.texts()
    assert copter.command(d.MAV_CMD_REQUEST_MESSAGE, EKF) == FAILED
    assert copter.command(d.MAV_CMD_SET_MESSAGE_INTERVAL, d.MAVLINK_MSG_ID_ESTIMATOR_STATUS, 1e5) == DENIED
    assert copter.command(d.MAV_CMD_SET_MESSAGE_INTERVAL, d.MAVLINK_MSG_ID_RADIO_STATUS, 1e5) == DENIED


def test_px4_cannot_be_armed_before_its_estimate_is_good() -> None:
    px4 = Station(PX4, boot_s=10)
    px4.wait(5)
    assert px4.arm() == d.MAV_RESULT_TEMPORARILY_REJECTED
    px4.wait(6)
    assert (CRITICAL, "Preflight Fail: ekf2 missing data") in px4.texts()
    flags = [message.flags for message in px4.received if message.get_type() == "ESTIMATOR_STATUS"]
    assert flags[0] & d.ESTIMATOR_CONST_POS_MODE
    assert flags[-1] == 831
    assert px4.arm() == OK


def test_the_drone_spools_up_before_take_off_and_keeps_its_mode_after_landing(copter: Station) -> None:
    assert copter.change_mode("GUIDED") == OK
    assert copter.arm() == OK
    assert copter.take_off(3.0) == OK
    copter.wait(2.8)
    assert copter.autopilot.vehicle.body.on_ground
    assert copter.last("HEARTBEAT").system_status == d.MAV_STATE_STANDBY
    assert copter.take_off(3.0) == OK, "it has not lifted off"
    copter.wait(2)
    assert copter.last("HEARTBEAT").system_status == d.MAV_STATE_ACTIVE
    assert copter.take_off(3.0) == FAILED
    copter.wait(10)
    assert copter.change_mode("LAND") == OK
    start_ns = copter.now_ns
    for _ in copter.poll("landed", 12):
        if copter.autopilot.vehicle.body.on_ground:
            break
    landing_s = (copter.now_ns - start_ns) / 1e9
    for _ in copter.poll("disarmed", 5):
        if not copter.autopilot.vehicle.is_armed:
            break
    assert landing_s == pytest.approx(6.4, abs=0.6), "as real ArduCopter from 3 m"
    assert (copter.now_ns - start_ns) / 1e9 - landing_s == pytest.approx(2.1, abs=0.2)
    copter.wait(1)
    assert copter.mode == "LAND"
    assert copter.arm() == FAILED
    copter.wait(0.1)
    assert (CRITICAL, "Arm: LAND mode not armable") in copter.texts()
    assert (INFO, "Arming motors") in copter.texts()


def test_an_unknown_mode_is_refused_and_pilot_modes_keep_the_height(copter: Station) -> None:
    assert copter.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 99) == FAILED
    copter.wait(0.1)
    assert copter.texts() == [(WARNING, "No such mode 99")]
    copter.fly()
    for name in ("ALT_HOLD", "STABILIZE", "POSHOLD", "BRAKE", "LOITER"):
        assert copter.change_mode(name) == OK
        copter.wait(4)
        assert copter.mode == name
        assert copter.autopilot.vehicle.body.position_m[2] == pytest.approx(3.0, abs=0.3)


def test_acknowledgements_contain_no_progress(copter: Station) -> None:
    copter.command(d.MAV_CMD_RUN_PREARM_CHECKS)
    ack = copter.last("COMMAND_ACK")
    assert (ack.progress, ack.result_param2) == (0, 0)


def local_set_point(north: float, east: float, yaw_rad: float | None = None) -> object:
    mask = 0b100111111000 if yaw_rad is not None else 0b110111111000
    place = (north, east, -3.0)
    return d.MAVLink_set_position_target_local_ned_message(
        *(0, SYSTEM, 1, d.MAV_FRAME_LOCAL_NED, mask, *place, *(0.0,) * 6, yaw_rad or 0.0, 0)
    )


@pytest.mark.parametrize(("yaw_rad", "behavior", "heading_deg"), [(None, 2, 90), (None, 0, 0), (-1.0, 2, -57.3)])
def test_arducopter_turns_along_its_path_unless_a_heading_is_set(
    copter: Station, yaw_rad: float | None, behavior: int, heading_deg: float
) -> None:
    copter.set("WP_YAW_BEHAVIOR", behavior)
    copter.fly()
    copter.send_message(local_set_point(0.0, 30.0, yaw_rad))  # east
    copter.wait(6)
    yaw_deg = math.degrees(math.remainder(math.pi / 2 - copter.autopilot.vehicle.body.yaw_rad, math.tau))
    assert yaw_deg == pytest.approx(heading_deg, abs=5)


def test_home_is_the_position_of_the_last_arming(copter: Station) -> None:
    copter.request_rate(5, LOCAL, d.MAVLINK_MSG_ID_HOME_POSITION)
    copter.fly()
    copter.send_message(local_set_point(4.0, 3.0))
    copter.wait(10)
    assert copter.change_mode("LAND") == OK
    copter.wait(12)
    assert copter.change_mode("GUIDED") == OK
    assert copter.arm() == OK
    copter.wait(1)
    home, position = copter.last("HOME_POSITION"), copter.last("LOCAL_POSITION_NED")
    assert (home.x, home.y) == pytest.approx((position.x, position.y), abs=0.01)
    assert (position.x, position.y) == pytest.approx((4.0, 3.0), abs=0.3)
    # If a person carries the drone back, the origin of its frame does not change.
    copter.autopilot.vehicle.place((HOME_M[0], HOME_M[1] + 1.0, 0.0), 0.0, copter.now_ns)
    copter.wait(1)
    position = copter.last("LOCAL_POSITION_NED")
    assert (position.x, position.y) == pytest.approx((1.0, 0.0), abs=0.01)


def test_a_battery_failsafe_lands_the_drone_and_lasts_until_a_reboot(copter: Station) -> None:
    for name, value in (("BATT_LOW_VOLT", 11.0), ("BATT_FS_LOW_ACT", 1), ("BATT_LOW_TIMER", 5)):
        copter.set(name, value)
    copter.fly()
    copter.set("SIM_BATT_VOLTAGE", 10.8)
    copter.wait(4)
    assert copter.mode == "GUIDED"
    copter.wait(3)
    assert copter.mode == "LAND"
    assert copter.last("HEARTBEAT").system_status == d.MAV_STATE_CRITICAL
    texts = [text for severity, text in copter.texts() if severity == WARNING]
    assert texts[0].startswith("Battery 1 is low 10.")
    assert texts[1] == "Battery Failsafe"
    copter.wait(15)
    copter.set("SIM_BATT_VOLTAGE", 12.6)
    assert copter.change_mode("GUIDED") == OK
    assert copter.arm() == FAILED
    copter.wait(0.1)
    assert (CRITICAL, "Arm: Battery failsafe") in copter.texts()
    assert copter.command(d.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == OK
    copter.wait(2)
    assert copter.mode == "STABILIZE"
    assert copter.change_mode("GUIDED") == OK
    assert copter.arm() == OK


def test_a_ground_station_failsafe_lasts_until_heartbeats_return(copter: Station) -> None:
    copter.set("FS_GCS_ENABLE", 5)
    copter.fly()
    copter.wait_with_heartbeats(254, 4)
    assert copter.mode == "GUIDED"
    copter.wait_with_heartbeats(254, 2)
    assert copter.mode == "LAND", "system 254 is not its ground station"
    assert (WARNING, "GCS Failsafe") in copter.texts()
    copter.wait_with_heartbeats(254, 15)
    assert copter.last("HEARTBEAT").system_status == d.MAV_STATE_CRITICAL
    assert copter.change_mode("GUIDED") == OK
    assert copter.arm() == FAILED
    copter.wait_with_heartbeats(255, 2)
    assert (WARNING, "GCS Failsafe Cleared") in copter.texts()
    assert copter.arm() == OK


def px4_mode(px4: Station) -> int:
    return int(px4.last("HEARTBEAT").custom_mode)


def test_px4_holds_then_returns_without_its_ground_station(px4: Station) -> None:
    px4.set("NAV_DLL_ACT", 2)
    px4.fly()
    px4.wait_silently(11)
    assert px4_mode(px4) == 4 << 16 | 3 << 24, "the mode is Hold"
    assert px4.last("HEARTBEAT").system_status == d.MAV_STATE_CRITICAL
    px4.wait_silently(6)  # a silent client receives nothing after 15 s
    assert px4.autopilot.vehicle.mode in RETURNING
    assert (CRITICAL, "Failsafe activated: entering Hold for 5 seconds") in px4.texts()


@pytest.mark.parametrize(("action", "lands"), [(0, False), (2, True)])
def test_px4_lands_with_a_low_battery_as_its_parameter_requires(px4: Station, action: int, *, lands: bool) -> None:
    px4.set("COM_LOW_BAT_ACT", action)
    px4.set("SIM_BAT_MIN_PCT", 6.0)
    px4.fly()
    px4.set("SIM_BAT_DRAIN", 10.0)
    px4.wait(20)
    assert (CRITICAL, "Critical battery") in px4.texts()
    px4.wait(15)
    assert px4.autopilot.vehicle.is_armed != lands


@pytest.mark.parametrize(("name", "value"), [("BAT_CRIT_THR", 0.5), ("COM_ARM_BAT_MIN", 0.5)])
def test_px4_is_not_armed_below_the_charge_of_its_parameters(px4: Station, name: str, value: float) -> None:
    px4.autopilot.vehicle.battery.charge = 0.4
    px4.set(name, value)
    assert px4.arm() != OK
    px4.set(name, 0.3)
    assert px4.arm() == OK


@pytest.mark.parametrize(
    ("action", "texts", "mode"),
    [(0, [], Mode.OFFBOARD), (1, ["Geofence: warning"], Mode.OFFBOARD), (5, ["Geofence: land"], Mode.LAND)],
)
def test_px4_at_its_fence_acts_as_its_parameter_requires(
    px4: Station, action: int, texts: list[str], mode: Mode
) -> None:
    px4.set("GF_MAX_HOR_DIST", 5.0)
    px4.set("GF_ACTION", action)
    px4.fly()
    vehicle = px4.autopilot.vehicle
    vehicle.accept_set_point(SetPoint((2.0, 0.0, 0.0), is_position=False))
    vehicle.change_mode(Mode.OFFBOARD)
    for _ in px4.poll("beyond the fence", 20):
        vehicle.accept_set_point(SetPoint((2.0, 0.0, 0.0), is_position=False))
        if vehicle.mode is Mode.LAND or vehicle.body.position_m[0] > 6.0:
            break
    assert [text for _, text in px4.texts() if text.startswith("Geofence")] == texts
    assert vehicle.mode is mode


@pytest.mark.parametrize(("action", "sub_mode"), [(0, 3), (3, 5), (4, 6)])
def test_px4_without_set_points_acts_as_its_parameter_requires(px4: Station, action: int, sub_mode: int) -> None:
    px4.set("COM_OBL_RC_ACT", action)
    px4.fly()
    px4.send_message(local_set_point(0.0, 0.0))
    assert px4.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 6, 0) == OK
    px4.wait(0.5)
    assert px4_mode(px4) == 6 << 16
    px4.wait(1.5)
    assert px4_mode(px4) == 4 << 16 | sub_mode << 24


@pytest.mark.parametrize("action", [3, 4])
def test_px4_still_answers_after_losing_set_points_on_the_ground(px4: Station, action: int) -> None:
    """Neither Return nor Land is accepted on the ground."""
    px4.set("COM_OBL_RC_ACT", action)
    px4.send_message(local_set_point(0.0, 0.0))
    assert px4.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 6, 0) == OK
    assert px4.arm() == OK
    px4.wait(2)
    assert (CRITICAL, "Failsafe activated") in px4.texts()
    assert px4.autopilot.vehicle.body.on_ground
    assert px4.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 0) == OK


def test_px4_still_answers_after_a_mission_that_returns_on_the_ground(px4: Station) -> None:
    px4.autopilot.vehicle.load((Item(6, d.MAV_CMD_NAV_RETURN_TO_LAUNCH, (0.0, 0.0, 0.0, 0.0), 0, 0, 0.0),))
    assert px4.arm() == OK
    assert px4.command(d.MAV_CMD_MISSION_START) == OK
    px4.wait(2)
    assert px4_mode(px4) == 4 << 16 | 3 << 24, "the mode after a mission is Hold"
    assert px4.autopilot.vehicle.body.on_ground


def test_the_system_id_parameter_takes_effect_after_a_reboot(copter: Station) -> None:
    copter.set("SYSID_THISMAV", 9)
    copter.wait(1)
    assert copter.last("HEARTBEAT").get_srcSystem() == SYSTEM
    assert copter.command(d.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == OK
    copter.wait(2)
    assert copter.last("HEARTBEAT").get_srcSystem() == 9
