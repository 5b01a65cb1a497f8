"""Rows of summaries and comparisons, whose fields declare their columns."""

from dataclasses import dataclass, field, fields
from typing import Any

from fieldkit.core.columns import Column


def _column(unit: str, meaning: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    """Return the data class field of a column. Its default, None, is an empty cell."""
    return field(default=None, metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True, kw_only=True)
class EstimateRow:
    """Row of summary.csv: one quantity under one condition, after the columns that identify the condition.

    Computed by `analysis.cells`.
    """

    quantity: str | None = _column(
        "text", "Column of trial.csv that was summarized; for a text column one row per word: `grass=wet`."
    )
    unit: str | None = _column("text", "Unit of the estimates and intervals, for example s, bit/s or share.")
    n_valid: int | None = _column("count", "Valid repeats.")
    n_void: int | None = _column(
        "count", "Void attempts: not valid, for example because a step failed or evidence is incomplete."
    )
    n_failed: int | None = _column("count", "Failed attempts: not valid, and not followed by another attempt.")
    n: int | None = _column(
        "count", "Valid repeats that have a value of the quantity; all numbers are computed from these."
    )
    value: float | None = _column(
        "unit",
        "Point estimate: share of all counted items, of the repeats in which a flag is true, or of the repeats with "
        "the word; mean or median over repeats.",
    )
    low: float | None = _column(
        "unit",
        "Lower end of the 95 % interval, with repeats as sampling units; empty for a single repeat, unless the "
        "quantity is a flag, and for words.",
    )
    high: float | None = _column(
        "unit", "Upper end of the 95 % interval; also empty if censored repeats leave it open."
    )
    assured: float | None = _column(
        "share",
        "Coverage of the interval for any distribution of the repeats. Below 0.95, its 95 % coverage assumes a "
        "normal distribution. Medians only.",
    )
    p_order: float | None = _column(
        "share",
        "p-value of a test for a trend or autocorrelation of the repeats in time, corrected for the number of all "
        "tested rows. Below 0.05 the repeats are not independent and the interval is too narrow. Empty below 10 "
        "repeats or 5 distinct values, for flags and words, and without start times.",
    )
    estimate: str | None = _column(
        "text",
        "How `value` was estimated: `counted`, `mean`, `median`, `flag` (share of the repeats in which it is true), "
        "or `words` (share of the repeats with the word, without an interval).",
    )
    wilson_low: float | None = _column(
        "unit",
        "Lower end of the 95 % Wilson interval, which assumes that all counted items are independent. Only for "
        "counted quantities and flags (whose items are repeats); empty if more items arrived than were sent. This is "
        "possible in the `paper_*` columns if a network card splits or merges frames (offload).",
    )
    wilson_high: float | None = _column("unit", "Upper end of the 95 % Wilson interval.")
    events: int | None = _column(
        "count",
        "Number of lost items, or of repeats in which the flag is true or the word occurs; empty for means and "
        "medians.",
    )
    trials: int | None = _column(
        "count", "Number of items or repeats among which `events` are counted; empty for means and medians."
    )
    mean: float | None = _column("unit", "Mean over repeats.")
    median: float | None = _column("unit", "Median over repeats.")
    p95: float | None = _column("unit", "95th percentile over repeats.")
    minimum: float | None = _column("unit", "Smallest value of a repeat.")
    maximum: float | None = _column("unit", "Largest value of a repeat.")
    n_censored: int | None = _column(
        "count",
        "Repeats among n with a right-censored value: a lower bound, because the timed event had not ended. If above "
        "0, mean, p95 and maximum are lower bounds, and `high` is empty if the data give no upper end.",
    )
    is_lower_bound: bool | None = _column("bool", "Whether `value` and `median` are lower bounds as well.")


@dataclass(frozen=True, kw_only=True)
class DifferenceRow:
    """Row of a comparison of two runs: one quantity under one condition, after the columns that identify it.

    Computed by `analysis.compare`.
    """

    missing_in: str | None = _column("text", "A or B if that run has no such condition; empty if both have it.")
    quantity: str | None = _column(
        "text", "Column of trial.csv that was compared; for a text column one row per word: `grass=wet`."
    )
    unit: str | None = _column("text", "Unit of the estimates and intervals, for example s, bit/s or share.")
    estimate: str | None = _column(
        "text", "How a and b were estimated: `counted`, `mean`, `median`, `flag` or `words`, as in summary.csv."
    )
    n_a: int | None = _column("count", "Valid repeats of A that have a value of the quantity.")
    n_b: int | None = _column("count", "Valid repeats of B that have a value of the quantity.")
    a: float | None = _column("unit", "Estimate of A, as `value` of summary.csv; empty if A did not measure it.")
    b: float | None = _column("unit", "Estimate of B.")
    difference: float | None = _column("unit", "b - a.")
    low: float | None = _column("unit", "Lower end of the 95 % interval of the difference; empty if a or b has none.")
    high: float | None = _column("unit", "Upper end of the 95 % interval of the difference.")
    cliffs_delta: float | None = _column(
        "share", "Share of pairs of repeats in which B is larger, minus the share in which it is smaller: -1 to 1."
    )
    p_holm: float | None = _column(
        "share", "p-value of the difference, corrected by Holm's method for the number of all comparisons."
    )
    threshold: float | None = _column(
        "unit", "Largest acceptable difference between a and b; empty if none was given."
    )
    within: bool | None = _column("bool", "Whether the whole interval is within the threshold.")
    verdict: str | None = _column("text", "Result in words.")


def declared_columns(row: type[Any]) -> tuple[Column, ...]:
    """Return the columns that a data class declares by its fields."""
    return tuple(Column(item.name, item.metadata["unit"], item.metadata["meaning"]) for item in fields(row))
