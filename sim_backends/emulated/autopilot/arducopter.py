"""The behaviour of ArduCopter 4.6 that the emulated autopilot implements."""

from typing import Final

from sim_backends.emulated.autopilot.failsafes import ArduCopterFailsafes
from sim_backends.emulated.autopilot.firmware import Firmware, ModeConditions, ModeRefusal, StreamGroup
from sim_backends.emulated.autopilot.mavlink_frames import COMMON_CAPABILITIES, EKF_STATUS_REPORT, dialect
from sim_backends.emulated.autopilot.modes import Mode
from sim_backends.emulated.autopilot.onboard_estimates import FLIGHT_S, FULL_V, Battery
from sim_backends.emulated.autopilot.parameters import (
    FlightLimits,
    Parameter,
    Parameters,
    constant,
    integer,
    profile_limit,
    without_effect,
)

_d = dialect
_FIRST_ITEM: Final = 1
"""Number of the first item of a mission that is flown; item 0 is home."""
_CM: Final = 100.0
"""Centimetres per metre."""
_RTL_M: Final = 15.0
"""Default of the height of RTL above home."""

_WITHOUT_EFFECT: Final = without_effect(
    **{f"FLTMODE{number}": mode for number, mode in enumerate((7, 9, 6, 3, 5, 0), 1)},
    **{
        f"RC{channel}_{end}": us
        for channel in range(1, 9)
        for end, us in (("MIN", 1000), ("MAX", 2000), ("TRIM", 1500))
    },
    **{f"RCMAP_{axis}": number for number, axis in enumerate(("ROLL", "PITCH", "THROTTLE", "YAW"), 1)},
    ARMING_CHECK=1,
    BATT_MONITOR=4,
    COMPASS_DEV_ID=97539,
    COMPASS_OFS_X=5.0,
    COMPASS_OFS_Y=13.0,
    COMPASS_OFS_Z=-18.0,
    COMPASS_USE=1,
    FLTMODE_CH=5,
    FORMAT_VERSION=120,
    FRAME_CLASS=1,
    FRAME_TYPE=0,
    FS_EKF_ACTION=1,
    FS_THR_ENABLE=0,
    INS_ACC_ID=2753028,
    INS_ACCOFFS_X=0.001,
    INS_ACCOFFS_Y=0.001,
    INS_ACCOFFS_Z=0.001,
    INS_GYROFFS_X=0.001,
    INS_GYROFFS_Y=0.001,
    INS_GYROFFS_Z=0.001,
    INS_GYR_ID=2752772,
    PILOT_THR_FILT=0.0,
    RTL_ALT_FINAL=0,
    RTL_LOIT_TIME=0,
    STAT_RUNTIME=0,
)
"""Parameters that QGroundControl, MAVProxy and MAVSDK read; the vehicle does not use them."""

_GROUPS: Final = (
    StreamGroup(_d.MAV_DATA_STREAM_RAW_SENSORS, "SR0_RAW_SENS", (_d.MAVLINK_MSG_ID_RAW_IMU,)),
    StreamGroup(
        _d.MAV_DATA_STREAM_EXTENDED_STATUS,
        "SR0_EXT_STAT",
        (
            _d.MAVLINK_MSG_ID_SYS_STATUS,
            _d.MAVLINK_MSG_ID_GPS_RAW_INT,
            _d.MAVLINK_MSG_ID_MISSION_CURRENT,
        ),
    ),
    StreamGroup(_d.MAV_DATA_STREAM_RC_CHANNELS, "SR0_RC_CHAN", ()),
    StreamGroup(_d.MAV_DATA_STREAM_RAW_CONTROLLER, "SR0_RAW_CTRL", ()),
    StreamGroup(
        _d.MAV_DATA_STREAM_POSITION,
        "SR0_POSITION",
        (
            _d.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            _d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        ),
    ),
    StreamGroup(_d.MAV_DATA_STREAM_EXTRA1, "SR0_EXTRA1", (_d.MAVLINK_MSG_ID_ATTITUDE,)),
    StreamGroup(_d.MAV_DATA_STREAM_EXTRA2, "SR0_EXTRA2", (_d.MAVLINK_MSG_ID_VFR_HUD,)),
    StreamGroup(_d.MAV_DATA_STREAM_EXTRA3, "SR0_EXTRA3", (_d.MAVLINK_MSG_ID_BATTERY_STATUS, EKF_STATUS_REPORT)),
)


