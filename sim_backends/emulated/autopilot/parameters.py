"""Parameters of the emulated autopilots.

Clients use the names and units of the firmware. The vehicle reads the values in SI units, by PX4's names.
"""

import math
from dataclasses import dataclass
from typing import Final

NAME_BYTES: Final = 16
"""Length of a name in messages."""


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        name: Name in the firmware; empty for an internal constant that is not listed.
        value: Value at power-on.
        minimum: Smallest value that is accepted.
        maximum: Largest value that is accepted.
        key: PX4's name, by which the vehicle reads it; empty if it equals `name`.
        scale: Number of its units per SI unit, for example 100 for centimetres.
        integer: True if it is an integer (MAV_PARAM_TYPE_INT32); otherwise a float (REAL32).
    """

    name: str
    value: float
    minimum: float
    maximum: float
    key: str = ""
    scale: float = 1.0
    integer: bool = False


DEFAULT_LIMITS_M: Final = 30.0, 100.0
"""Height and distance limits of a drone whose profile has none."""


@dataclass(frozen=True)
class FlightLimits:
    """Limits of a drone's profile; no parameter can exceed them.

    Attributes:
        speed_m_s: Ground speed.
        height_m: Height above home.
        fence_m: Horizontal distance from home.
    """

    speed_m_s: float
    height_m: float
    fence_m: float


def profile_limit(name: str, maximum: float, *, minimum: float, key: str = "", scale: float = 1.0) -> Parameter:
    """Return a parameter whose value and maximum are a limit of the profile, in SI units."""
    return Parameter(name, maximum * scale, min(minimum, maximum) * scale, maximum * scale, key, scale)


def constant(name: str, value: float, key: str = "") -> Parameter:
    """Return a float parameter with a constant value."""
    return Parameter(name, value, value, value, key)


def integer(name: str, value: int, minimum: int, maximum: int, key: str = "") -> Parameter:
    """Return an integer parameter."""
    return Parameter(name, value, minimum, maximum, key, integer=True)


def without_effect(**values: float) -> tuple[Parameter, ...]:
    """Return parameters that ground stations read and write, but that have no effect on the emulated vehicle."""
    limit = 1e9
    return tuple(
        Parameter(name, value, -limit, limit, integer=isinstance(value, int))
        for name, value in sorted(values.items())
    )


class Parameters:
    """Current values of the parameters.

    Args:
        parameters: All parameters.

    Attributes:
        names: The firmware's names of the parameters, without internal constants, sorted.
    """

    def __init__(self, parameters: tuple[Parameter, ...]) -> None:
        self._by_key = {parameter.key or parameter.name: parameter for parameter in parameters}
        self._key_of = {
            parameter.name: parameter.key or parameter.name
            for parameter in sorted(parameters, key=lambda parameter: parameter.name)
            if parameter.name
        }
        self._values = {key: parameter.value for key, parameter in self._by_key.items()}
        self.names: Final = tuple(self._key_of)

    def __getitem__(self, key: str) -> float:
        """Return a value in SI units, by PX4's name."""
        return self._values[key] / self._by_key[key].scale

    def __contains__(self, key: str) -> bool:
        """Return True if there is a parameter of this key."""
        return key in self._values

    def firmware_value(self, name: str) -> float:
        """Return a value in the units of the firmware, by the firmware's name."""
        return self._values[self._key_of[name]]

    def is_integer(self, name: str) -> bool:
        """Return True if the parameter of this firmware name is an integer."""
        return self._by_key[self._key_of[name]].integer

    def set(self, name: str, value: float) -> bool:
        """Set a parameter by the firmware's name; return True if it exists and accepts the value."""
        return name in self._key_of and self._store(self._key_of[name], value)

    def change(self, key: str, value: float) -> bool:
        """Set a parameter in SI units, by PX4's name; return True if it accepts the value."""
        return self._store(key, value * self._by_key[key].scale)

    def _store(self, key: str, value: float) -> bool:
        parameter = self._by_key[key]
        if not math.isfinite(value) or not parameter.minimum <= value <= parameter.maximum:
            return False
        self._values[key] = round(value) if parameter.integer else value
        return True
