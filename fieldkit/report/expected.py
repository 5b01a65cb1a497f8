"""What was expected of the trials of a report, and whether it holds."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.judgements import Judgement, Ruling, judge
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
    """

    place: str
    value: str
    interval: str
    ruling: Ruling


def verdicts(cells: Sequence[Cell], evidence: Evidence) -> Mapping[str, Sequence[JudgementRow]]:
    """Return what cells say of what their own trials expect, by expectation as it was written.

    Trials under one condition are judged together, by the figures that the report shows. Nothing is known of what is
    expected of a table without its trial.
    """
    concerned: dict[Expectation, list[Cell]] = {}
    for cell in cells:
        for expectation in _of(cell, evidence):
            concerned.setdefault(expectation, []).append(cell)
    told = wording.differing(cells)
    return {one.text: [_verdict(said, told) for said in judge([one], of)] for one, of in concerned.items()}


def _verdict(said: Judgement, told: Collection[str]) -> JudgementRow:
    place = wording.condition(said.cell, told=told) if said.cell else ""
    if said.found is None:
        return JudgementRow(place, "nothing", "", said.ruling)
    return JudgementRow(place, wording.value(said.found), wording.interval(said.found), said.ruling)


def _of(cell: Cell, evidence: Evidence) -> Sequence[Expectation]:
    """Return what the trials of a cell expect, each once."""
    plans = {id(plan): plan for row in evidence.rows(cell).tolist() if (plan := evidence.plan(row))}
    return list(dict.fromkeys(one for plan in plans.values() for one in plan.procedure.expectations))
