"""Texts that show in a report whether the measured values meet the expectations of the trials.

A cell contains the repeats under one condition, and their estimates.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.judgement_words import judgement_texts
from fieldkit.analysis.judgements import Judgement, Ruling, judge_by_trial
from fieldkit.report import wording
from fieldkit.report.trial_folders import Evidence


@dataclass(frozen=True)
class JudgementRow:
    """The judgement of an expectation under one condition, as texts.

    Attributes:
        condition: The condition; empty if no repeat of the expectation's protocol has ended.
        value: The measured value; `nothing` if no valid repeat has one.
        interval: The 95 % interval or the one-sided bound that determines the ruling; empty if there is none.
        ruling: The ruling on the expectation.
        why: Reason for the ruling that the numbers do not show; empty if there is none.
    """

    condition: str
    value: str
    interval: str
    ruling: Ruling
    why: str = ""


def judgement_rows(cells: Sequence[Cell], evidence: Evidence) -> Mapping[str, Sequence[JudgementRow]]:
    """Return the judgements of the trials' expectations, by the text of the expectation.

    The expectations of a trial are unknown if only its table is available.
    """
    differing = wording.differing(cells)
    rows: dict[str, list[JudgementRow]] = {}
    for judgement in judge_by_trial((cell, _expectations_of(cell, evidence)) for cell in cells):
        rows.setdefault(judgement.expectation.text, []).append(_judgement_row(judgement, differing))
    return rows


def _judgement_row(judgement: Judgement, differing: Collection[str]) -> JudgementRow:
    condition = wording.condition(judgement.cell, differing=differing) if judgement.cell else ""
    _, _, value, interval, _ = judgement_texts(judgement)
    return JudgementRow(
        condition, wording.without_breaks(value), wording.without_breaks(interval), judgement.ruling, judgement.why
    )


def _expectations_of(cell: Cell, evidence: Evidence) -> Iterator[Expectation]:
    """Yield the expectations of a cell's trials."""
    plans = {id(plan): plan for row in evidence.rows(cell).tolist() if (plan := evidence.plan(row))}
    return (expectation for plan in plans.values() for expectation in plan.procedure.expectations)
