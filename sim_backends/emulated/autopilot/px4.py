"""The behaviour of PX4 1.16 that the emulated autopilot implements."""

from typing import Final

from sim_backends.emulated.autopilot.failsafes import Px4Failsafes
from sim_backends.emulated.autopilot.firmware import Firmware, ModeConditions, ModeRefusal
from sim_backends.emulated.autopilot.mavlink_frames import COMMON_CAPABILITIES, dialect
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


def _custom(main: int, sub: int = 0) -> int:
    """Return the number of a mode in `custom_mode` of HEARTBEAT, from its main mode and its sub mode."""
    return main << 16 | sub << 24


_WITHOUT_EFFECT: Final = without_effect(
    **{f"COM_FLTMODE{number}": -1 for number in range(1, 7)},
    BAT1_CAPACITY=-1.0,
    BAT1_N_CELLS=3,
    BAT1_V_CHARGED=4.05,
    BAT1_V_EMPTY=3.6,
    CAL_ACC0_ID=1310988,
    CAL_GYRO0_ID=1310988,
    CAL_MAG0_ID=197388,
    CBRK_IO_SAFETY=22027,
    COM_RC_IN_MODE=1,
    COM_RC_LOSS_T=0.5,
    MAV_TYPE=2,
    NAV_RCL_ACT=2,
    RC_CHAN_CNT=0,
    RC_MAP_FLTMODE=0,
    RC_MAP_PITCH=0,
    RC_MAP_ROLL=0,
    RC_MAP_THROTTLE=0,
    RC_MAP_YAW=0,
    RTL_DESCEND_ALT=30.0,
    RTL_LAND_DELAY=0.0,
    SYS_AUTOCONFIG=0,
    SYS_AUTOSTART=10040,
    SYS_HITL=0,
)
"""Parameters that QGroundControl and MAVSDK read; the vehicle does not use them."""


def _parameters_within(limits: FlightLimits) -> tuple[Parameter, ...]:
    """Return PX4's parameters (https://docs.px4.io/main/en/advanced_config/parameter_reference)."""
    return (
        *_WITHOUT_EFFECT,
        Parameter("BAT_CRIT_THR", 0.07, 0.05, 0.5),
        Parameter("BAT_EMERGEN_THR", 0.05, 0.03, 0.5),
        Parameter("BAT_LOW_THR", 0.15, 0.12, 0.5),
        Parameter("COM_ARM_BAT_MIN", -1.0, -1.0, 0.9),
        Parameter("COM_DISARM_LAND", 2.0, 0.0, 30.0),
        Parameter("COM_DISARM_PRFLT", 10.0, 0.0, 30.0),
        integer("COM_DL_LOSS_T", 10, 5, 300),
        Parameter("COM_FAIL_ACT_T", 5.0, 0.0, 25.0),
        integer("COM_LOW_BAT_ACT", 0, 0, 3),
        integer("COM_OBL_RC_ACT", 0, 0, 7),
        Parameter("COM_OF_LOSS_T", 1.0, 0.1, 60.0),
        integer("GF_ACTION", 2, 0, 5),
        profile_limit("GF_MAX_HOR_DIST", limits.fence_m, minimum=1.0),
        profile_limit("GF_MAX_VER_DIST", limits.height_m, minimum=1.0),
        integer("MAV_SYS_ID", 1, 1, 250),
        Parameter("MIS_TAKEOFF_ALT", 2.5, 0.5, 80.0),
        Parameter("MPC_ACC_DOWN_MAX", 3.0, 0.5, 15.0),
        Parameter("MPC_ACC_HOR", 3.0, 0.5, 15.0),
        Parameter("MPC_ACC_UP_MAX", 4.0, 0.5, 15.0),
        Parameter("MPC_LAND_ALT2", 5.0, 1.0, 80.0),
        Parameter("MPC_LAND_SPEED", 0.7, 0.1, 2.0),
        profile_limit("MPC_XY_VEL_MAX", limits.speed_m_s, minimum=0.1),
        Parameter("MPC_Z_VEL_MAX_DN", 1.5, 0.1, 4.0),
        Parameter("MPC_Z_VEL_MAX_UP", 3.0, 0.1, 8.0),
        Parameter("NAV_ACC_RAD", 0.5, 0.05, 200.0),
        integer("NAV_DLL_ACT", 0, 0, 3),
        Parameter("RTL_RETURN_ALT", 10.0, 0.0, 150.0),
        Parameter("SIM_BAT_DRAIN", float(FLIGHT_S), 1.0, 86400.0),
        Parameter("SIM_BAT_MIN_PCT", 0.0, 0.0, 100.0),
        # Parameters of ArduPilot that the vehicle reads.
        constant("", FULL_V, "SIM_BATT_VOLTAGE"),
        constant("", 1.0, "WP_YAW_BEHAVIOR"),
    )


