"""Comparison of two runs A and B: differences per condition and quantity.

A cell has the estimates and counts of the repeats under one condition.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fieldkit.analysis import comparable, significance
from fieldkit.analysis.cells import Cell, Estimate, aggregate
from fieldkit.analysis.comparable import Concern
from fieldkit.analysis.parsing import Numbers
from fieldkit.analysis.quantities import Quantity, Tally, quantities
from fieldkit.analysis.repeats import Key, Repeats
from fieldkit.core.columns import cell_text
from fieldkit.core.model import Interval, Status

PAIRED_BY: Final = ("scenario", "topology", "distance_m", "protocol")
"""Columns that must be equal for two cells to be compared; the backend and the names of trials may differ."""


@dataclass(frozen=True)
class Difference:
    """Difference of one quantity under one condition between two runs.

    Attributes:
        quantity: The quantity.
        a: Estimate of A; None if A did not measure it.
        b: Estimate of B; None if B did not measure it.
        interval: B - A with its 95 % interval; None if one of the estimates has no interval.
        cliffs_delta: Effect size over repeats (`significance.cliffs_delta`); None unless both runs measured it.
        p_holm: p-value, corrected for the number of all comparisons; None without an interval.
        threshold: Maximum acceptable difference; None without a threshold.
    """

    quantity: Quantity
    a: Estimate | None
    b: Estimate | None
    interval: Interval | None = None
    cliffs_delta: float | None = None
    p_holm: float | None = None
    threshold: float | None = None

    @property
    def value(self) -> float | None:
        """B - A; None unless both runs measured the quantity."""
        return None if self.a is None or self.b is None else self.b.value - self.a.value

    @property
    def excludes_zero(self) -> bool:
        """True if 0 is outside of the interval."""
        return self.interval is not None and not self.interval.low <= 0 <= self.interval.high

    @property
    def within(self) -> bool | None:
        """True if the whole interval is within plus or minus the threshold; None without a threshold.

        False without an interval.
        """
        if self.threshold is None:
            return None
        return self.interval is not None and max(-self.interval.low, self.interval.high) <= self.threshold


@dataclass(frozen=True)
class Pair:
    """One condition in both runs.

    Attributes:
        name: Name of the condition, such as `los, master, 9.144 m, udp`.
        key: Value of each column that identifies the condition.
        a: The cell of A; None if A has no such condition.
        b: The cell of B; None if B has no such condition.
        differences: Differences of the quantities that either cell has.
    """

    name: str
    key: Mapping[str, str | float | None]
    a: Cell | None
    b: Cell | None
    differences: tuple[Difference, ...]

    @property
    def missing_in(self) -> str:
        """`A` or `B` if that run has no such condition, otherwise empty."""
        return "A" if self.a is None else "B" if self.b is None else ""

    @property
    def words(self) -> tuple[tuple[Tally, Tally], ...]:
        """Word counts of A and B for each column with categorical text in either cell; counts may be empty."""
        a, b = (cell.tallies if cell else {} for cell in (self.a, self.b))
        empty = {name: replace(tally, counts={}) for name, tally in (*a.items(), *b.items())}
        return tuple((a.get(name, tally), b.get(name, tally)) for name, tally in empty.items())


@dataclass(frozen=True)
class Comparison:
    """Comparison of two runs.

    Attributes:
        by: Columns that identify a condition.
        pairs: All conditions of either run; conditions of A are first.
        concerns: Concerns about comparing the runs, refusals first.
    """

    by: tuple[str, ...]
    pairs: tuple[Pair, ...]
    concerns: tuple[Concern, ...]

    @property
    def differences(self) -> tuple[Difference, ...]:
        """Differences of all conditions."""
        return tuple(difference for pair in self.pairs for difference in pair.differences)

    @property
    def n_compared(self) -> int:
        """Number of differences with an interval. `p_holm` is corrected for this number."""
        return sum(difference.interval is not None for difference in self.differences)

    @property
    def refusals(self) -> tuple[Concern, ...]:
        """Reasons why the runs are not comparable; empty if they are comparable."""
        return tuple(concern for concern in self.concerns if concern.refuses)

    @property
    def varied(self) -> tuple[Concern, ...]:
        """Columns of `comparable.VARIED` that are the variable of the comparison, with their values in A and B.

        Such a column has one value in each run, and does not identify conditions.
        """
        return tuple(
            concern
            for concern in self.concerns
            if not concern.refuses
            and concern.what in comparable.VARIED
            and comparable.UNKNOWN not in {concern.a, concern.b}
        )

    @property
    def exceeds_threshold(self) -> bool:
        """True if a difference is not shown to be within its threshold."""
        return any(difference.within is False for difference in self.differences)


def compare(
    a: Repeats,
    b: Repeats,
    by: Sequence[str] = PAIRED_BY,
    *,
    thresholds: Mapping[str, float] | None = None,
    varied: Collection[str] = (),
) -> Comparison:
    """Compare two runs, which are assumed to be independent. Repeats are the sampling units.

    Args:
        a: All attempts of A.
        b: All attempts of B.
        by: Columns that identify a condition.
        thresholds: Maximum acceptable difference by name of the quantity, in its unit.
        varied: Columns that may differ, because they are the variable of the comparison.
    """
    all_quantities = _quantities(a, b)
    cells_a, cells_b = (_cells(rows, by) for rows in (a, b))
    rows_a, rows_b = (_valid(rows, by) for rows in (a, b))
    pairs = []
    for key in cells_a | cells_b:
        sides = cells_a.get(key), cells_b.get(key)
        differences = _differences(sides, (rows_a.get(key), rows_b.get(key)), all_quantities, thresholds or {})
        pairs.append(Pair(_condition_name(by, key), dict(zip(by, key, strict=True)), *sides, differences))
    common = [(_condition_name(by, key), rows_a[key], rows_b[key]) for key in rows_a if key in rows_b]
    return Comparison(
        tuple(by), _with_holm(pairs), (*comparable.concerns(common, by, varied), *comparable.notes(a, b))
    )


def _quantities(a: Repeats, b: Repeats) -> tuple[Quantity, ...]:
    """Return the quantities of either run, in the order of tables."""
    names = {quantity.name for rows in (a, b) for quantity in rows.quantities}
    columns = {column.name: column for column in (*b.columns, *a.columns)}
    ordered = dict.fromkeys(column.name for column in (*a.columns, *b.columns))
    return tuple(quantity for quantity in quantities(columns[name] for name in ordered) if quantity.name in names)


def _cells(rows: Repeats, by: Sequence[str]) -> dict[Key, Cell]:
    """Return the cells by their values of the columns `by`."""
    return {tuple(cell.key[name] for name in by): cell for cell in aggregate(rows, by)}


def _valid(rows: Repeats, by: Sequence[str]) -> dict[Key, Repeats]:
    """Return the valid repeats by condition."""
    valid = rows.where(rows.texts["status"] == Status.VALID)
    return {key: valid.where(rows_of_key) for key, rows_of_key in valid.groups(by).items()}


def _differences(
    cells: tuple[Cell | None, Cell | None],
    rows: tuple[Repeats | None, Repeats | None],
    compared: Iterable[Quantity],
    thresholds: Mapping[str, float],
) -> tuple[Difference, ...]:
    """Return the differences of all quantities that A or B has under one condition."""
    differences = []
    for quantity in compared:
        a, b = (None if cell is None else cell.estimates.get(quantity.name) for cell in cells)
        if a is None and b is None:
            continue
        difference = Difference(quantity, a, b, threshold=thresholds.get(quantity.name))
        if a is not None and b is not None and rows[0] is not None and rows[1] is not None:
            delta = significance.cliffs_delta(*(_values(side, quantity) for side in rows if side is not None))
            difference = replace(difference, interval=_interval(a, b), cliffs_delta=delta)
        differences.append(difference)
    return tuple(differences)


def _values(rows: Repeats, quantity: Quantity) -> Numbers:
    """Return the values of the repeats from which the estimate was computed."""
    has_all = np.isfinite([rows.numbers[name] for name in quantity.columns]).all(axis=0)  # same rows as in `cells`
    if quantity.at_least is not None:
        values, _ = rows.observed(quantity)
        return values[np.isfinite(values)]
    return rows.numbers[quantity.name][has_all]


def _interval(a: Estimate, b: Estimate) -> Interval | None:
    """Return the interval of B - A; None if one of the estimates has no interval."""
    if a.low is None or a.high is None or b.low is None or b.high is None:
        return None
    return significance.difference_interval(Interval(a.value, a.low, a.high), Interval(b.value, b.low, b.high))


def _with_holm(pairs: Sequence[Pair]) -> tuple[Pair, ...]:
    """Return pairs with p-values that are corrected for the number of differences of all conditions."""
    intervals = [
        difference.interval for pair in pairs for difference in pair.differences if difference.interval is not None
    ]
    p_holm = iter(significance.holm([significance.p_value(interval) for interval in intervals]))
    return tuple(
        replace(
            pair,
            differences=tuple(
                difference if difference.interval is None else replace(difference, p_holm=next(p_holm))
                for difference in pair.differences
            ),
        )
        for pair in pairs
    )


def _condition_name(by: Sequence[str], key: Key) -> str:
    """Return the name of a condition, such as `los, master, 9.144 m, udp`."""
    units = {"distance_m": " m"}
    return ", ".join(
        f"no {name}" if value in {"", None} else f"{cell_text(value)}{units.get(name, '')}"
        for name, value in zip(by, key, strict=True)
    )
