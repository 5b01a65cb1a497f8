"""The figures of the repeats under one condition, by name, for use in assertions of tests."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.core.errors import ConfigurationError, did_you_mean


@dataclass(frozen=True)
class CellFigure:
    """A figure with its 95 % interval.

    Attributes:
        name: The column that it is calculated from.
        unit: Its unit.
        n: Number of valid repeats that have it.
        value: The figure.
        low: Lower end of the interval; minus infinity for a single repeat, which has no interval.
        high: Upper end; infinity for a single repeat.
    """

    name: str
    unit: str
    n: int
    value: float
    low: float
    high: float


class TrialCell:
    """The repeats under one condition: `cell.file_loss.high`, or `cell["up.file_loss"]` for a step with a name.

    Args:
        cell: The cell.

    Attributes:
        condition: The condition, by column.
        n_valid: Number of valid repeats; all figures are of these.
        n_void: Number of attempts whose evidence was incomplete.
        n_failed: Number of attempts that failed.
    """

    def __init__(self, cell: Cell) -> None:
        self.condition: Mapping[str, str | float | None] = cell.key
        self.n_valid, self.n_void, self.n_failed = cell.n_valid, cell.n_void, cell.n_failed
        self._estimates = cell.estimates

    def __getitem__(self, name: str) -> CellFigure:
        """Return a figure.

        Raises:
            ConfigurationError: No valid repeat has it.
        """
        if name not in self._estimates:
            remedy = did_you_mean(name, self._estimates, f"its figures: {', '.join(self._estimates) or 'none'}")
            raise ConfigurationError(f"none of {self.n_valid} valid repeats has a figure {name!r}", remedy=remedy)
        return _figure(self._estimates[name])

    def __getattr__(self, name: str) -> CellFigure:
        """Return a figure, like `cell[name]`."""
        if name.startswith("_"):
            raise AttributeError(name)
        return self[name]

    def __iter__(self) -> Iterator[CellFigure]:
        """Yield every figure."""
        return map(_figure, self._estimates.values())

    def __repr__(self) -> str:
        condition = ", ".join(
            f"{name}={value!r}" for name, value in self.condition.items() if value not in {None, ""}
        )
        return f"<fieldkit cell {condition}: {self.n_valid} valid>"


def _figure(estimate: Estimate) -> CellFigure:
    return CellFigure(
        name=estimate.quantity.name,
        unit=estimate.quantity.unit,
        n=estimate.n,
        value=estimate.value,
        low=-math.inf if estimate.low is None else estimate.low,
        high=math.inf if estimate.high is None else estimate.high,
    )