def _parameters_within(limits: FlightLimits) -> tuple[Parameter, ...]:
    """Return ArduCopter's parameters, with PX4's names as keys (https://ardupilot.org/copter/docs/parameters.html)."""
    return (
        *_WITHOUT_EFFECT,
        *(integer(group.parameter, 0, 0, 50) for group in _GROUPS),
        Parameter("BATT_ARM_VOLT", 0.0, 0.0, 100.0),
        integer("BATT_CAPACITY", 3300, 0, 100_000),
        integer("BATT_CRT_MAH", 0, 0, 100_000),
        Parameter("BATT_CRT_VOLT", 0.0, 0.0, 100.0),
        integer("BATT_FS_CRT_ACT", 0, 0, 7),
        integer("BATT_FS_LOW_ACT", 0, 0, 7),
        integer("BATT_LOW_MAH", 0, 0, 100_000),
        integer("BATT_LOW_TIMER", 10, 0, 120),
        Parameter("BATT_LOW_VOLT", 10.5, 0.0, 100.0),
        Parameter("DISARM_DELAY", 10.0, 0.0, 127.0, "COM_DISARM_PRFLT"),
        integer("FENCE_ACTION", 1, 0, 5),
        profile_limit("FENCE_ALT_MAX", limits.height_m, minimum=1.0, key="GF_MAX_VER_DIST"),
        Parameter("FENCE_ENABLE", 1, 1, 1, integer=True),
        profile_limit("FENCE_RADIUS", limits.fence_m, minimum=1.0, key="GF_MAX_HOR_DIST"),
        Parameter("FENCE_TYPE", 3, 3, 3, integer=True),
        integer("FS_GCS_ENABLE", 0, 0, 7),
        Parameter("FS_GCS_TIMEOUT", 5.0, 2.0, 120.0),
        Parameter("GUID_TIMEOUT", 3.0, 0.1, 5.0, "COM_OF_LOSS_T"),
        Parameter("LAND_ALT_LOW", 1000.0, 100.0, 10_000.0, "MPC_LAND_ALT2", _CM),
        Parameter("LAND_SPEED", 50.0, 30.0, 200.0, "MPC_LAND_SPEED", _CM),
        Parameter("RTL_ALT", _CM * min(_RTL_M, limits.height_m), 30.0, 300_000.0, "RTL_RETURN_ALT", _CM),
        Parameter("SIM_BATT_VOLTAGE", FULL_V, 0.0, 100.0),
        integer("SYSID_MYGCS", 255, 1, 255),
        integer("SYSID_THISMAV", 1, 1, 255, "MAV_SYS_ID"),
        Parameter("WPNAV_ACCEL", 250.0, 50.0, 500.0, "MPC_ACC_HOR", _CM),
        Parameter("WPNAV_ACCEL_Z", 100.0, 50.0, 500.0, "MPC_ACC_UP_MAX", _CM),
        Parameter("WPNAV_RADIUS", 200.0, 5.0, 1000.0, "NAV_ACC_RAD", _CM),
        profile_limit("WPNAV_SPEED", limits.speed_m_s, minimum=0.1, key="MPC_XY_VEL_MAX", scale=_CM),
        Parameter("WPNAV_SPEED_DN", 150.0, 10.0, 500.0, "MPC_Z_VEL_MAX_DN", _CM),
        Parameter("WPNAV_SPEED_UP", 250.0, 10.0, 1000.0, "MPC_Z_VEL_MAX_UP", _CM),
        integer("WP_YAW_BEHAVIOR", 2, 0, 3),
        # Constants in ArduCopter's code, or parameters of PX4 that the vehicle reads.
        constant("", 2.1, "COM_DISARM_LAND"),
        constant("", 1.0, "MPC_ACC_DOWN_MAX"),
        constant("", 0.0, "MIS_TAKEOFF_ALT"),
        constant("", float(FLIGHT_S), "SIM_BAT_DRAIN"),
        constant("", 0.0, "SIM_BAT_MIN_PCT"),
    )


