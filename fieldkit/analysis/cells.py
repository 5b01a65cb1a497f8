"""Cells: the repeats under one condition, put together into estimates with intervals."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis import order
from fieldkit.analysis.quantities import DEFAULT_BY, Quantity
from fieldkit.analysis.repeats import Key, Repeats
from fieldkit.analysis.statistics import Intervals, assured, mean_shares, means, medians, shares, wilsons
from fieldkit.analysis.words import Tally, tallies
from fieldkit.core.columns import Column, Kind
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import ENDED, Status
from fieldkit.core.units import parse_distance

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RepeatValues:
    """The single repeats behind an estimate, each array of shape (n,).

    Attributes:
        low: The value of each; its lower bound where it is censored.
        high: The largest that it can be: infinity where it is censored, and where a figure of what arrived has none
            over all that was sent (see `columns.Figure.of_sent`).
        lost: What was lost, or true; None unless counted or a flag.
        sent: Of how many.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    lost: NDArray[np.float64] | None
    sent: NDArray[np.float64] | None


@dataclass(frozen=True)
class Estimate:
    """One quantity of one cell.

    Attributes:
        quantity: Which.
        n: Valid repeats that have it.
        value: The figure to quote, by the quantity's kind: share of all counted, mean or median.
        low: Lower end of the 95 % interval to quote; the repeat is its unit. None for a single repeat.
        high: Upper end; None for a single repeat, and where censored repeats leave it open.
        assured: Share of such intervals that hold the truth whatever the distribution of the repeats; None unless a
            median of two repeats at least.
        p_order: How often repeats in no order would be as orderly in time as these, `order.p_values` corrected for
            the number of all estimates; None where it was not tested.
        wilson_low: Lower end of the 95 % Wilson interval, all counted taken as independent; None unless counted.
        wilson_high: Upper end.
        events: What was lost, or true; None unless counted or a flag.
        trials: Of how many.
        mean: Mean over repeats.
        median: Median over repeats.
        p95: 95th percentile over repeats.
        minimum: The smallest of a single repeat.
        maximum: The largest.
        n_censored: Of n, the repeats of which only a lower bound is known.
        is_lower_bound: Whether `value` is a lower bound because of them.
        missing: Valid repeats of the cell that do not have it.
        high_of_sent: Upper end of the interval where what was lost counts as later than all that arrived; None if
            it is open. As `high` of figures that are not of what arrived alone.
        sample: The single repeats; None of an estimate that was put together by hand.
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
        """Valid repeats of the cell."""
        return self.n + self.missing


@dataclass(frozen=True)
class Cell:
    """The repeats under one condition.

    Attributes:
        key: Value of each column that tells the condition, in the order asked for; "" or None where missing.
        n_valid: Valid repeats; all estimates are of these.
        n_void: Attempts whose evidence was not whole.
        n_failed: Attempts that failed.
        estimates: By name, of the quantities that any valid repeat has, in their order.
        tallies: By name, of the columns of words that any valid repeat has, in their order.
        payload_bytes: ICMP payload sizes of the valid repeats, ascending, by the name of each quantity that depends
            on them; see `Quantity.payload`.
        lacking: Quantities that the valid repeats were measured for, and of which none has a value: the RTT of pings
            that nothing answered; see `Quantity.implied_by`.
    """

    key: Mapping[str, str | float | None]
    n_valid: int
    n_void: int
    n_failed: int
    estimates: Mapping[str, Estimate]
    tallies: Mapping[str, Tally] = field(default_factory=dict)
    payload_bytes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    lacking: tuple[Quantity, ...] = ()


def aggregate(
    repeats: Repeats,
    by: Sequence[str] = DEFAULT_BY,
    *,
    quantities: Sequence[Quantity] | None = None,
    words: Sequence[Column] | None = None,
) -> tuple[Cell, ...]:
    """Return one cell per condition, sorted by the columns `by` in their order, a distance by its length.

    Args:
        repeats: Attempts at repeats, void and failed ones too.
        by: Columns that tell one condition from another.
        quantities: What to estimate; None for all that the repeats have.
        words: Columns whose words to count; None for all that the repeats have.
    """
    keys, cells = _conditions(repeats, by)
    status = repeats.texts["status"]
    valid, void, failed = (np.bincount(cells[status == one], minlength=len(keys)).tolist() for one in ENDED)
    rows = np.argsort(cells, kind="stable")
    rows = rows[status[rows] == Status.VALID]
    if "started_utc_ns" in repeats.numbers:  # the repeats of a cell in the order of time, unknown moments last
        rows = rows[np.lexsort((repeats.numbers["started_utc_ns"][rows], cells[rows]))]
    estimates: list[dict[str, Estimate]] = [{} for _ in keys]
    for quantity in repeats.quantities if quantities is None else quantities:
        for cell, estimate in _estimates(repeats, quantity, rows, cells):
            estimates[cell][quantity.name] = replace(estimate, missing=valid[cell] - estimate.n)
    _correct(estimates)
    counted: list[dict[str, Tally]] = [{} for _ in keys]
    for column in repeats.worded if words is None else words:
        given = zip(cells[rows].tolist(), repeats.texts[column.name][rows], strict=True)
        for cell, tally in tallies(column, given):
            counted[cell][column.name] = tally
    named = (dict(zip(by, key, strict=True)) for key in keys)
    known = repeats.quantities if quantities is None else quantities
    ends = np.searchsorted(cells[rows], np.arange(1, len(keys)))  # the rows of a cell are side by side
    parts = np.split(rows, ends) if keys else []
    payloads = [_payloads(repeats, known, part) for part in parts]
    lacking = [_lacking(repeats, known, part, own) for part, own in zip(parts, estimates, strict=True)]
    columns_of = zip(named, valid, void, failed, estimates, counted, payloads, lacking, strict=True)
    return tuple(Cell(*fields) for fields in columns_of)


def _payloads(repeats: Repeats, known: Sequence[Quantity], rows: Indices) -> dict[str, tuple[int, ...]]:
    """Return the ICMP payload sizes in `rows` by the name of each quantity that depends on them."""
    payloads: dict[str, tuple[int, ...]] = {}
    for quantity in known:
        if quantity.payload is not None and quantity.payload in repeats.numbers:
            sizes = np.unique(repeats.numbers[quantity.payload][rows])
            payloads[quantity.name] = tuple(sizes[np.isfinite(sizes)].astype(int).tolist())
    return payloads


def _lacking(
    repeats: Repeats, known: Sequence[Quantity], rows: Indices, estimates: Mapping[str, Estimate]
) -> tuple[Quantity, ...]:
    """Return the quantities that were measured for in `rows`, and of which no row has a value."""
    return tuple(
        quantity
        for quantity in known
        if quantity.name not in estimates
        and (implied := repeats.numbers.get(quantity.implied_by or "")) is not None
        and np.isfinite(implied[rows]).any()
    )


def _correct(estimates: Sequence[dict[str, Estimate]]) -> None:
    """Correct every p-value of an order for the number of all."""
    tested = [
        (cell, difference) for cell in estimates for difference in cell.values() if difference.p_order is not None
    ]
    corrected = order.corrected(np.array([difference.p_order for _, difference in tested], dtype=np.float64)).tolist()
    for (cell, one), p_order in zip(tested, corrected, strict=True):
        cell[one.quantity.name] = replace(one, p_order=p_order)


def _conditions(repeats: Repeats, by: Sequence[str]) -> tuple[list[Key], Indices]:
    """Return the keys of all cells, sorted, and which of them each row is of."""
    _, firsts, condition = np.unique(repeats.codes(by), return_index=True, return_inverse=True)
    keys = repeats.where(firsts).keys(by)
    ordered = sorted(range(len(keys)), key=lambda index: [_rank(*part) for part in zip(by, keys[index], strict=True)])
    place = np.zeros(len(keys), np.int64)
    place[ordered] = np.arange(len(keys))
    return [keys[index] for index in ordered], place[condition]


def _rank(name: str, value: str | float | None) -> tuple[bool, float, str]:
    """Return what a value is sorted by: what is missing comes first."""
    if not isinstance(value, str):
        return value is not None, value or 0.0, ""
    if name != "distance":
        return bool(value), 0.0, value
    try:
        return True, parse_distance(value).metres, value
    except ConfigurationError:  # a word of somebody else's for a distance
        return bool(value), 0.0, value


def _estimates(repeats: Repeats, quantity: Quantity, rows: Indices, cells: Indices) -> Iterator[tuple[int, Estimate]]:
    """Yield the cells that have a quantity with their estimates, those with equally many repeats together.

    Args:
        repeats: All repeats.
        quantity: Which.
        rows: The valid ones, those of a cell side by side.
        cells: Cell of each row of `repeats`.
    """
    rows = rows[np.isfinite(repeats.observed(quantity)[0][rows])]
    for name in quantity.columns[1:]:  # a share whose counts are missing says nothing of how many it is of
        rows = rows[np.isfinite(repeats.numbers[name][rows])]
    of = cells[rows]
    starts = np.flatnonzero(np.diff(of, prepend=-1))
    sizes = np.diff(starts, append=len(rows))
    for n in np.unique(sizes):
        alike = starts[sizes == n]
        chosen = rows[alike[:, None] + np.arange(n)]
        yield from zip(of[alike].tolist(), _estimates_of(repeats, quantity, chosen), strict=True)


def _estimates_of(repeats: Repeats, quantity: Quantity, chosen: Indices) -> Iterator[Estimate]:
    """Yield the estimates of cells whose rows are `chosen`, shape (cells, n)."""
    observed, is_bound = repeats.observed(quantity)
    values, censored = observed[chosen], is_bound[chosen]
    upper = np.where(censored, np.inf, values)
    of_sent = _of_sent(repeats, quantity, chosen, upper)
    counts = _counts(repeats, quantity, chosen)
    mean, median, p95 = values.mean(axis=1), np.median(values, axis=1), np.percentile(values, 95, axis=1)
    if counts is not None:
        lost, sent = (count.sum(axis=1) for count in counts)
        pooled = wilsons(lost, sent)
        quoted = shares(*counts) if quantity.kind is Kind.COUNTED else pooled
        counted = [column.astype(np.int64).tolist() for column in (lost, sent)]
    else:
        quoted = _quoted(quantity, values, upper)
        pooled = Intervals(quoted.value, *np.full((2, len(values)), np.nan))
        counted = [[None] * len(values)] * 2
    high_of_sent = quoted.high if of_sent is upper else _quoted(quantity, values, of_sent).high
    n = values.shape[1]
    sure = assured(n) if quantity.kind is Kind.MEDIAN and n > 1 else None
    samples = [
        RepeatValues(
            values[cell], of_sent[cell], *((None, None) if counts is None else (one[cell] for one in counts))
        )
        for cell in range(len(values))
    ]
    for row in zip(
        quoted.value.tolist(),
        *map(_or_none, (quoted.low, quoted.high)),
        [sure] * len(values),
        _or_none(_p_order(repeats, quantity, chosen)),
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


def _of_sent(
    repeats: Repeats, quantity: Quantity, chosen: Indices, upper: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the largest that values can be where what was lost counts as later than all that arrived."""
    if quantity.of_sent is None:
        return upper
    # A table of an earlier version lacks the column: then nothing is known of what was lost.
    known = repeats.numbers.get(quantity.of_sent)
    given = np.full_like(upper, np.nan) if known is None else known[chosen]
    return np.where(np.isnan(given), np.inf, np.maximum(given, upper))


