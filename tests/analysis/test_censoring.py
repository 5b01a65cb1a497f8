"""Right-censored repeats in medians, intervals, tables and judgements."""

import json
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis import expectations, judgements, paper_tables, result_tables, wording
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.judgement_words import judgement_texts
from fieldkit.analysis.judgements import Judgement, Ruling
from fieldkit.analysis.quantities import Quantity, quantities
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.statistics import medians
from fieldkit.core.columns import Column, Figure, Kind, columns, with_step_name
from fieldkit.core.model import FINAL_STATUSES
from fieldkit.measure.evidence import ping, ping_gaps

BY = ("protocol",)
GAP = (*ping_gaps.GAP_COLUMNS, *ping_gaps.OPEN_GAP_COLUMNS)
RTT = tuple(column for column in (*ping.COLUMNS, *ping.SENT_COLUMNS) if "median" in column.name)
NAN = math.nan

OptionalValue = float | None
"""A value, or None if it is missing."""


def repeats_of(declared: Sequence[Column], **values: Sequence[OptionalValue]) -> Repeats:
    """Return valid UDP repeats with these values by column."""
    n = len(next(iter(values.values())))
    numbers = {column.name: np.full(n, NAN) for column in declared}
    numbers |= {name: np.array(repeat_values, dtype=np.float64) for name, repeat_values in values.items()}
    texts = {"protocol": np.full(n, "udp", np.object_), "status": np.full(n, FINAL_STATUSES[0], np.object_)}
    return Repeats(numbers, texts, tuple(declared))


def gaps(closed: Sequence[float], still_open: Sequence[float] = (), missing: int = 0) -> Cell:
    """Return the cell of repeats whose longest gap has ended, is still open, or is missing."""
    missing_values = [None] * missing
    (cell,) = aggregate(
        repeats_of(
            GAP,
            rtt_gap_s=[*closed, *(None for _ in still_open), *missing_values],
            rtt_gap_at_least_s=[*(None for _ in closed), *still_open, *missing_values],
        ),
        BY,
    )
    return cell


def judge_text(text: str, cell: Cell, declared: Sequence[Column] = GAP) -> Judgement:
    (result,) = judgements.judge([expectations.parse(text, quantities(declared))], [cell])
    return result


def test_open_gaps_count_with_their_observed_length() -> None:
    estimate = gaps([0.2] * 7, [2.3, 2.5, 2.8]).estimates["rtt_gap_s"]
    assert (estimate.n, estimate.n_censored, estimate.missing) == (10, 3, 0)
    # The three censored values are above the seven others, so the median is known, but not the upper bound.
    assert (estimate.value, estimate.is_lower_bound) == (0.2, False)
    assert (estimate.low, estimate.high) == (0.2, None)
    assert estimate.maximum == 2.8


def test_a_median_of_open_gaps_is_a_lower_bound() -> None:
    estimate = gaps([0.2] * 4, [2.0, 2.5, 2.8, 2.9, 3.0, 3.1]).estimates["rtt_gap_s"]
    assert (estimate.value, estimate.is_lower_bound) == (2.25, True)
    scale = wording.scale_of(estimate.quantity, [estimate.value])
    text = wording.with_interval(wording.amount(scale, estimate), scale, estimate)
    assert text == ">= 2250 ms [200, ...) (6 of 10 not ended)"


@given(
    st.lists(st.tuples(st.floats(0, 10), st.floats(0, 10), st.booleans()), min_size=2, max_size=25),
)
def test_an_interval_contains_the_interval_of_the_uncensored_values(repeats: list[tuple[float, float, bool]]) -> None:
    """The oracle is the interval of the true values; open values are observed only in part."""
    true = np.array([[observed + remaining for observed, remaining, _ in repeats]])
    is_open = np.array([[is_open for _, _, is_open in repeats]])
    observed = np.where(is_open, [[observed for observed, _, _ in repeats]], true)
    result = medians(observed, 0, upper=np.where(is_open, np.inf, true))
    oracle = medians(true, 0)
    assert result.value <= oracle.value
    if len(repeats) >= 6:
        assert result.low <= oracle.low
    assert result.high >= oracle.high if len(repeats) >= 6 else result.high >= true[~is_open].max(initial=0)
    if not is_open.any():
        assert (result.value, result.low, result.high) == (oracle.value, oracle.low, oracle.high)


def test_censored_repeats_do_not_make_an_expectation_hold() -> None:
    """The case of issue 21: in 3 of 10 repeats the link was down when the ping ended."""
    result = judge_text("rtt_gap_s < 2 s", gaps([0.2] * 7, [2.3, 2.5, 2.8]))
    assert result.ruling is Ruling.OPEN
    assert result.why == "in 3 of 10 repeats the timed event had not ended, so only a lower bound is known"
    assert judge_text("every rtt_gap_s < 2 s", gaps([0.2] * 7, [2.3, 2.5, 2.8])).ruling is Ruling.FAILS
    assert judge_text("max rtt_gap_s < 2 s", gaps([0.2] * 7, [1.3])).ruling is Ruling.OPEN
    assert judge_text("rtt_gap_s < 2 s", gaps([], [5.0] * 4)).ruling is Ruling.FAILS


