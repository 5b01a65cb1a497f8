"""Functions on procedures and plans for tests."""

from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from fieldkit.core.model import Protocol, RepeatId
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.steps.base import Step
from fieldkit.trial import gates
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure

S = TypeVar("S", bound=Step)


def steps_of(procedure: Procedure, kind: type[S], *, undisturbed: bool = False) -> Iterator[S]:
    """Yield all steps of a kind in the order of their start; with `undisturbed`, without those inside a fault."""
    for placed in procedure.walk():
        if isinstance(placed.step, kind) and not (undisturbed and placed.disturbed):
            yield placed.step


def write_states(folder: Path, *roles: str) -> None:
    """Write the empty state notes of robots before and after an attempt, by default of sender and receiver."""
    for role in roles or ("sender", "receiver"):
        for moment in ("before", "after"):
            (folder / f"{role}-{moment}.txt").write_text("==> end <==\n", encoding="ascii")


def problems(plan: Plan, protocol: Protocol, folder: Path) -> tuple[str, ...]:
    """The problems in the evidence of an attempt, which is in a folder."""
    return gates.judge(plan, RepeatId(protocol, 1), AttemptEvidence(folder)).problems
