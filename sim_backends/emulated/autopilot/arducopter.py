"""ArduCopter 4.5, as far as the emulated autopilot answers as it does."""

from typing import Final

from sim_backends.emulated.autopilot.battery import Battery
from sim_backends.emulated.autopilot.firmware import Firmware, Mode
from sim_backends.emulated.autopilot.mavlink import COMMON_CAPABILITIES, dialect
from sim_backends.emulated.autopilot.parameters import FlightLimits, Parameter, Parameters, fixed, of_profile

_d = dialect
_CM: Final = 100.0
_RTL_M: Final = 15.0


def _declared(limits: FlightLimits) -> tuple[Parameter, ...]:
    """Return its parameters (https://ardupilot.org/copter/docs/parameters.html), each with PX4's name."""
    return (
        Parameter("BATT_ARM_VOLT", 0.0, 0.0, 100.0),
        Parameter("DISARM_DELAY", 10.0, 0.0, 127.0, "COM_DISARM_PRFLT"),
        of_profile("FENCE_ALT_MAX", limits.height_m, least=1.0, key="GF_MAX_VER_DIST"),
        fixed("FENCE_ENABLE", 1.0),
        of_profile("FENCE_RADIUS", limits.fence_m, least=1.0, key="GF_MAX_HOR_DIST"),
        fixed("FENCE_TYPE", 3.0),
        Parameter("GUID_TIMEOUT", 3.0, 0.1, 5.0, "COM_OF_LOSS_T"),
        Parameter("LAND_ALT_LOW", 1000.0, 100.0, 10_000.0, "MPC_LAND_ALT2", _CM),
        Parameter("LAND_SPEED", 50.0, 30.0, 200.0, "MPC_LAND_SPEED", _CM),
        Parameter("RTL_ALT", _CM * min(_RTL_M, limits.height_m), 30.0, 300_000.0, "RTL_RETURN_ALT", _CM),
        Parameter("WPNAV_ACCEL", 250.0, 50.0, 500.0, "MPC_ACC_HOR", _CM),
        Parameter("WPNAV_ACCEL_Z", 100.0, 50.0, 500.0, "MPC_ACC_UP_MAX", _CM),
        Parameter("WPNAV_RADIUS", 200.0, 5.0, 1000.0, "NAV_ACC_RAD", _CM),
        of_profile("WPNAV_SPEED", limits.speed_m_s, least=0.1, key="MPC_XY_VEL_MAX", scale=_CM),
        Parameter("WPNAV_SPEED_DN", 150.0, 10.0, 500.0, "MPC_Z_VEL_MAX_DN", _CM),
        Parameter("WPNAV_SPEED_UP", 250.0, 10.0, 1000.0, "MPC_Z_VEL_MAX_UP", _CM),
        # Constants of its code, or of no meaning to it.
        fixed("", 1.0, "COM_DISARM_LAND"),
        fixed("", 1.0, "MPC_ACC_DOWN_MAX"),
        fixed("", 0.0, "MIS_TAKEOFF_ALT"),
    )


def _unfit(parameters: Parameters, battery: Battery) -> list[str]:
    low = battery.voltage_v < parameters["BATT_ARM_VOLT"]
    return ["Battery 1 below minimum arming voltage"] if low else []


ARDUCOPTER: Final = Firmware(
    autopilot=_d.MAV_AUTOPILOT_ARDUPILOTMEGA,
    version=0x040507FF,
    capabilities=COMMON_CAPABILITIES | _d.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST,
    base=_d.MAV_MODE_FLAG_STABILIZE_ENABLED | _d.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | _d.MAV_MODE_FLAG_GUIDED_ENABLED,
    # ArduCopter/mode.h; a take-off by command is a part of GUIDED, and the last piece of RTL one of RTL.
    modes={
        Mode.OFFBOARD: 4,
        Mode.TAKEOFF: 4,
        Mode.LOITER: 5,
        Mode.MISSION: 3,
        Mode.RTL: 6,
        Mode.HOMECOMING: 6,
        Mode.LAND: 9,
    },
    refused=_d.MAV_RESULT_FAILED,
    silent=True,
    prearm=("PreArm: ", "Arm: "),
    unfit=_unfit,
    parameters=_declared,
    guided_holds=True,
    lifts_off=False,
    lands_anywhere=True,
    first_item=1,
)