def _arming_errors(parameters: Parameters, battery: Battery) -> list[str]:
    low = battery.voltage_v < parameters["BATT_ARM_VOLT"]
    return ["Battery 1 below minimum arming voltage"] if low else []


def _mode_refusal(mode: Mode, conditions: ModeConditions) -> ModeRefusal | None:
    """Return the refusal of a change of mode, or None; a disarmed vehicle accepts any mode (Copter::set_mode)."""
    if mode is not Mode.MISSION or not conditions.is_armed:
        return None
    text, commands = "Mode change to AUTO failed: init failed", conditions.mission_commands
    if len(commands) <= _FIRST_ITEM:
        return ModeRefusal(text)
    if conditions.has_landed and commands[_FIRST_ITEM] != _d.MAV_CMD_NAV_TAKEOFF:
        return ModeRefusal(text, "Auto: Missing Takeoff Cmd")
    return None


ARDUCOPTER: Final = Firmware(
    autopilot=_d.MAV_AUTOPILOT_ARDUPILOTMEGA,
    version=0x040600FF,  # 4.6.0, an official release
    capabilities=COMMON_CAPABILITIES | _d.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST,
    base_mode=_d.MAV_MODE_FLAG_STABILIZE_ENABLED
    | _d.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    | _d.MAV_MODE_FLAG_GUIDED_ENABLED,
    # ArduCopter/mode.h; a commanded take-off is part of GUIDED, and the descent at home is part of RTL.
    modes={
        Mode.OFFBOARD: 4,
        Mode.TAKEOFF: 4,
        Mode.STABILIZE: 0,
        Mode.ALT_HOLD: 2,
        Mode.MISSION: 3,
        Mode.LOITER: 5,
        Mode.RTL: 6,
        Mode.HOMECOMING: 6,
        Mode.LAND: 9,
        Mode.POSHOLD: 16,
        Mode.BRAKE: 17,
    },
    names={
        Mode.STABILIZE: "STABILIZE",
        Mode.ALT_HOLD: "ALT_HOLD",
        Mode.MISSION: "AUTO",
        Mode.OFFBOARD: "GUIDED",
        Mode.LOITER: "LOITER",
        Mode.RTL: "RTL",
        Mode.LAND: "LAND",
        Mode.POSHOLD: "POSHOLD",
        Mode.BRAKE: "BRAKE",
    },
    starting_flags=0xA7,  # attitude, velocities, height and constant-position mode; no horizontal position
    boot_mode=Mode.STABILIZE,
    modes_without_arming=frozenset({Mode.LAND, Mode.RTL, Mode.HOMECOMING, Mode.BRAKE, Mode.MISSION}),
    refusal_result=_d.MAV_RESULT_FAILED,
    unknown_mode=_d.MAV_RESULT_FAILED,
    unknown_rate=_d.MAV_RESULT_DENIED,
    unknown_message=_d.MAV_RESULT_FAILED,
    mode_refusal=_mode_refusal,
    prearm_prefixes=("PreArm: ", "Arm: "),
    arming_errors=_arming_errors,
    parameters=_parameters_within,
    failsafes=ArduCopterFailsafes,
    streams_hz={_d.MAVLINK_MSG_ID_TIMESYNC: 0.1},
    groups=_GROUPS,
    spool_s=3.0,
    landed_s=1.0,
    fix_type=_d.GPS_FIX_TYPE_RTK_FIXED,
    holds_without_set_points=True,
    set_points_lift_off=False,
    first_item=_FIRST_ITEM,
)
