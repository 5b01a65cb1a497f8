"""Judgements of expectations by measured figures. If repeats are missing or censored, the ruling is never `holds`.

A cell has the estimates and counts of the repeats under one condition.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis import one_sided_bounds
from fieldkit.analysis.cells import Cell, Estimate, RepeatValues
from fieldkit.analysis.expectations import Expectation, Scope

_INFINITE_DELAY_REASON: Final = "if the delay of lost items is infinite, the interval extends beyond the bound"


class Ruling(StrEnum):
    """Outcome of an expectation, which is a requirement on a figure of a trial."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "undecided"


@dataclass(frozen=True)
class Judgement:
    """Judgement of an expectation by the repeats under one condition.

    Attributes:
        expectation: The expectation.
        cell: The repeats; None if there are none.
        ruling: The outcome.
        estimate: The estimate; None if no valid repeat has a value.
        why: Reason for the ruling that the numbers do not show, for example repeats without a value, or the number of
            repeats that are needed; empty if there is none.
        met: Number of repeats that meet the expectation; None if it does not refer to single repeats.
        limit: One-sided 95 % bound that the ruling `holds` requires: the lower bound of the share of repeats that
            meet the expectation, or the upper bound of the loss; None if `holds` depends on no such bound.
    """

    expectation: Expectation
    cell: Cell | None
    ruling: Ruling
    estimate: Estimate | None
    why: str = ""
    met: int | None = None
    limit: float | None = None

    @property
    def holds(self) -> bool:
        """True if the repeats show that the expectation is met."""
        return self.ruling is Ruling.HOLDS


@dataclass(frozen=True)
class _Decision:
    """Ruling from the repeats that have a value. The attributes have the same meaning as in `Judgement`."""

    ruling: Ruling
    why: str = ""
    met: int | None = None
    limit: float | None = None


def judge(expectations: Sequence[Expectation], cells: Sequence[Cell]) -> tuple[Judgement, ...]:
    """Return the judgements of expectations, in their order. An expectation that no cell fits is undecided."""
    return tuple(judgement for expectation in expectations for judgement in _judge_cells(expectation, cells))


def judge_by_trial(cells: Iterable[tuple[Cell, Iterable[Expectation]]]) -> tuple[Judgement, ...]:
    """Return the judgements of the expectations of several trials, in the order of expectations.

    Trials under the same condition are judged together.

    Args:
        cells: Each cell with the expectations of its trials.
    """
    cells_by_expectation: dict[Expectation, list[Cell]] = {}
    for cell, expectations in cells:
        for expectation in dict.fromkeys(expectations):
            cells_by_expectation.setdefault(expectation, []).append(cell)
    return tuple(
        judgement
        for expectation, matching_cells in cells_by_expectation.items()
        for judgement in _judge_cells(expectation, matching_cells)
    )


def _judge_cells(expectation: Expectation, cells: Sequence[Cell]) -> Iterator[Judgement]:
    """Yield a judgement for each cell whose protocol matches, or one judgement without a cell if none matches."""
    matching_cells = [cell for cell in cells if expectation.protocol in {None, cell.key.get("protocol")}]
    for cell in matching_cells:
        estimate = cell.estimates.get(expectation.quantity)
        if estimate is None:
            why = f"0 of {cell.n_valid} repeats have a value" if cell.n_valid else "no repeat is valid"
            yield Judgement(expectation, cell, Ruling.OPEN, None, why)
            continue
        decision = _decide(expectation, estimate)
        limitations = list(_limitations(expectation, estimate, cell.n_valid))
        ruling = Ruling.OPEN if limitations and decision.ruling is Ruling.HOLDS else decision.ruling
        why = "; ".join((*limitations, *([decision.why] if decision.why else [])))
        yield Judgement(expectation, cell, ruling, estimate, why, decision.met, decision.limit)
    if not matching_cells:
        yield Judgement(expectation, None, Ruling.OPEN, None, "no repeat has ended")


