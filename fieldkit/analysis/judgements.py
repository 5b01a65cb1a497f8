"""Judgements: whether figures are where they are expected to be, by their intervals."""

import operator
from collections.abc import Iterable, Iterator, Sequence
from enum import StrEnum

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.expectations import Expectation
from fieldkit.core.lazy import dataclass


class Ruling(StrEnum):
    """What the figures say of an expectation."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "cannot be told"


@dataclass(frozen=True)
class Judgement:
    """What the repeats under one condition say of an expectation.

    Attributes:
        expectation: Which.
        cell: Those repeats; None where there are none.
        ruling: Whether it holds: the whole 95 % interval is where it is to be, none of it is, or neither.
        found: The figure; None where no valid repeat has it.
    """

    expectation: Expectation
    cell: Cell | None
    ruling: Ruling
    found: Estimate | None

    @property
    def holds(self) -> bool:
        """Whether the figure is shown to be where it is to be."""
        return self.ruling is Ruling.HOLDS


def judge(expectations: Sequence[Expectation], cells: Sequence[Cell]) -> tuple[Judgement, ...]:
    """Return what cells say of expectations, expectation by expectation; one that no cell is of can not be told."""
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
        yield Judgement(expectation, cell, _ruling(expectation, found), found)
    if not concerned:
        yield Judgement(expectation, None, Ruling.OPEN, None)


def _ruling(expectation: Expectation, found: Estimate | None) -> Ruling:
    if found is None or found.low is None or found.high is None:
        return Ruling.OPEN
    beyond = operator.lt if expectation.is_below else operator.gt
    ends = [beyond(end, expectation.bound) for end in (found.low, found.high)]
    if all(ends):
        return Ruling.HOLDS
    return Ruling.OPEN if any(ends) else Ruling.FAILS
