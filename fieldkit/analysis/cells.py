"""Cells: repeats under the same condition, aggregated into estimates with intervals."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.quantities import DEFAULT_BY, Quantity, Tally, tallies
from fieldkit.analysis.repeats import Key, Repeats
from fieldkit.analysis.statistics import (
    MIN_FOR_INDEPENDENCE_TESTS,
    Intervals,
    guaranteed_coverage,
    mean_shares,
    means,
    medians,
    shares,
    wilson_intervals,
)
from fieldkit.core.columns import Column, Kind
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FINAL_STATUSES, Status
from fieldkit.core.units import parse_distance

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RepeatValues:
    """The values of the repeats of an estimate; all arrays have shape (n,).

    Attributes:
        low: Value of each repeat; the lower bound of the value if it is censored.
        high: Upper bound of the value of each repeat; infinity if the value is censored. For a quantity with
            `columns.Figure.of_sent`, it is the statistic over all sent items; infinity if that is infinite or
            unknown.
        lost: Number of lost items; for a flag, 1 if it is true, else 0. None unless the quantity is counted or a
            flag.
        sent: Number of sent items; for a flag, 1. None unless the quantity is counted or a flag.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    lost: NDArray[np.float64] | None
    sent: NDArray[np.float64] | None


@dataclass(frozen=True)
class Estimate:
    """Estimate of one quantity in one cell.

    Attributes:
        quantity: The quantity.
        n: Number of valid repeats that have a value.
        value: The point estimate, which depends on the quantity's kind: share of all counted items, share of the
            repeats in which a flag is true, mean or median.
        low: Lower end of the 95 % interval, with repeats as sampling units. None without an interval: for a single
            repeat, unless the quantity is a flag, and for a share of counted items that is outside of 0 to 1.
        high: Upper end of the interval; None without an interval, and if it is open because of censored repeats.
        assured: Coverage of the interval for any distribution of the repeats; None unless the estimate is a median of
            at least two repeats.
        p_order: p-value of the hypothesis that the repeats are independent in time (`independence.p_values`),
            corrected for the number of all estimates; None if it was not tested.
        wilson_low: Lower end of the 95 % Wilson interval, which assumes that all counted items, or repeats of a flag,
            are independent; None unless the quantity is counted or a flag, and if the share is outside of 0 to 1.
        wilson_high: Upper end of the Wilson interval; None as `wilson_low`.
        events: Number of lost items, or of repeats in which a flag is true; None unless the quantity is counted or a
            flag.
        trials: Number of sent items, or of repeats of a flag; None for other quantities.
        mean: Mean over repeats.
        median: Median over repeats.
        p95: 95th percentile over repeats.
        minimum: Smallest value of a repeat.
        maximum: Largest value of a repeat.
        n_censored: Number of repeats among `n` with a right-censored value.
        is_lower_bound: True if `value` is a lower bound because of censored values.
        missing: Number of valid repeats of the cell without a value.
        high_of_sent: Upper end of the interval if each lost item counts as an infinite value; None if this end is
            open. It equals `high`, except for quantities that are computed only from received items.
        sample: Values of the repeats; None for an estimate that was not computed from repeats.
    """

    quantity: Quantity
    n: int
    value: float
    low: float | None
    high: float | None
    assured: float | None
    p_order: float | None
    wilson_low: float | None
    wilson_high: float | None
    events: int | None
    trials: int | None
    mean: float
    median: float
    p95: float
    minimum: float
    maximum: float
    n_censored: int = 0
    is_lower_bound: bool = False
    missing: int = 0
    high_of_sent: float | None = None
    sample: RepeatValues | None = field(default=None, compare=False, repr=False)

    @property
    def n_valid(self) -> int:
        """Number of valid repeats of the cell."""
        return self.n + self.missing