def _arming_errors(parameters: Parameters, battery: Battery) -> list[str]:
    # A negative COM_ARM_BAT_MIN means that only a critical battery prevents arming.
    minimum = parameters["COM_ARM_BAT_MIN"] if parameters["COM_ARM_BAT_MIN"] >= 0 else parameters["BAT_CRIT_THR"]
    return ["Low battery"] if battery.charge < minimum else []


def _mode_refusal(mode: Mode, conditions: ModeConditions) -> ModeRefusal | None:
    """Return the refusal of a change of mode; None if it is accepted."""
    is_on_ground = not conditions.is_armed or conditions.on_ground
    if mode in {Mode.LAND, Mode.RTL} and is_on_ground:
        return ModeRefusal(f"{mode.name} denied: not in the air")
    if mode is Mode.OFFBOARD and not conditions.has_recent_set_point:
        return ModeRefusal("OFFBOARD denied: no set-points")
    if mode is Mode.MISSION and not conditions.mission_commands:
        return ModeRefusal("MISSION denied: no mission")
    return None


PX4: Final = Firmware(
    autopilot=_d.MAV_AUTOPILOT_PX4,
    version=0x011000FF,  # 1.16.0, an official release
    capabilities=COMMON_CAPABILITIES | _d.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE,
    base_mode=_d.MAV_MODE_FLAG_STABILIZE_ENABLED | _d.MAV_MODE_FLAG_GUIDED_ENABLED,
    # Main and sub mode (px4_custom_mode.h).
    modes={
        Mode.TAKEOFF: _custom(4, 2),
        Mode.LOITER: _custom(4, 3),
        Mode.MISSION: _custom(4, 4),
        Mode.RTL: _custom(4, 5),
        Mode.LAND: _custom(4, 6),
        Mode.HOMECOMING: _custom(4, 5),
        Mode.OFFBOARD: _custom(6),
        Mode.STABILIZE: _custom(7),
        Mode.ALT_HOLD: _custom(2),
        Mode.POSHOLD: _custom(3),
    },
    names={
        Mode.TAKEOFF: "Takeoff",
        Mode.LOITER: "Hold",
        Mode.MISSION: "Mission",
        Mode.RTL: "Return",
        Mode.LAND: "Land",
        Mode.OFFBOARD: "Offboard",
        Mode.STABILIZE: "Stabilized",
        Mode.ALT_HOLD: "Altitude",
        Mode.POSHOLD: "Position",
    },
    starting_flags=0xA5,  # attitude, vertical velocity, height and constant-position mode; no horizontal position
    boot_mode=Mode.LOITER,
    modes_without_arming=frozenset(),
    refusal_result=_d.MAV_RESULT_TEMPORARILY_REJECTED,
    unknown_mode=_d.MAV_RESULT_DENIED,
    unknown_rate=_d.MAV_RESULT_FAILED,
    unknown_message=_d.MAV_RESULT_DENIED,
    mode_refusal=_mode_refusal,
    prearm_prefixes=("Preflight Fail: ", "Preflight Fail: "),
    arming_errors=_arming_errors,
    parameters=_parameters_within,
    failsafes=Px4Failsafes,
    # Rates of MAVLINK_MODE_NORMAL (mavlink_main.cpp), which PX4 uses on a telemetry radio and on port 14550.
    streams_hz={
        _d.MAVLINK_MSG_ID_ALTITUDE: 1.0,
        _d.MAVLINK_MSG_ID_ATTITUDE: 15.0,
        _d.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
        _d.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 0.5,
        _d.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
        _d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
        _d.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 1.0,
        _d.MAVLINK_MSG_ID_GPS_RAW_INT: 1.0,
        _d.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
        _d.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 1.0,
        _d.MAVLINK_MSG_ID_MISSION_CURRENT: 1.0,
        _d.MAVLINK_MSG_ID_PING: 0.1,
        _d.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
        _d.MAVLINK_MSG_ID_VFR_HUD: 4.0,
    },
    groups=(),
    spool_s=1.0,
    landed_s=1.0,
    fix_type=_d.GPS_FIX_TYPE_3D_FIX,
    holds_without_set_points=False,
    set_points_lift_off=True,
    first_item=0,
)
