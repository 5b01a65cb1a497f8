"""The rule of `fieldkit middleware recommend`, applied to repeats with known results."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from fieldkit.analysis.quantities import parse_amount
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.ros.recommendation import candidates, link_cells
from fieldkit.ros.recommendation.candidates import Assessment, Candidate
from fieldkit.ros.recommendation.link_cells import LinkCell, LinkCriterion

DDS = Candidate("dds", "", "{}", "reliable keep_last 10")
PLACE, SIZE = "masterless, 5m", 1000.0
ONE_PERCENT = LinkCriterion(0.01)
UNKNOWN = float("nan")


def cell(
    lost: Sequence[float],
    *,
    sent: float = 100,
    never_sent: float = 0,
    delay_s: Sequence[float] = (),
    delay_sent_s: Sequence[float] | None = None,
    status: Sequence[str] = (),
    size_bytes: float = SIZE,
) -> LinkCell:
    """Return repeats that lost the given numbers of samples, by default of 100."""
    n = len(lost)
    delay = np.array([*delay_s] or [0.01] * n)
    numbers = {
        "topic_sent": np.full(n, sent),
        "topic_refused": np.full(n, never_sent),
        "topic_skipped": np.zeros(n),
        "topic_received": sent - np.array(lost, dtype=np.float64),
        "topic_delay_p95_s": delay,
        "topic_delay_p95_sent_s": delay if delay_sent_s is None else np.array(delay_sent_s),
    }
    texts = {
        "status": np.array([*status] or ["valid"] * n, dtype=np.object_),
        SOURCE: np.array(["trials/a"] * n, dtype=np.object_),
    }
    halves = [Repeats(numbers, texts, ()).where(np.array(part)) for part in (range(n // 2), range(n // 2, n))]
    return link_cells.link_cell(PLACE, size_bytes, halves)


def judge(*cells: LinkCell, criterion: LinkCriterion = ONE_PERCENT) -> Assessment:
    return candidates.assess_candidate(DDS, cells, {(cell.place, cell.size_bytes) for cell in cells}, criterion)


def test_a_repeat_at_the_bound_passes_and_one_above_fails() -> None:
    assert judge(cell([0, 1, 1, 0, 1])).passed
    assessment = judge(cell([0, 1, 2, 0, 1]))
    assert not assessment.passed
    assert assessment.failures == (f"{PLACE}, 1000 B: loss <= 0.01 in 4 of 5 repeats, up to 0.02",)


def test_a_bound_is_compared_as_a_decimal() -> None:
    # In binary floating point, 2.9 times 0.01 is less than 29/1000.
    bound = parse_amount("2.9%", "share", "bound")
    assert judge(cell(5 * [29], sent=1000), criterion=LinkCriterion(bound)).passed
    assert judge(cell(5 * [30], sent=1000), criterion=LinkCriterion(bound)).failures


def test_one_bad_repeat_fails_although_the_mean_is_low() -> None:
    # The loss is bimodal: 1 of 200 repeats loses all samples, so the mean loss is 0.5 %.
    assert judge(cell([100] + 199 * [0])).failures


def test_samples_that_were_never_sent_count_as_lost() -> None:
    assert judge(cell(5 * [0], sent=99, never_sent=1)).passed
    assert judge(cell(5 * [0], sent=98, never_sent=2)).failures


def test_too_few_repeats_never_pass() -> None:
    assessment = judge(cell(4 * [0]))
    assert assessment.missing_evidence == (f"{PLACE}, 1000 B: 4 of 5 valid repeats with samples; run more",)
    assert judge(cell(4 * [0]), criterion=replace(ONE_PERCENT, repeats=4)).passed


def test_void_and_failed_repeats_do_not_count() -> None:
    measured_cell = cell(6 * [0], status=["valid", "void", "valid", "failed", "valid", "valid"])
    assert measured_cell.attempts == 6
    assert judge(measured_cell).missing_evidence == (f"{PLACE}, 1000 B: 4 of 5 valid repeats with samples; run more",)
    # The loss of a void repeat is also ignored.
    assert judge(cell([0, 0, 0, 0, 0, 90], status=[*5 * ["valid"], "void"])).passed


def test_a_valid_repeat_without_a_loss_never_passes() -> None:
    assessment = judge(cell([*5 * [0], UNKNOWN]))
    assert not assessment.passed
    assert "no value in 1 of 6 repeats" in assessment.missing_evidence[0]
    # No sample was sent because there was no subscription.
    assert judge(cell(5 * [0], sent=0)).missing_evidence
    assert not judge(cell(5 * [0], sent=0)).failures


def test_no_valid_repeat_at_all_is_undecided() -> None:
    assessment = judge(cell([0, 0], status=["void", "void"]))
    assert not assessment.passed
    assert not assessment.failures
    assert f"{PLACE}, 1000 B: loss <= 0.01: no repeat is valid" in assessment.missing_evidence


@pytest.mark.parametrize(("largest_s", "passed"), [(0.2, True), (0.201, False)])
def test_a_delay_limit_applies_to_every_repeat(largest_s: float, passed: bool) -> None:
    measured_cell = cell(5 * [0], delay_s=[0.01, 0.02, largest_s, 0.01, 0.01])
    assessment = judge(measured_cell, criterion=replace(ONE_PERCENT, max_delay_s=0.2))
    assert assessment.passed == passed
    assert bool(assessment.failures) == (not passed)
    assert judge(measured_cell).passed


def test_a_missing_delay_never_passes() -> None:
    measured_cell = cell(5 * [0], delay_s=[0.01, 0.02, UNKNOWN, 0.01, 0.01])
    assessment = judge(measured_cell, criterion=replace(ONE_PERCENT, max_delay_s=0.2))
    assert not assessment.failures
    assert "no value in 1 of 5 repeats" in assessment.missing_evidence[0]
    assert judge(measured_cell).passed  # no delay is needed without a delay limit


def test_a_censored_delay_never_passes() -> None:
    # More than 5 % of the samples were lost, so the 95 % quantile of the delays of all sent samples is censored.
    lenient = LinkCriterion(0.5, 0.2)
    measured_cell = cell(5 * [10], delay_sent_s=[0.01, UNKNOWN, 0.01, 0.01, 0.01])
    assessment = judge(measured_cell, criterion=lenient)
    assert not assessment.failures
    assert "in 1 of 5 repeats the figure is infinite because of lost items" in assessment.missing_evidence[0]
    # The received samples alone exceed the limit, so the lost samples cannot change the result.
    late = cell(5 * [10], delay_s=5 * [0.3], delay_sent_s=5 * [UNKNOWN])
    assert judge(late, criterion=lenient).failures


@pytest.mark.parametrize(
    ("lost", "passed", "failed"),
    # One-sided confidence of 95 % (Clopper and Pearson 1934): a share of 90 % needs 29 of 29 repeats, because
    # 0.9^29 < 5 % < 0.9^28, or 45 of 46 repeats.
    [
        (29 * [0], True, False),
        (28 * [0], False, False),
        ([*45 * [0], 5], True, False),
        ([*44 * [0], 5], False, False),
        (29 * [5], False, True),
    ],
)
def test_a_share_of_repeats_needs_confidence(lost: list[float], passed: bool, failed: bool) -> None:
    assessment = judge(cell(lost), criterion=replace(ONE_PERCENT, share=0.9))
    assert assessment.passed == passed
    assert bool(assessment.failures) == failed


def test_every_cell_must_exist_and_pass() -> None:
    good, bad = cell(5 * [0]), cell(5 * [9], size_bytes=1e6)
    assert judge(good, bad).failures == (f"{PLACE}, 1e+06 B: loss <= 0.01 in 0 of 5 repeats, up to 0.09",)
    expected = {(PLACE, SIZE), (PLACE, 1e6)}
    assessment = candidates.assess_candidate(DDS, [good], expected, ONE_PERCENT)
    assert assessment.missing_evidence == (f"{PLACE}, 1e+06 B: not measured, although other candidates were",)


def test_the_rank_is_the_loss_of_the_worst_cell_and_then_the_delay() -> None:
    fast, slow = cell(5 * [0], delay_s=5 * [0.01]), cell(5 * [0], delay_s=[0.01, 0.01, 0.3, 0.01, 0.01])
    lossy, unknown = cell([1, 1, 0, 0, 1]), cell(5 * [0], delay_s=[0.01, UNKNOWN, 0.01, 0.01, 0.01])
    empty = cell([0, 0], status=["void", "void"])
    assert judge(fast).rank == (0, 0.01)
    assert judge(slow).rank == judge(fast, slow).rank == (0, 0.3)
    assert judge(unknown).rank == (0, float("inf"))  # an unknown delay ranks last
    assert judge(lossy).rank == judge(fast, lossy).rank == (3 / 500, 0.01)
    assert judge(fast, empty).rank == (float("inf"), float("inf"))


def test_the_evidence_contains_every_repeat() -> None:
    measured_cell = cell([0, 1, 0, 0, 1], delay_s=[0.01, 0.02, 0.03, UNKNOWN, 0.01])
    text = "\n".join(candidates.evidence(judge(measured_cell), ONE_PERCENT))
    assert "loss <= 0.01 in 5 of 5 repeats: in at least 55 % of all repeats, with 95 % confidence" in text
    assert "by repeat 0.0, 1.0, 0.0, 0.0, 1.0" in text
    assert "by repeat 10.0, 20.0, 30.0, 10.0, unknown in 1" in text
    assert "Criterion: loss at most 1 %, in each repeat." in text
    assert "trials: trials/a" in text
