"""Estimates as people read them: in per cent and milliseconds, with what tells one condition from another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Kind, Quantity
from fieldkit.core.model import ENDED, Status

_SECONDS_FROM_S: Final = 10.0
_WHOLE_FROM: Final = 100.0


@dataclass(frozen=True)
class Scale:
    """How the numbers of a quantity are written.

    Attributes:
        factor: From SI.
        unit: What is written behind them.
    """

    factor: float
    unit: str

    def number(self, value: float | None) -> str:
        """Return a number without its unit: two decimals, none from a hundred on; empty for None."""
        if value is None:
            return ""
        scaled = self.factor * value
        return f"{scaled:.2f}" if abs(scaled) < _WHOLE_FROM else f"{scaled:.0f}"

    def interval(self, low: float | None, high: float | None) -> str:
        """Return `[low, high]`, empty without one."""
        return "" if low is None or high is None else f"[{self.number(low)}, {self.number(high)}]"


def scale(quantity: Quantity, cells: Sequence[Cell]) -> Scale:
    """Return in what to write a quantity of these cells."""
    return scale_of(quantity, [one.estimates[quantity.name].value for one in cells if quantity.name in one.estimates])


def scale_of(quantity: Quantity, values: Sequence[float]) -> Scale:
    """Return in what to write values of a quantity that stand together: shares in per cent."""
    return Scale(100.0, "%") if quantity.unit == "share" else time_scale(max(values, default=0.0))


def time_scale(time_s: float) -> Scale:
    """Return in what to write times like this one: milliseconds, from ten seconds on seconds."""
    return Scale(1e3, "ms") if time_s < _SECONDS_FROM_S else Scale(1.0, "s")


def label(quantity: Quantity) -> str:
    """Return what the figure to quote is, in words."""
    return f"{quantity.label}, median" if quantity.kind is Kind.MEDIAN else quantity.label


def shown(cells: Sequence[Cell], quantities: Sequence[Quantity]) -> list[Quantity]:
    """Return the quantities that any of the cells has."""
    return [one for one in quantities if any(one.name in cell.estimates for cell in cells)]


def key(cell: Cell, name: str) -> str:
    """Return the value of a column that tells conditions, `-` where it is missing."""
    value = cell.key[name]
    return (f"{value:.9g}" if isinstance(value, float) else value) or "-"


def told_by(by: Sequence[str], cells: Sequence[Cell]) -> tuple[list[str], list[str]]:
    """Return the columns in which the cells differ, and those in which all agree.

    A column that only says again what another says is in neither: metres beside the operator's own word for a
    distance, a procedure that is called as its scenario.
    """
    again = {"distance_m"} if "distance" in by else set()
    if {"procedure", "scenario"} <= set(by) and all(one.key["procedure"] == one.key["scenario"] for one in cells):
        again.add("procedure")
    values = {name: {cell.key[name] for cell in cells} for name in by if name not in again}
    return [name for name in values if len(values[name]) > 1], [name for name in values if len(values[name]) == 1]


def counts(cell: Cell) -> str:
    """Return how the attempts of a cell ended: `20 valid, 1 void`."""
    return ended({Status.VALID: cell.n_valid, Status.VOID: cell.n_void, Status.FAILED: cell.n_failed})


def ended(numbers: Mapping[str, int]) -> str:
    """Return how many attempts ended in each way, the same way."""
    return ", ".join(f"{numbers[one]} {one}" for one in ENDED if numbers.get(one)) or "none"