@dataclass(frozen=True)
class Cell:
    """The repeats under the same condition.

    Attributes:
        key: Value of each column that identifies the condition, in the requested order; "" or None if missing.
        n_valid: Number of valid repeats, from which all estimates are computed.
        n_void: Number of void attempts; see `Status`.
        n_failed: Number of failed attempts; see `Status`.
        estimates: Estimates by name of the quantity, in the order of `Repeats.quantities` or as requested.
            Quantities without a valid repeat are omitted.
        tallies: Counts of text values by name of the column, in the order of `Repeats.word_columns` or as requested.
            Columns without a valid repeat are omitted.
        payload_bytes: ICMP payload sizes of the valid repeats, ascending, by the name of each quantity that depends
            on them; see `Quantity.payload`.
        quantities_without_value: Quantities that were measured in the valid repeats, but have no value in any of
            them, for example the RTT of pings without an answer; see `Quantity.implied_by`.
    """

    key: Mapping[str, str | float | None]
    n_valid: int
    n_void: int
    n_failed: int
    estimates: Mapping[str, Estimate]
    tallies: Mapping[str, Tally] = field(default_factory=dict)
    payload_bytes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    quantities_without_value: tuple[Quantity, ...] = ()


def aggregate(
    repeats: Repeats,
    by: Sequence[str] = DEFAULT_BY,
    *,
    quantities: Sequence[Quantity] | None = None,
    words: Sequence[Column] | None = None,
) -> tuple[Cell, ...]:
    """Return one cell per condition, sorted by the columns `by`; distances are sorted by length.

    Args:
        repeats: Attempts of repeats, including void and failed attempts.
        by: Columns that identify a condition.
        quantities: Quantities to estimate; None for all that the repeats have.
        words: Text columns whose values are counted; None for all that the repeats have.
    """
    keys, cells = _conditions(repeats, by)
    status = repeats.texts["status"]
    valid, void, failed = (
        np.bincount(cells[status == final_status], minlength=len(keys)).tolist() for final_status in FINAL_STATUSES
    )
    rows = np.argsort(cells, kind="stable")
    rows = rows[status[rows] == Status.VALID]
    if "started_utc_ns" in repeats.numbers:  # sort the repeats of a cell by time, unknown times last
        rows = rows[np.lexsort((repeats.numbers["started_utc_ns"][rows], cells[rows]))]
    estimates: list[dict[str, Estimate]] = [{} for _ in keys]
    for quantity in repeats.quantities if quantities is None else quantities:
        for cell, estimate in _estimates(repeats, quantity, rows, cells):
            estimates[cell][quantity.name] = replace(estimate, missing=valid[cell] - estimate.n)
    _correct_p_values(estimates)
    tallies_by_cell: list[dict[str, Tally]] = [{} for _ in keys]
    for column in repeats.word_columns if words is None else words:
        words_with_cell = zip(cells[rows].tolist(), repeats.texts[column.name][rows], strict=True)
        for cell, tally in tallies(column, words_with_cell):
            tallies_by_cell[cell][column.name] = tally
    named_keys = (dict(zip(by, key, strict=True)) for key in keys)
    selected = repeats.quantities if quantities is None else quantities
    ends = np.searchsorted(cells[rows], np.arange(1, len(keys)))  # rows of a cell are adjacent
    rows_by_cell = np.split(rows, ends) if keys else []
    payloads = [_payload_sizes(repeats, selected, cell_rows) for cell_rows in rows_by_cell]
    without_value = [
        _quantities_without_value(repeats, selected, cell_rows, cell_estimates)
        for cell_rows, cell_estimates in zip(rows_by_cell, estimates, strict=True)
    ]
    cell_fields = zip(
        named_keys, valid, void, failed, estimates, tallies_by_cell, payloads, without_value, strict=True
    )
    return tuple(Cell(*fields) for fields in cell_fields)


def _payload_sizes(repeats: Repeats, quantities: Sequence[Quantity], rows: Indices) -> dict[str, tuple[int, ...]]:
    """Return the ICMP payload sizes in `rows` by the name of each quantity that depends on them."""
    payloads: dict[str, tuple[int, ...]] = {}
    for quantity in quantities:
        if quantity.payload is not None and quantity.payload in repeats.numbers:
            sizes = np.unique(repeats.numbers[quantity.payload][rows])
            payloads[quantity.name] = tuple(sizes[np.isfinite(sizes)].astype(int).tolist())
    return payloads


def _quantities_without_value(
    repeats: Repeats, quantities: Sequence[Quantity], rows: Indices, estimates: Mapping[str, Estimate]
) -> tuple[Quantity, ...]:
    """Return the quantities that were measured in `rows`, but have no value in any of them."""
    return tuple(
        quantity
        for quantity in quantities
        if quantity.name not in estimates
        and (implied := repeats.numbers.get(quantity.implied_by or "")) is not None
        and np.isfinite(implied[rows]).any()
    )


