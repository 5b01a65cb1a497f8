"""Judgements: whether figures are where they are expected to be. Missing and censored repeats never make one hold."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis import bounds
from fieldkit.analysis.cells import Cell, Estimate, RepeatValues
from fieldkit.analysis.expectations import Expectation, Scope

_LATE: Final = "counting what was lost as late, the interval goes beyond it"


class Ruling(StrEnum):
    """What the figures say of an expectation."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "undecided"


@dataclass(frozen=True)
class Judgement:
    """What the repeats under one condition say of an expectation.

    Attributes:
        expectation: Which.
        cell: Those repeats; None where there are none.
        ruling: Whether it holds.
        found: The figure; None where no valid repeat has it.
        why: Why it does not hold, beside the numbers: which repeats lack a value, or how many more are needed.
        met: How many repeats meet it, each by itself; None if it is not about single repeats.
        limit: The 95 % bound that decided: of the share of repeats that meet it, or of the loss; None without one.
    """

    expectation: Expectation
    cell: Cell | None
    ruling: Ruling
    found: Estimate | None
    why: str = ""
    met: int | None = None
    limit: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the figure is shown to be where it must be."""
        return self.ruling is Ruling.HOLDS


@dataclass(frozen=True)
class _Decision:
    """A ruling on the repeats that have a value, as the attributes of `Judgement`."""

    ruling: Ruling
    why: str = ""
    met: int | None = None
    limit: float | None = None


def judge(expectations: Sequence[Expectation], cells: Sequence[Cell]) -> tuple[Judgement, ...]:
    """Return what cells say of expectations, expectation by expectation; undecided where there is no cell."""
    return tuple(judgement for expectation in expectations for judgement in _judged(expectation, cells))


def judge_own(cells: Iterable[tuple[Cell, Iterable[Expectation]]]) -> tuple[Judgement, ...]:
    """Return what cells say of what their own trials expect, expectation by expectation.

    Trials under one condition are judged together.

    Args:
        cells: With what the trials of each expect.
    """
    concerned: dict[Expectation, list[Cell]] = {}
    for cell, expected in cells:
        for one in dict.fromkeys(expected):
            concerned.setdefault(one, []).append(cell)
    return tuple(said for expectation, of in concerned.items() for said in _judged(expectation, of))


def _judged(expectation: Expectation, cells: Sequence[Cell]) -> Iterator[Judgement]:
    concerned = [cell for cell in cells if expectation.protocol in {None, cell.key.get("protocol")}]
    for cell in concerned:
        found = cell.estimates.get(expectation.quantity)
        if found is None:
            why = f"0 of {cell.n_valid} repeats have a value" if cell.n_valid else "no repeat is valid"
            yield Judgement(expectation, cell, Ruling.OPEN, None, why)
            continue
        decision = _decided(expectation, found)
        flaws = list(_flaws(expectation, found, cell.n_valid))
        ruling = Ruling.OPEN if flaws and decision.ruling is Ruling.HOLDS else decision.ruling
        why = "; ".join((*flaws, *([decision.why] if decision.why else [])))
        yield Judgement(expectation, cell, ruling, found, why, decision.met, decision.limit)
    if not concerned:
        yield Judgement(expectation, None, Ruling.OPEN, None, "no repeat has ended")


def _flaws(expectation: Expectation, found: Estimate, valid: int) -> Iterator[str]:
    """Yield why an expectation must not hold on the repeats that have a value alone."""
    if missing := max(valid - found.n, found.missing):
        yield f"{missing} of {found.n + missing} repeats have no value"
    if found.n_censored:
        yield f"in {found.n_censored} of {found.n} repeats it had not ended, so that they give lower bounds"
    if expectation.is_below and found.quantity.of_sent and found.sample is not None:
        infinite = int(np.isinf(found.sample.high).sum()) - found.n_censored
        if infinite:
            yield f"in {infinite} of {found.n} repeats it has no value over all that was sent: too much was lost"


def _decided(expectation: Expectation, found: Estimate) -> _Decision:
    if expectation.scope is Scope.FIGURE:
        return _of_figure(expectation, found)
    if found.sample is None:
        return _Decision(Ruling.OPEN)
    if expectation.scope is Scope.PACKETS:
        return _of_packets(expectation, found, found.sample)
    met, violated = _counted(expectation, found.sample)
    if expectation.scope is Scope.EVERY:
        ruling = Ruling.FAILS if violated else Ruling.HOLDS if met == found.n else Ruling.OPEN
        return _Decision(ruling, met=met)
    return _of_share(expectation, found.n, met, violated)


def _of_figure(expectation: Expectation, found: Estimate) -> _Decision:
    """Rule by the whole interval: all of it must be where the figure must be.

    The upper end of a figure of what arrived is that over all that was sent. Without a number it is infinite.
    """
    if found.low is None:
        return _Decision(Ruling.OPEN, "a single repeat has no interval" if found.n == 1 else "it has no interval")
    high = found.high_of_sent if expectation.is_below and found.quantity.of_sent else found.high
    top = math.inf if high is None else high
    ends = [expectation.is_met(end) for end in (found.low, top)]
    if all(ends):
        return _Decision(Ruling.HOLDS)
    if not any(ends):
        return _Decision(Ruling.FAILS)
    late = high is not None and found.high is not None and high > found.high
    return _Decision(Ruling.OPEN, _LATE if late and expectation.is_met(found.high or 0.0) else "")


def _counted(expectation: Expectation, sample: RepeatValues) -> tuple[int, int]:
    """Return how many repeats meet a demand, and how many do not, whatever is unknown of them."""
    low, high = (_are_met(expectation, ends) for ends in (sample.low, sample.high))
    return int((low & high).sum()), int((~low & ~high).sum())


def _are_met(expectation: Expectation, values: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.fromiter(map(expectation.is_met, values.tolist()), np.bool_, len(values))


def _of_share(expectation: Expectation, n: int, met: int, violated: int) -> _Decision:
    """Rule by the one-sided 95 % bound of the share of all repeats that meet the demand."""
    share = expectation.share or 1.0
    low = bounds.share_low(met, n)
    if low >= share:
        return _Decision(Ruling.HOLDS, met=met, limit=low)
    if bounds.share_high(n - violated, n) < share:
        return _Decision(Ruling.FAILS, met=met, limit=low)
    needed = bounds.repeats_for(share)
    why = f"{needed} repeats are needed, if all meet it" if n < needed else ""
    return _Decision(Ruling.OPEN, why, met, low)


def _of_packets(expectation: Expectation, found: Estimate, sample: RepeatValues) -> _Decision:
    """Rule by the share of all packets lost, and its upper bound."""
    if sample.lost is None or sample.sent is None:
        return _Decision(Ruling.OPEN)
    limit = bounds.loss_high(sample.lost, sample.sent)
    if not expectation.is_met(found.value):
        return _Decision(Ruling.FAILS, limit=limit)
    if expectation.is_met(limit):
        return _Decision(Ruling.HOLDS, limit=limit)
    needed, sent = bounds.packets_for(expectation.bound), int(sample.sent.sum())
    why = f"{sent} of {needed} packets that it needs at least" if sent < needed else ""
    return _Decision(Ruling.OPEN, why, limit=limit)
