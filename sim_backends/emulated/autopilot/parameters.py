"""Parameters of the emulated autopilot: named and counted as its family does, and read in SI by PX4's names.

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
        name: What its family calls it; empty for a constant of which nobody is told.
        value: Where it stands when the drone is switched on.
        least: Nobody may set less.
        most: Nor more.
        key: PX4's name for it, by which the drone reads it; empty where that is `name`.
        scale: So many of its units are one of SI.
    """

    name: str
    value: float
    least: float
    most: float
    key: str = ""
    scale: float = 1.0


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


def of_profile(name: str, most: float, *, least: float, key: str = "", scale: float = 1.0) -> Parameter:
    """Return a parameter that stands at its most, which a profile says in SI."""
    return Parameter(name, most * scale, min(least, most) * scale, most * scale, key, scale)


def fixed(name: str, value: float, key: str = "") -> Parameter:
    """Return a parameter that has one value."""
    return Parameter(name, value, value, value, key)


class Parameters:
    """The values that hold now.

    Args:
        declared: What there is, in the order of their numbers.
    """

    def __init__(self, declared: tuple[Parameter, ...]) -> None:
        self._by_key = {one.key or one.name: one for one in declared}
        self._key_of = {one.name: one.key or one.name for one in declared if one.name}
        self._values = {key: one.value for key, one in self._by_key.items()}
        self.names: Final = tuple(self._key_of)

    def __getitem__(self, key: str) -> float:
        """Return a value in SI, by PX4's name."""
        return self._values[key] / self._by_key[key].scale

    def told(self, name: str) -> float:
        """Return a value as its family counts it, by the family's name."""
        return self._values[self._key_of[name]]

    def set(self, name: str, value: float) -> bool:
        """Set a parameter by the family's name; return whether there is one that may have this value."""
        return name in self._key_of and self._put(self._key_of[name], value)

    def change(self, key: str, value: float) -> bool:
        """Do the same in SI, by PX4's name."""
        return self._put(key, value * self._by_key[key].scale)

    def _put(self, key: str, value: float) -> bool:
        one = self._by_key[key]
        if not math.isfinite(value) or not one.least <= value <= one.most:
            return False
        self._values[key] = value
        return True