def _limitations(expectation: Expectation, estimate: Estimate, n_valid: int) -> Iterator[str]:
    """Yield the reasons why the ruling cannot be `holds`, even if the repeats with a value meet the expectation."""
    if missing := max(n_valid - estimate.n, estimate.missing):
        yield f"no value in {missing} of {estimate.n + missing} repeats"
    if estimate.n_censored:
        share = f"{estimate.n_censored} of {estimate.n}"
        yield f"in {share} repeats the timed event had not ended, so only a lower bound is known"
    if expectation.is_below and estimate.quantity.of_sent and estimate.sample is not None:
        infinite = int(np.isinf(estimate.sample.high).sum()) - estimate.n_censored
        if infinite:
            yield f"in {infinite} of {estimate.n} repeats the figure is infinite because of lost items"


def _decide(expectation: Expectation, estimate: Estimate) -> _Decision:
    """Return the ruling from the repeats that have a value."""
    if expectation.scope is Scope.FIGURE:
        return _decide_figure(expectation, estimate)
    if estimate.sample is None:
        return _Decision(Ruling.OPEN)
    if expectation.scope is Scope.PACKETS:
        return _decide_packets(expectation, estimate, estimate.sample)
    met, violated = _count_met(expectation, estimate.sample)
    if expectation.scope is Scope.EVERY:
        ruling = Ruling.FAILS if violated else Ruling.HOLDS if met == estimate.n else Ruling.OPEN
        return _Decision(ruling, met=met)
    return _decide_share(expectation, estimate.n, met, violated)


def _decide_figure(expectation: Expectation, estimate: Estimate) -> _Decision:
    """Decide by the interval: both ends must satisfy the bound.

    For a figure that is computed only from received items, the upper end counts each lost item as an infinite value.
    An open end is infinite.
    """
    if estimate.low is None:
        return _Decision(Ruling.OPEN, "a single repeat has no interval" if estimate.n == 1 else "it has no interval")
    high = estimate.high_of_sent if expectation.is_below and estimate.quantity.of_sent else estimate.high
    upper_end = math.inf if high is None else high
    ends = [expectation.is_met(end) for end in (estimate.low, upper_end)]
    if all(ends):
        return _Decision(Ruling.HOLDS)
    if not any(ends):
        return _Decision(Ruling.FAILS)
    is_extended = high is not None and estimate.high is not None and high > estimate.high
    return _Decision(
        Ruling.OPEN, _INFINITE_DELAY_REASON if is_extended and expectation.is_met(estimate.high or 0.0) else ""
    )


def _count_met(expectation: Expectation, sample: RepeatValues) -> tuple[int, int]:
    """Return the number of repeats that certainly meet an expectation, and the number that certainly violate it."""
    low, high = (_are_met(expectation, ends) for ends in (sample.low, sample.high))
    return int((low & high).sum()), int((~low & ~high).sum())


def _are_met(expectation: Expectation, values: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.fromiter(map(expectation.is_met, values.tolist()), np.bool_, len(values))


def _decide_share(expectation: Expectation, n: int, met: int, violated: int) -> _Decision:
    """Decide by the one-sided 95 % bound of the share of all repeats that meet the expectation."""
    share = expectation.share or 1.0
    low = one_sided_bounds.share_low(met, n)
    if low >= share * (1 - one_sided_bounds.ROUNDING):
        return _Decision(Ruling.HOLDS, met=met, limit=low)
    if one_sided_bounds.share_high(n - violated, n) < share:
        return _Decision(Ruling.FAILS, met=met, limit=low)
    needed = one_sided_bounds.repeats_for(share)
    why = f"{needed} repeats are needed, if all meet it" if n < needed else ""
    return _Decision(Ruling.OPEN, why, met, low)


def _decide_packets(expectation: Expectation, estimate: Estimate, sample: RepeatValues) -> _Decision:
    """Decide by the share of lost packets in all repeats, and its upper bound."""
    if sample.lost is None or sample.sent is None:
        return _Decision(Ruling.OPEN)
    limit = one_sided_bounds.loss_high(sample.lost, sample.sent)
    if not expectation.is_met(estimate.value):
        return _Decision(Ruling.FAILS, limit=limit)
    if expectation.is_met(limit):
        return _Decision(Ruling.HOLDS, limit=limit)
    needed, sent = one_sided_bounds.packets_for(expectation.bound), int(sample.sent.sum())
    why = f"{sent} packets were sent, but at least {needed} are needed" if sent < needed else ""
    return _Decision(Ruling.OPEN, why, limit=limit)
