"""The dialects of PX4 and ArduCopter compared with the tables of pymavlink."""

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as d

from fieldkit.agent.autopilots import dialect, mavlink_frames
from fieldkit.agent.autopilots.arducopter import ArduCopter
from fieldkit.agent.autopilots.dialect import FlightDialect
from fieldkit.agent.autopilots.px4 import Px4

COPTER, PX4 = ArduCopter(), Px4()
ACM = {name: number for number, name in mavutil.mode_mapping_acm.items()}


def test_crc_extra_equals_that_of_pymavlink() -> None:
    assert {kind: d.mavlink_map[kind].crc_extra for kind in mavlink_frames.CRC_EXTRA} == mavlink_frames.CRC_EXTRA


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (dialect.RETURN, "NAV_RETURN_TO_LAUNCH"),
        (dialect.LAND, "NAV_LAND"),
        (dialect.TAKE_OFF, "NAV_TAKEOFF"),
        (dialect.SET_MODE, "DO_SET_MODE"),
        (dialect.CHANGE_SPEED, "DO_CHANGE_SPEED"),
        (dialect.ARM, "COMPONENT_ARM_DISARM"),
        (dialect.PREARM_CHECKS, "RUN_PREARM_CHECKS"),
        (mavlink_frames.SET_MESSAGE_INTERVAL, "SET_MESSAGE_INTERVAL"),
        (dialect.REQUEST, "REQUEST_MESSAGE"),
    ],
)
def test_command_numbers_equal_those_of_pymavlink(number: int, name: str) -> None:
    assert d.enums["MAV_CMD"][number].name == f"MAV_CMD_{name}"


def test_arducopter_modes_equal_those_of_pymavlink() -> None:
    def mode(name: str) -> tuple[float, ...]:
        return (d.MAV_CMD_DO_SET_MODE, d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, ACM[name])

    assert COPTER.guided_command() == mode("GUIDED")
    assert COPTER.bring_down_command("land") == mode("LAND")
    assert COPTER.bring_down_command("return") == mode("RTL")
    assert [name for name, number in ACM.items() if COPTER.is_guided(number)] == ["GUIDED"]


def test_px4_modes_equal_those_of_pymavlink() -> None:
    base, main, _ = mavutil.px4_map["OFFBOARD"]
    assert base & d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    assert PX4.guided_command() == (d.MAV_CMD_DO_SET_MODE, d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, main)
    guided = [name for name, (_, main, sub) in mavutil.px4_map.items() if PX4.is_guided(main << 16 | sub << 24)]
    assert guided == ["OFFBOARD"]


def test_mode_names_equal_those_of_pymavlink() -> None:
    px4_modes = {name: PX4.mode_name(main << 16 | sub << 24) for name, (_, main, sub) in mavutil.px4_map.items()}
    del px4_modes["RTGS"], px4_modes["FOLLOWME"]  # no longer in px4_custom_mode.h, which has FOLLOW_TARGET
    assert {name: full_name.rpartition(".")[2] for name, full_name in px4_modes.items()} == {
        name: name for name in px4_modes
    }
    assert PX4.mode_name(4 << 16 | 6 << 24) == "AUTO.LAND"
    obsolete = {"POSITION", "OF_LOITER", "RATE_ACRO"}
    acm_types = {name: COPTER.mode_name(number) for name, number in ACM.items() if name not in obsolete}
    assert acm_types == {name: name for name in acm_types}
    assert (COPTER.mode_name(99), PX4.mode_name(99 << 16)) == ("99", str(99 << 16))


def test_program_controlled_and_landing_modes() -> None:
    assert {name for name, number in ACM.items() if COPTER.is_program_controlled(number)} == {"AUTO", "GUIDED"}
    assert {name for name, number in ACM.items() if COPTER.lands_or_returns(number)} == {
        *("RTL", "LAND", "SMART_RTL", "AUTO_RTL")
    }
    px4_modes = {name: main << 16 | sub << 24 for name, (_, main, sub) in mavutil.px4_map.items()}
    assert {name for name in px4_modes if PX4.is_program_controlled(px4_modes[name])} == {
        "OFFBOARD",
        "TAKEOFF",
        "LOITER",
        "MISSION",
    }
    assert {name for name in px4_modes if PX4.lands_or_returns(px4_modes[name])} == {"RTL", "LAND"}


def test_each_dialect_matches_its_autopilots() -> None:
    copter_types = {kind for kind in range(64) if COPTER.matches(d.MAV_AUTOPILOT_ARDUPILOTMEGA, kind)}
    acm_types = {kind for kind in range(64) if mavutil.mode_mapping_byname(kind) == ACM}
    assert copter_types == acm_types
    assert not COPTER.matches(d.MAV_AUTOPILOT_PX4, d.MAV_TYPE_QUADROTOR)
    assert PX4.matches(d.MAV_AUTOPILOT_PX4, d.MAV_TYPE_QUADROTOR)
    assert not PX4.matches(d.MAV_AUTOPILOT_ARDUPILOTMEGA, d.MAV_TYPE_QUADROTOR)


def test_arducopter_takes_off_by_command_with_a_speed() -> None:
    speed, rise = COPTER.take_off_commands(3.0, 0.5)
    assert speed == (d.MAV_CMD_DO_CHANGE_SPEED, d.SPEED_TYPE_CLIMB_SPEED, 0.5)
    assert rise == (d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3.0)
    assert PX4.take_off_commands(3.0, 0.5) == ()


@pytest.mark.parametrize(
    ("dialect_under_test", "values", "bounds"),
    [
        (COPTER, {}, (None, None, None)),
        (COPTER, {"FENCE_ENABLE": 0, "FENCE_TYPE": 7, "FENCE_ALT_MAX": 5}, (None, None, None)),
        (COPTER, {"FENCE_ENABLE": 1, "FENCE_TYPE": 1, "FENCE_ALT_MAX": 5, "FENCE_RADIUS": 9}, (5, None, None)),
        (COPTER, {"FENCE_ENABLE": 1, "FENCE_TYPE": 7, "FENCE_ALT_MAX": 5, "FENCE_RADIUS": 9}, (5, 9, None)),
        (COPTER, {"RTL_ALT": 1500}, (None, None, 15)),
        (COPTER, {"RTL_ALT_M": 12}, (None, None, 12)),
        (PX4, {"GF_MAX_VER_DIST": 0, "GF_MAX_HOR_DIST": 40, "RTL_RETURN_ALT": 30}, (None, 40, 30)),
    ],
)
def test_limits_from_parameters(
    dialect_under_test: FlightDialect, values: dict[str, float], bounds: tuple[float | None, ...]
) -> None:
    limits = dialect_under_test.limits(values)
    assert (limits.height_m, limits.radius_m, limits.return_m) == bounds
