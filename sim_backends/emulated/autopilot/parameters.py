"""Parameters of the emulated autopilot, named and meant as PX4's (https://docs.px4.io/main/en/advanced_config/parameter_reference).

All are floats, so that both ways in which autopilots encode integers are the same.
"""

import math
from dataclasses import dataclass
from typing import Final

NAME_BYTES: Final = 16


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        name: PX4's.
        value: Where it stands when the drone is switched on.
        least: Nobody may set less.
        most: Nor more.
    """

    name: str
    value: float
    least: float
    most: float


USUAL_M: Final = 30.0, 100.0
"""Height and fence of a drone whose profile does not say."""


@dataclass(frozen=True)
class FlightLimits:
    """What a drone's profile lets it do; no parameter lets it do more.

    Attributes:
        speed_m_s: Over the ground.
        height_m: Above home.
        fence_m: From home, over the ground.
    """

    speed_m_s: float
    height_m: float
    fence_m: float


def declared(limits: FlightLimits) -> tuple[Parameter, ...]:
    """Return the parameters of a drone with these limits.

    Heights and distances are metres from home, speeds m/s, times seconds.
    """
    height_m, speed_m_s = limits.height_m, limits.speed_m_s
    return (
        Parameter("COM_DISARM_LAND", 2.0, 0.0, 30.0),
        Parameter("COM_DISARM_PRFLT", 10.0, 0.0, 30.0),
        Parameter("COM_OF_LOSS_T", 1.0, 0.1, 60.0),
        Parameter("GF_MAX_HOR_DIST", limits.fence_m, min(1.0, limits.fence_m), limits.fence_m),
        Parameter("GF_MAX_VER_DIST", height_m, min(1.0, height_m), height_m),
        Parameter("MIS_TAKEOFF_ALT", 2.5, 0.5, 80.0),
        Parameter("MPC_ACC_DOWN_MAX", 3.0, 0.5, 15.0),
        Parameter("MPC_ACC_HOR", 3.0, 0.5, 15.0),
        Parameter("MPC_ACC_UP_MAX", 4.0, 0.5, 15.0),
        Parameter("MPC_LAND_SPEED", 0.7, 0.1, 2.0),
        Parameter("MPC_XY_VEL_MAX", speed_m_s, min(0.1, speed_m_s), speed_m_s),
        Parameter("MPC_Z_VEL_MAX_DN", 1.5, 0.1, 4.0),
        Parameter("MPC_Z_VEL_MAX_UP", 3.0, 0.1, 8.0),
        Parameter("NAV_ACC_RAD", 0.5, 0.05, 200.0),
        Parameter("RTL_RETURN_ALT", 10.0, 0.0, 150.0),
    )


class Parameters:
    """The values that hold now.

    Args:
        declared: What there is, in the order of their numbers.
    """

    def __init__(self, declared: tuple[Parameter, ...]) -> None:
        self._declared = {one.name: one for one in declared}
        self._values = {one.name: one.value for one in declared}
        self.names: Final = tuple(self._declared)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def set(self, name: str, value: float) -> bool:
        """Set a parameter; return whether there is one and it may have this value, which changes nothing if not."""
        one = self._declared.get(name)
        if one is None or not math.isfinite(value) or not one.least <= value <= one.most:
            return False
        self._values[name] = value
        return True
