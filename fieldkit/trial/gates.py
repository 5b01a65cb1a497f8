"""Evidence gates and measures of an attempt, through one reading of its files."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Measured, cell, prefixed
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Lateness, RepeatId
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import lateness, link, link_samples, track
from fieldkit.steps.view import View
from fieldkit.trial import hosts, placements
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import PlacedStep


@dataclass(frozen=True)
class Judged:
    """Judgement on the evidence of an attempt.

    Attributes:
        problems: The reasons for which it is not whole, so that the attempt is void; a sentence each.
        measured: What it says all the same.
    """

    problems: tuple[str, ...]
    measured: Measured


def judge(plan: Plan, repeat: RepeatId, evidence: AttemptEvidence) -> Judged:
    """Measure an attempt and say whether its evidence is whole.

    Evidence of steps inside a fault need not be: they are what the fault disturbs. What steps declare is measured, or
    missing for a reason; where it is neither, a figure got lost, and the attempt is void. So it is where a step
    cannot measure what it left: a trial goes on, and is resumed and rebuilt, whatever one file holds.

    Raises:
        MemoryError: This machine has too little, which says nothing of the evidence.
    """
    scene = plan.scene(repeat, "")
    # What happened to a robot comes first: it is the cause of much of the rest.
    problems = list(hosts.problems(plan.procedure, scene, evidence))
    measured = lateness.measure(evidence.read_or_none(lateness.read, lateness.FILE))
    for role in link.ROLES:
        measured |= link.measure(role, evidence.links(role))
    misplaced = placements.contradiction(scene, evidence)
    for placed in plan.procedure.walk():
        view = View(scene, evidence, placed.within)
        try:
            found = placed.step.measure(view)
            impossible = dict(_impossible(placed, found))
            if not placed.disturbed:
                problems += (_of_step(placed, why) for why in placed.step.check(view))
                problems += _unexplained(placed, found)
                problems += impossible.values()
            found = found.without(impossible)
            if misplaced:
                found = found.without({name: misplaced for name in found.values if placements.is_dependent(name)})
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 (see above)
            why = f"what {placed.called} left cannot be measured: {type(error).__name__}: {error}"
            problems.append(why)
            found = Measured.nothing(placed.step.output_columns(), why)
        measured |= found.named(placed.step.prefix)
    problems += _of_the_testbed(evidence)
    return Judged(tuple(problems), measured)


def _of_step(placed: PlacedStep, why: str) -> str:
    """Return what is wrong with what a step left, with its name, if it has one."""
    return f"{placed.step.prefix}: {why}" if placed.step.prefix else why


def _unexplained(placed: PlacedStep, found: Measured) -> Iterator[str]:
    for column in placed.step.output_columns():
        if column.name not in found.values and column.name not in found.missing:
            yield f"{placed.called} does not say why it has no {column.name}"


def _impossible(placed: PlacedStep, found: Measured) -> Iterator[tuple[str, str]]:
    """Yield what no such column can hold, with the reason: no table that has it would be read again."""
    for column in placed.step.output_columns():
        text = "" if column.type is str else cell(found.values.get(column.name))
        if text and (problem := "not a number" if text == "nan" else column.problem(text)):
            yield column.name, f"the evidence gives {prefixed(placed.step.prefix, column.name)} as {text}, {problem}"


_OF_THE_TESTBED: Final[tuple[tuple[Callable[[Path], object], str], ...]] = (
    (lateness.read, lateness.FILE),
    (track.read, track.FILE),
    (link_samples.read, link_samples.FILE),
)


def _of_the_testbed(evidence: AttemptEvidence) -> Iterator[str]:
    """Yield what is wrong with what the testbed's oracle wrote, where it has one."""
    for read, name in _OF_THE_TESTBED:
        try:
            found = evidence.read(read, name) if evidence.has(name) else None
        except EvidenceError as error:
            yield f"{name}: {error.what}"
            continue
        if isinstance(found, Lateness) and (why := lateness.problem(found)):
            yield f"{name}: {why}"