def _quoted(quantity: Quantity, values: NDArray[np.float64], upper: NDArray[np.float64]) -> Intervals:
    """Return the mean or median over repeats of what is not counted."""
    least, most = quantity.possible
    if quantity.kind is Kind.MEDIAN:
        return medians(values, least, most, upper=upper)
    if quantity.unit == "share":
        return mean_shares(values)
    found = means(values)
    return Intervals(found.value, np.maximum(found.low, least), np.minimum(found.high, most))


def _p_order(repeats: Repeats, quantity: Quantity, chosen: Indices) -> NDArray[np.float64]:
    """Return the p-values of the order of cells; NaN where the moment of some repeat is not known, or for flags."""
    if quantity.kind is Kind.FLAG or "started_utc_ns" not in repeats.numbers:
        return np.full(len(chosen), np.nan)
    found = order.p_values(repeats.observed(quantity)[0][chosen])
    return np.where(np.isnan(repeats.numbers["started_utc_ns"][chosen]).any(axis=1), np.nan, found)


def _counts(repeats: Repeats, quantity: Quantity, chosen: Indices) -> tuple[NDArray[np.float64], ...] | None:
    """Return what was lost, or true, of how many, per repeat; None unless that is counted.

    More may arrive than was sent: offload shows the paper's filter other frames at either end.
    """
    if quantity.kind is Kind.FLAG:
        flags = repeats.numbers[quantity.name][chosen]
        return flags, np.ones_like(flags)
    if quantity.arrived is None or quantity.sent is None:
        return None
    sent = repeats.numbers[quantity.sent][chosen]
    return sent - repeats.numbers[quantity.arrived][chosen], sent


def _or_none(bound: NDArray[np.float64]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in bound.tolist()]
