"""Procedures (`procedures/*.yaml`) -> frozen objects: the scripted steps of a trial, spoken of in roles."""

from collections.abc import Iterator
from typing import Annotated, TypeVar

from fieldkit import catalog
from fieldkit.config import Field, Int
from fieldkit.model import Protocol, Role, Scenario, Topology
from fieldkit.steps import Entry
from fieldkit.steps.base import Step
from fieldkit.steps.capture import Capture


class Procedure(catalog.Named):
    """A scripted trial: one YAML file in `procedures/`.

    Attributes:
        scenario: Whether an obstacle stands between the robots.
        topology: Used when the command line names none.
        protocols: Used when the command line names none.
        repeats: Per protocol, used when the command line names none.
        attempts: How often a repeat is tried while its evidence is not whole.
        steps: What is done in each repeat.
    """

    scenario: Scenario
    topology: Topology
    protocols: Annotated[tuple[Protocol, ...], Field(min_length=1)]
    repeats: Annotated[Int, Field(gt=0)]
    attempts: Annotated[Int, Field(gt=0)] = 3
    steps: Annotated[tuple[Entry, ...], Field(min_length=1)]

    def roles(self) -> frozenset[Role]:
        """Return the roles that the steps need."""
        return frozenset().union(*(entry.step.roles() for entry in self.steps))

    def expected_s(self, protocol: Protocol) -> float:
        """Return about how many seconds one repeat takes on a good link."""
        return 0.5 + sum(entry.step.expected_s(protocol) for entry in self.steps)

    def with_record(self, duration_s: float) -> "Procedure":
        """Return this procedure with every recording `duration_s` long."""
        return self.model_copy(update={"steps": tuple(_with_record(entry, duration_s) for entry in self.steps)})


def _with_record(entry: Entry, duration_s: float) -> Entry:
    if entry.record is not None:
        return Entry(record=entry.record.model_copy(update={"duration": duration_s}))
    if entry.capture is not None:
        during = tuple(_with_record(inner, duration_s) for inner in entry.capture.during)
        return Entry(capture=entry.capture.model_copy(update={"during": during}))
    return entry


StepKind = TypeVar("StepKind", bound=Step)


def steps_of(procedure: Procedure, kind: type[StepKind]) -> Iterator[StepKind]:
    """Yield the steps of one kind, also those inside a capture, in order."""

    def walk(entries: tuple[Entry, ...]) -> Iterator[Step]:
        for entry in entries:
            yield entry.step
            if isinstance(entry.step, Capture):
                yield from walk(entry.step.during)

    return (step for step in walk(procedure.steps) if isinstance(step, kind))


def load_procedure(name: str) -> Procedure:
    """Return the procedure `name`, the lab's own folder first.

    Raises:
        ConfigurationError: No such procedure (the nearest name is given), or an error in its file.
    """
    return catalog.load("procedures", name, Procedure)
