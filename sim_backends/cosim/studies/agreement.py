"""Whether a number that was printed elsewhere agrees with one that was measured here, by one rule for all."""

import math
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

from sim_backends.cosim.studies.intervals import IntervalEstimate


class Agreement(StrEnum):
    """How a measured number stands to a printed one."""

    AGREES = "agrees"
    ABOVE = "above"
    BELOW = "below"
    NOTHING = "no value"


@dataclass(frozen=True)
class Printed:
    """A number as it was printed.

    Attributes:
        text: Its digits, in the unit in which it was printed.
        per_si: What a value in SI units is multiplied by to be in that unit: 100 for %, 1000 for ms.
        step: In which steps numbers of its kind were printed; empty for that of its own last digit.
    """

    text: str
    per_si: int = 1
    step: str = ""

    @property
    def value(self) -> float:
        """The number, in SI units."""
        return float(Decimal(self.text) / self.per_si)

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the largest number, in SI units, that would have been printed so."""
        exponent = Decimal(self.text).as_tuple().exponent
        assert isinstance(exponent, int)  # it is a number
        step = Decimal(self.step) if self.step else Decimal(1).scaleb(exponent)
        low, high = Decimal(self.text) - step / 2, Decimal(self.text) + step / 2
        return float(low / self.per_si), float(high / self.per_si)


def agreement(printed: Printed, ours: IntervalEstimate) -> Agreement:
    """Return how an estimate stands to a printed number, both in SI units.

    They agree where the printed number, at the precision at which it is printed, lies in the estimate's interval, or
    the estimate's value rounds to it: where some number that would be printed so lies in the interval.
    """
    if math.isnan(ours.value):
        return Agreement.NOTHING
    low, high = printed.bounds
    if max(ours.value, _known(ours.high, ours.value)) < low:
        return Agreement.BELOW
    if min(ours.value, _known(ours.low, ours.value)) > high:
        return Agreement.ABOVE
    return Agreement.AGREES


def _known(bound: float, value: float) -> float:
    return value if math.isnan(bound) else bound
