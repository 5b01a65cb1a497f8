"""What was expected of the trials of a report, and whether it holds."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.judgements import Judgement, Ruling, judge_own
from fieldkit.analysis.wording import judged
from fieldkit.report import wording
from fieldkit.report.evidence import Evidence


@dataclass(frozen=True)
class JudgementRow:
    """What the repeats under one condition say of an expectation, in words.

    Attributes:
        place: The condition; empty where there is none.
        value: What was measured.
        interval: Its 95 % interval, empty without one.
        ruling: Whether the expectation holds.
        why: Why it does not hold, beside the numbers; empty where they say it.
    """

    place: str
    value: str
    interval: str
    ruling: Ruling
    why: str = ""


def verdicts(cells: Sequence[Cell], evidence: Evidence) -> Mapping[str, Sequence[JudgementRow]]:
    """Return what cells say of what their own trials expect, by expectation as it was written.

    Nothing is known of what is expected of a table without its trial.
    """
    told = wording.differing(cells)
    found: dict[str, list[JudgementRow]] = {}
    for said in judge_own((cell, _of(cell, evidence)) for cell in cells):
        found.setdefault(said.expectation.text, []).append(_verdict(said, told))
    return found


def _verdict(said: Judgement, told: Collection[str]) -> JudgementRow:
    place = wording.condition(said.cell, told=told) if said.cell else ""
    _, _, value, interval, _ = judged(said)
    return JudgementRow(place, wording.unbroken(value), wording.unbroken(interval), said.ruling, said.why)


def _of(cell: Cell, evidence: Evidence) -> Iterator[Expectation]:
    """Yield what the trials of a cell expect."""
    plans = {id(plan): plan for row in evidence.rows(cell).tolist() if (plan := evidence.plan(row))}
    return (one for plan in plans.values() for one in plan.procedure.expectations)
