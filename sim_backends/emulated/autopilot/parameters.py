"""Parameters of the emulated autopilot: with the names and units of its family, read in SI units by PX4's names."""

import math
from dataclasses import dataclass
from typing import Final

NAME_BYTES: Final = 16


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        name: Name in its family; empty for an internal constant that is not listed.
        value: Value at power-on.
        least: Smallest value that is accepted.
        most: Largest value that is accepted.
        key: PX4's name for it, by which the vehicle reads it; empty where that is `name`.
        scale: This many of its units are one of SI.
        integer: Whether it is an integer (MAV_PARAM_TYPE_INT32), else a float (REAL32).
    """

    name: str
    value: float
    least: float
    most: float
    key: str = ""
    scale: float = 1.0
    integer: bool = False


USUAL_M: Final = 30.0, 100.0
"""Height and fence of a drone whose profile does not have them."""


@dataclass(frozen=True)
class FlightLimits:
    """Limits of a drone's profile; no parameter can exceed them.

    Attributes:
        speed_m_s: Over the ground.
        height_m: Above home.
        fence_m: From home, over the ground.
    """

    speed_m_s: float
    height_m: float
    fence_m: float


def of_profile(name: str, most: float, *, least: float, key: str = "", scale: float = 1.0) -> Parameter:
    """Return a parameter whose value is its maximum, which a profile gives in SI units."""
    return Parameter(name, most * scale, min(least, most) * scale, most * scale, key, scale)


def fixed(name: str, value: float, key: str = "") -> Parameter:
    """Return a float that has one value."""
    return Parameter(name, value, value, value, key)


def integer(name: str, value: int, least: int, most: int, key: str = "") -> Parameter:
    """Return an integer parameter."""
    return Parameter(name, value, least, most, key, integer=True)


def stored(**values: float) -> tuple[Parameter, ...]:
    """Return parameters that ground stations read and write, and that change nothing in the emulated vehicle."""
    big = 1e9
    return tuple(
        Parameter(name, value, -big, big, integer=isinstance(value, int)) for name, value in sorted(values.items())
    )


class Parameters:
    """The current values.

    Args:
        declared: All parameters; they are listed by name.
    """

    def __init__(self, declared: tuple[Parameter, ...]) -> None:
        self._by_key = {parameter.key or parameter.name: parameter for parameter in declared}
        self._key_of = {
            parameter.name: parameter.key or parameter.name
            for parameter in sorted(declared, key=lambda parameter: parameter.name)
            if parameter.name
        }
        self._values = {key: parameter.value for key, parameter in self._by_key.items()}
        self.names: Final = tuple(self._key_of)

    def __getitem__(self, key: str) -> float:
        """Return a value in SI units, by PX4's name."""
        return self._values[key] / self._by_key[key].scale

    def __contains__(self, key: str) -> bool:
        """Return whether there is a parameter of this key."""
        return key in self._values

    def listed(self, name: str) -> float:
        """Return a value in the units of the family, by the family's name."""
        return self._values[self._key_of[name]]

    def is_integer(self, name: str) -> bool:
        """Return whether the parameter of the family's name is an integer."""
        return self._by_key[self._key_of[name]].integer

    def set(self, name: str, value: float) -> bool:
        """Set a parameter by the family's name; return whether it exists and accepts this value."""
        return name in self._key_of and self._put(self._key_of[name], value)

    def change(self, key: str, value: float) -> bool:
        """Set a parameter in SI units, by PX4's name; return whether it accepts this value."""
        return self._put(key, value * self._by_key[key].scale)

    def _put(self, key: str, value: float) -> bool:
        parameter = self._by_key[key]
        if not math.isfinite(value) or not parameter.least <= value <= parameter.most:
            return False
        self._values[key] = round(value) if parameter.integer else value
        return True
