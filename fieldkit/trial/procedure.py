"""Procedures (`procedures/*.yaml`) -> frozen objects: the scripted steps of a trial, spoken of in roles."""

from collections.abc import Iterator
from typing import Annotated, TypeVar

from fieldkit.config import catalog, schema
from fieldkit.config.schema import Field, Int
from fieldkit.core.model import Protocol, Role, Scenario, Topology
from fieldkit.steps import Entry
from fieldkit.steps.base import Nest, Step
from fieldkit.steps.fault import Fault
from fieldkit.steps.move import Move
from fieldkit.steps.record import Record
from fieldkit.steps.transfer import Transfer


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

    @schema.model_validator(mode="after")
    def _transfers_have_files(self) -> "Procedure":
        recorded = {step.robot for step in steps_of(self, Record)}
        for step in steps_of(self, Transfer):
            if step.file is None and step.sender not in recorded:
                raise schema.complaint(f"the transfer from {step.sender} names no file, and no step records on it")
        return self

    @schema.model_validator(mode="after")
    def _leaves_nothing_twice(self) -> "Procedure":
        left: set[str] = set()
        for place, step in _placed(self.steps, ("steps",)):
            for one in step.leaves():
                if one in left:
                    raise schema.complaint(
                        f"{one} comes twice, and a row has room for one; make two procedures", *place
                    )
                left.add(one)
        return self

    @schema.model_validator(mode="after")
    def _no_move_in_a_fault(self) -> "Procedure":
        for place, step in _placed(self.steps, ("steps",)):
            if isinstance(step, Fault):
                for inner, one in _placed(step.during, (*place, "during")):
                    if isinstance(one, Move):
                        raise schema.complaint("a fault has no move inside: put the fault into the move", *inner)
        return self

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
    step = entry.step
    if isinstance(step, Record):
        changed: dict[str, object] = {"duration": duration_s}
    elif isinstance(step, Nest):
        changed = {"during": tuple(_with_record(inner, duration_s) for inner in step.during)}
    else:
        return entry
    return entry.model_copy(update={entry.kind: step.model_copy(update=changed)})


def _placed(entries: tuple[Entry, ...], place: schema.Location) -> Iterator[tuple[schema.Location, Step]]:
    """Yield every step and where it stands in the file."""
    for index, entry in enumerate(entries):
        at = (*place, index, entry.kind)
        yield at, entry.step
        if isinstance(entry.step, Nest):
            yield from _placed(entry.step.during, (*at, "during"))


StepKind = TypeVar("StepKind", bound=Step)


def steps_of(procedure: Procedure, kind: type[StepKind], *, undisturbed: bool = False) -> Iterator[StepKind]:
    """Yield the steps of one kind in order, also those inside others.

    Args:
        procedure: The procedure.
        kind: Which steps.
        undisturbed: Leave out what is inside a fault, and may fail because of it.
    """

    def walk(entries: tuple[Entry, ...]) -> Iterator[Step]:
        for step in (entry.step for entry in entries):
            yield step
            if isinstance(step, Nest) and not (undisturbed and isinstance(step, Fault)):
                yield from walk(step.during)

    return (step for step in walk(procedure.steps) if isinstance(step, kind))


def load_procedure(name: str) -> Procedure:
    """Return the procedure `name`, the lab's own folder first.

    Raises:
        ConfigurationError: No such procedure (the nearest name is given), or an error in its file.
    """
    return catalog.load("procedures", name, Procedure)