def _correct_p_values(estimates: Sequence[dict[str, Estimate]]) -> None:
    """Correct the p-values `p_order` for the number of all estimates."""
    tested = [(cell, estimate) for cell in estimates for estimate in cell.values() if estimate.p_order is not None]
    if not tested:
        return
    from fieldkit.analysis import independence  # noqa: PLC0415 (needed only for cells of 10 repeats or more)

    corrected = independence.corrected(
        np.array([estimate.p_order for _, estimate in tested], dtype=np.float64)
    ).tolist()
    for (cell, estimate), p_order in zip(tested, corrected, strict=True):
        cell[estimate.quantity.name] = replace(estimate, p_order=p_order)


def _conditions(repeats: Repeats, by: Sequence[str]) -> tuple[list[Key], Indices]:
    """Return the sorted keys of all cells, and the index of the cell of each row."""
    _, first_rows, condition_of_row = np.unique(repeats.codes(by), return_index=True, return_inverse=True)
    keys = repeats.where(first_rows).keys(by)
    ordered = sorted(
        range(len(keys)), key=lambda index: [_sort_key(*part) for part in zip(by, keys[index], strict=True)]
    )
    position = np.zeros(len(keys), np.int64)
    position[ordered] = np.arange(len(keys))
    return [keys[index] for index in ordered], position[condition_of_row]


def _sort_key(name: str, value: str | float | None) -> tuple[bool, float, str]:
    """Return the sort key of a value; missing values come first."""
    if not isinstance(value, str):
        return value is not None, value or 0.0, ""
    if name != "distance":
        return bool(value), 0.0, value
    try:
        return True, parse_distance(value).metres, value
    except ConfigurationError:  # an edited table can contain any text as a distance
        return bool(value), 0.0, value


def _estimates(repeats: Repeats, quantity: Quantity, rows: Indices, cells: Indices) -> Iterator[tuple[int, Estimate]]:
    """Yield the index and the estimate of each cell that has a quantity.

    Cells with the same number of repeats are computed together.

    Args:
        repeats: All repeats.
        quantity: The quantity.
        rows: Indices of the valid repeats; the repeats of a cell are adjacent.
        cells: Cell of each row of `repeats`.
    """
    rows = rows[np.isfinite(repeats.observed(quantity)[0][rows])]
    for name in quantity.columns[1:]:  # omit repeats without both counts: a share alone cannot be added to others
        rows = rows[np.isfinite(repeats.numbers[name][rows])]
    cell_of_row = cells[rows]
    starts = np.flatnonzero(np.diff(cell_of_row, prepend=-1))
    sizes = np.diff(starts, append=len(rows))
    for n in np.unique(sizes):
        same_size = starts[sizes == n]
        cell_rows = rows[same_size[:, None] + np.arange(n)]
        estimates = _same_size_estimates(repeats, quantity, cell_rows)
        yield from zip(cell_of_row[same_size].tolist(), estimates, strict=True)


