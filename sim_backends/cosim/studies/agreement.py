"""One rule for whether a printed number agrees with a measured one."""

import math
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

from sim_backends.cosim.studies.intervals import IntervalEstimate


class Agreement(StrEnum):
    """The relation of a measured number to a printed one."""

    AGREES = "agrees"
    ABOVE = "above"
    BELOW = "below"
    NOTHING = "no value"


@dataclass(frozen=True)
class Printed:
    """A number as it was printed.

    Attributes:
        text: Its digits, in the printed unit.
        per_si: Factor from SI units to the printed unit: 100 for %, 1000 for ms.
        step: Precision of numbers of its kind; if empty, that of its last digit.
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
        """The smallest and the largest number, in SI units, that would be printed with this text."""
        exponent = Decimal(self.text).as_tuple().exponent
        assert isinstance(exponent, int)  # not infinity or nan
        step = Decimal(self.step) if self.step else Decimal(1).scaleb(exponent)
        low, high = Decimal(self.text) - step / 2, Decimal(self.text) + step / 2
        return float(low / self.per_si), float(high / self.per_si)


def agreement(printed: Printed, ours: IntervalEstimate) -> Agreement:
    """Return the relation of an estimate to a printed number, both in SI units.

    They agree if the printed number, at its precision, is within the interval of the estimate, or if the value of the
    estimate rounds to it.
    """
    if math.isnan(ours.value):
        return Agreement.NOTHING
    low, high = printed.bounds
    if max(ours.value, _or_value(ours.high, ours.value)) < low:
        return Agreement.BELOW
    if min(ours.value, _or_value(ours.low, ours.value)) > high:
        return Agreement.ABOVE
    return Agreement.AGREES


def _or_value(bound: float, value: float) -> float:
    return value if math.isnan(bound) else bound
