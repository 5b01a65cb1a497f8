"""PX4 1.15, as far as the emulated autopilot answers as it does."""

from typing import Final

from sim_backends.emulated.autopilot.battery import Battery
from sim_backends.emulated.autopilot.firmware import Firmware, Mode
from sim_backends.emulated.autopilot.mavlink import COMMON_CAPABILITIES, dialect
from sim_backends.emulated.autopilot.parameters import FlightLimits, Parameter, Parameters, of_profile

_d = dialect
_CRITICAL: Final = 0.07
"""BAT_CRIT_THR, which holds where COM_ARM_BAT_MIN is negative."""


def _custom(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


def _declared(limits: FlightLimits) -> tuple[Parameter, ...]:
    """Return its parameters (https://docs.px4.io/main/en/advanced_config/parameter_reference)."""
    return (
        Parameter("COM_ARM_BAT_MIN", -1.0, -1.0, 0.9),
        Parameter("COM_DISARM_LAND", 2.0, 0.0, 30.0),
        Parameter("COM_DISARM_PRFLT", 10.0, 0.0, 30.0),
        Parameter("COM_OF_LOSS_T", 1.0, 0.1, 60.0),
        of_profile("GF_MAX_HOR_DIST", limits.fence_m, least=1.0),
        of_profile("GF_MAX_VER_DIST", limits.height_m, least=1.0),
        Parameter("MIS_TAKEOFF_ALT", 2.5, 0.5, 80.0),
        Parameter("MPC_ACC_DOWN_MAX", 3.0, 0.5, 15.0),
        Parameter("MPC_ACC_HOR", 3.0, 0.5, 15.0),
        Parameter("MPC_ACC_UP_MAX", 4.0, 0.5, 15.0),
        Parameter("MPC_LAND_ALT2", 5.0, 1.0, 80.0),
        Parameter("MPC_LAND_SPEED", 0.7, 0.1, 2.0),
        of_profile("MPC_XY_VEL_MAX", limits.speed_m_s, least=0.1),
        Parameter("MPC_Z_VEL_MAX_DN", 1.5, 0.1, 4.0),
        Parameter("MPC_Z_VEL_MAX_UP", 3.0, 0.1, 8.0),
        Parameter("NAV_ACC_RAD", 0.5, 0.05, 200.0),
        Parameter("RTL_RETURN_ALT", 10.0, 0.0, 150.0),
    )


def _unfit(parameters: Parameters, battery: Battery) -> list[str]:
    least = parameters["COM_ARM_BAT_MIN"]
    return ["Low battery"] if battery.left < (least if least >= 0 else _CRITICAL) else []


PX4: Final = Firmware(
    autopilot=_d.MAV_AUTOPILOT_PX4,
    version=0x010F00FF,
    capabilities=COMMON_CAPABILITIES | _d.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE,
    base=_d.MAV_MODE_FLAG_STABILIZE_ENABLED | _d.MAV_MODE_FLAG_GUIDED_ENABLED,
    # Main and sub mode (px4_custom_mode.h).
    modes={
        Mode.TAKEOFF: _custom(4, 2),
        Mode.LOITER: _custom(4, 3),
        Mode.MISSION: _custom(4, 4),
        Mode.RTL: _custom(4, 5),
        Mode.LAND: _custom(4, 6),
        Mode.HOMECOMING: _custom(4, 6),
        Mode.OFFBOARD: _custom(6),
    },
    refused=_d.MAV_RESULT_TEMPORARILY_REJECTED,
    silent=False,
    prearm=("Preflight Fail: ", "Preflight Fail: "),
    unfit=_unfit,
    parameters=_declared,
    guided_holds=False,
    lifts_off=True,
    lands_anywhere=False,
    first_item=0,
)