def _same_size_estimates(repeats: Repeats, quantity: Quantity, cell_rows: Indices) -> Iterator[Estimate]:
    """Yield the estimates of cells with the same number of repeats, whose rows are `cell_rows`, shape (cells, n)."""
    observed, is_bound = repeats.observed(quantity)
    values, censored = observed[cell_rows], is_bound[cell_rows]
    upper = np.where(censored, np.inf, values)
    upper_of_sent = _upper_of_sent(repeats, quantity, cell_rows, upper)
    counts = _counts(repeats, quantity, cell_rows)
    mean, median, p95 = values.mean(axis=1), np.median(values, axis=1), np.percentile(values, 95, axis=1)
    if counts is not None:
        lost, sent = (count.sum(axis=1) for count in counts)
        pooled = wilson_intervals(lost, sent)
        point_estimates = shares(*counts) if quantity.kind is Kind.COUNTED else pooled
        counted = [column.astype(np.int64).tolist() for column in (lost, sent)]
    else:
        point_estimates = _mean_or_median(quantity, values, upper)
        pooled = Intervals(point_estimates.value, *np.full((2, len(values)), np.nan))
        counted = [[None] * len(values)] * 2
    high_of_sent = (
        point_estimates.high if upper_of_sent is upper else _mean_or_median(quantity, values, upper_of_sent).high
    )
    n = values.shape[1]
    coverage = guaranteed_coverage(n) if quantity.kind is Kind.MEDIAN and n > 1 else None
    samples = [
        RepeatValues(
            values[cell],
            upper_of_sent[cell],
            *((None, None) if counts is None else (count[cell] for count in counts)),
        )
        for cell in range(len(values))
    ]
    # One row per cell, with the attributes of `Estimate` from `value` on, in their order.
    for row in zip(
        point_estimates.value.tolist(),
        *map(_or_none, (point_estimates.low, point_estimates.high)),
        [coverage] * len(values),
        _or_none(_p_order(repeats, quantity, cell_rows)),
        *map(_or_none, (pooled.low, pooled.high)),
        *counted,
        *(column.tolist() for column in (mean, median, p95, values.min(axis=1), values.max(axis=1))),
        censored.sum(axis=1).tolist(),
        (np.median(upper, axis=1) > median).tolist(),
        [0] * len(values),
        _or_none(high_of_sent),
        samples,
        strict=True,
    ):
        yield Estimate(quantity, n, *row)


def _upper_of_sent(
    repeats: Repeats, quantity: Quantity, cell_rows: Indices, upper: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return upper bounds of the values if each lost item counts as infinite; infinity if this statistic is unknown.

    For a quantity without `of_sent`, return `upper`.
    """
    if quantity.of_sent is None:
        return upper
    column = repeats.numbers.get(quantity.of_sent)  # tables of earlier versions do not have the column
    of_sent = np.full_like(upper, np.nan) if column is None else column[cell_rows]
    return np.where(np.isnan(of_sent), np.inf, np.maximum(of_sent, upper))


def _mean_or_median(quantity: Quantity, values: NDArray[np.float64], upper: NDArray[np.float64]) -> Intervals:
    """Return the mean or median over repeats of a quantity that is not counted."""
    least, most = quantity.possible_range
    if quantity.kind is Kind.MEDIAN:
        return medians(values, least, most, upper=upper)
    if quantity.unit == "share":
        return mean_shares(values)
    mean = means(values)
    return Intervals(mean.value, np.maximum(mean.low, least), np.minimum(mean.high, most))


def _p_order(repeats: Repeats, quantity: Quantity, cell_rows: Indices) -> NDArray[np.float64]:
    """Return the p-value of each cell for independence in time.

    It is NaN for flags, for fewer than `MIN_FOR_INDEPENDENCE_TESTS` repeats, and if a start time is unknown.
    """
    if quantity.kind is Kind.FLAG or "started_utc_ns" not in repeats.numbers:
        return np.full(len(cell_rows), np.nan)
    if cell_rows.shape[1] < MIN_FOR_INDEPENDENCE_TESTS:
        return np.full(len(cell_rows), np.nan)
    from fieldkit.analysis import independence  # noqa: PLC0415 (needed only for cells of 10 repeats or more)

    p_values = independence.p_values(repeats.observed(quantity)[0][cell_rows])
    return np.where(np.isnan(repeats.numbers["started_utc_ns"][cell_rows]).any(axis=1), np.nan, p_values)


def _counts(repeats: Repeats, quantity: Quantity, cell_rows: Indices) -> tuple[NDArray[np.float64], ...] | None:
    """Return the numbers of lost and of sent items of each repeat; None for a quantity that is not counted.

    For a flag, the first number is its value (0 or 1), and the second is 1. A number of lost items can be negative:
    `paper_received` can be larger than `paper_packets`, because the two captures contain different frames with the
    same data if a network card splits or merges frames (segmentation offload).
    """
    if quantity.kind is Kind.FLAG:
        flags = repeats.numbers[quantity.name][cell_rows]
        return flags, np.ones_like(flags)
    if quantity.arrived is None or quantity.sent is None:
        return None
    sent = repeats.numbers[quantity.sent][cell_rows]
    return sent - repeats.numbers[quantity.arrived][cell_rows], sent


def _or_none(bound: NDArray[np.float64]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in bound.tolist()]