def test_missing_repeats_are_counted_in_all_outputs() -> None:
    cell = gaps([0.2] * 8, missing=2)
    result = judge_text("rtt_gap_s < 2 s", cell)
    assert (result.ruling, result.why) == (Ruling.OPEN, "no value in 2 of 10 repeats")
    assert judgement_texts(result)[2] == "200 ms (8 of 10)"
    quantities = [Quantity.of(column) for column in GAP]
    markdown = paper_tables.to_markdown(BY, [cell], [quantity for quantity in quantities if quantity])
    assert "(8 of 10)" in markdown
    assert "(8 of 10)" in paper_tables.to_latex(BY, [cell], [quantity for quantity in quantities if quantity])
    (json_cell,) = json.loads(result_tables.to_json(BY, [cell]))["cells"]
    assert (json_cell["n_valid"], json_cell["estimates"]["rtt_gap_s"]["n"]) == (10, 8)


def test_open_gaps_are_in_every_table_format() -> None:
    cell = gaps([0.2] * 2, [1.5] * 5)
    (json_cell,) = json.loads(result_tables.to_json(BY, [cell]))["cells"]
    estimate = json_cell["estimates"]["rtt_gap_s"]
    assert (estimate["n_censored"], estimate["is_lower_bound"], estimate["high"]) == (5, True, None)
    quantities = [quantity for column in GAP if (quantity := Quantity.of(column))]
    assert "| >= 1500 [200, ...) (5 of 7 not ended) |" in paper_tables.to_markdown(BY, [cell], quantities)
    assert r"$\geq$ 1500 [200, ...) (5 of 7 not ended)" in paper_tables.to_latex(BY, [cell], quantities)
    head, row, *_ = result_tables.to_csv(BY, [cell]).splitlines()
    by_name = dict(zip(head.split(","), row.split(","), strict=True))
    assert (by_name["high"], by_name["n_censored"], by_name["is_lower_bound"]) == ("", "5", "true")


DELAYS = st.sampled_from([0.01, 0.1, 0.2, 0.9])
TEXTS = [
    f"{form}rtt_gap_s {sign} 500 ms"
    for form in ("", "every ", "50 % of ", "99 % of ")
    for sign in ("<", "<=", ">", ">=")
]


@given(st.lists(DELAYS, max_size=12), st.lists(DELAYS, max_size=4), st.integers(0, 4), st.sampled_from(TEXTS))
def test_no_expectation_holds_on_missing_or_open_repeats(
    closed: list[float], still_open: list[float], missing: int, text: str
) -> None:
    if not (closed or still_open or missing):
        return
    result = judge_text(text, gaps(closed, still_open, missing))
    if still_open or missing:
        assert not result.holds
        assert "of" in result.why


def rtt(medians_s: Sequence[OptionalValue], sent_medians_s: Sequence[OptionalValue]) -> Cell:
    (cell,) = aggregate(repeats_of(RTT, rtt_median_s=medians_s, rtt_median_sent_s=sent_medians_s), BY)
    return cell


@pytest.mark.parametrize(
    ("sent_medians_s", "ruling", "reason"),
    [
        ([0.1] * 10, Ruling.HOLDS, ""),
        ([0.15] * 10, Ruling.HOLDS, ""),
        ([0.3] * 10, Ruling.OPEN, "if the delay of lost items is infinite, the interval extends beyond the bound"),
        (
            [None] + [0.1] * 9,
            Ruling.OPEN,
            "in 1 of 10 repeats the figure is infinite because of lost items",
        ),
        (
            [None] * 10,
            Ruling.OPEN,
            "in 10 of 10 repeats the figure is infinite because of lost items",
        ),
    ],
)
def test_a_median_rtt_of_the_answers_is_judged_over_all_requests(
    sent_medians_s: list[OptionalValue], ruling: Ruling, reason: str
) -> None:
    cell = rtt([0.1] * 10, sent_medians_s)
    result = judge_text("rtt_median_s < 200 ms", cell, RTT)
    assert (result.ruling, result.why) == (ruling, reason)
    assert result.estimate is not None
    assert (result.estimate.value, result.estimate.high) == (0.1, 0.1), "the displayed figure does not change"
    assert judge_text("rtt_median_s < 50 ms", cell, RTT).ruling is Ruling.FAILS
    every = judge_text("every rtt_median_s < 200 ms", cell, RTT)
    assert every.holds is (ruling is Ruling.HOLDS)


def test_repeats_without_any_answer_are_missing() -> None:
    result = judge_text("rtt_median_s < 200 ms", rtt([0.1] * 6 + [None] * 4, [0.1] * 6 + [None] * 4), RTT)
    assert (result.ruling, result.why) == (Ruling.OPEN, "no value in 4 of 10 repeats")


def test_a_table_without_the_median_of_all_requests_gives_no_decision() -> None:
    repeats = repeats_of(RTT, rtt_median_s=[0.1] * 10)
    (cell,) = aggregate(
        Repeats({"rtt_median_s": repeats.numbers["rtt_median_s"]}, repeats.texts, repeats.columns), BY
    )
    assert judge_text("rtt_median_s < 200 ms", cell, RTT).ruling is Ruling.OPEN


def test_steps_with_names_have_separate_optional_columns() -> None:
    (gap, *_) = (with_step_name("up", column) for column in GAP)
    assert gap.figure is not None
    assert gap.figure.at_least == "up.rtt_gap_at_least_s"


def test_means_cannot_have_lower_bounds() -> None:
    (column,) = columns(100, ("stalls", "count", "Stalls.", Figure("stalls", Kind.MEAN, at_least="other")))
    error = "only a median can have a column of lower bounds (at_least) or of all sent items (of_sent)"
    assert column.declaration_error() == error
