"""Procedures (`procedures/*.yaml`) -> frozen objects: the scripted steps of a trial, spoken of in roles."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Final

from fieldkit.backends.protocols import Cast
from fieldkit.config import catalog, schema
from fieldkit.config.schema import Field, Int
from fieldkit.core.model import MOST_REPEATS, Protocol, Role, Scenario, Topology
from fieldkit.measure.evidence import host, lateness, track
from fieldkit.steps.base import Nest, Step, StepEntry
from fieldkit.steps.scene import Scene
from fieldkit.steps.variants import Variants
from fieldkit.trial import columns

AIR_LOG: Final = ("air.pcap", "air.csv")
"""What a testbed's oracle may write into an attempt's folder (`Oracle.record_air`)."""

_RESERVED: Final = frozenset(
    {lateness.FILE, track.FILE, *AIR_LOG, *(name(role) for role in Role for name in (host.before, host.after))}
)
"""Files that are in every attempt's folder, whatever its steps are."""


Repeats = Annotated[Int, Field(gt=0, le=MOST_REPEATS)]
"""How often each protocol is measured."""


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
    repeats: Repeats
    attempts: Annotated[Int, Field(gt=0, le=1000)] = 3
    steps: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @schema.model_validator(mode="after")
    def _can_be_measured(self) -> "Procedure":
        """Refuse what would be measured wrongly, or not at all."""
        claimed, files, earlier = set[str](), set(_RESERVED), list[Step]()
        filled = set[str]()
        for placed in self.walk():
            step = placed.step
            if why := step.misplaced(earlier, placed.within):
                raise schema.complaint(why, *placed.at)
            for claim in step.claims():
                if claim in claimed:
                    what = f"{claim} comes twice, and a row has room for one; make two procedures"
                    raise schema.complaint(what, *placed.at)
                claimed.add(claim)
            for name in step.files():
                if name in files:
                    what = f"a file {name} is there already; give it another name, or make two procedures"
                    raise schema.complaint(what, *placed.at)
                files.add(name)
            for column in columns.of_step(step):
                if why := columns.clash(column, filled):
                    raise schema.complaint(why, *placed.at)
                filled.add(column.name)
            earlier.append(step)
        return self

    def walk(self) -> Iterator["PlacedStep"]:
        """Yield every step in the order in which it begins, also those inside others."""
        return _walk(self.steps, ("steps",), ())

    def scene(
        self, protocol: Protocol, cast: Cast, folder: str, variants: Mapping[Role, Variants] = MappingProxyType({})
    ) -> Scene:
        """Return what command lines and measures of one attempt depend on.

        Args:
            protocol: The transport protocol under test.
            cast: Who plays which role.
            folder: The attempt's folder on every robot.
            variants: The tools of each robot, as preflight found them.
        """
        recorded = {made.role: made for placed in self.walk() for made in placed.step.recorded(cast)}
        return Scene(protocol, cast, folder, recorded, variants)

    def roles(self) -> frozenset[Role]:
        """Return the roles that the steps need."""
        return frozenset().union(*(entry.step.roles() for entry in self.steps))

    def expected_s(self, protocol: Protocol) -> float:
        """Return about how many seconds one repeat takes on a good link."""
        return 0.5 + sum(entry.step.expected_s(protocol) for entry in self.steps)

    def with_record(self, duration_s: float) -> "Procedure":
        """Return this procedure with every recording `duration_s` long."""
        steps = tuple(StepEntry(entry.kind, entry.step.with_record(duration_s)) for entry in self.steps)
        return self.model_copy(update={"steps": steps})


@dataclass(frozen=True)
class PlacedStep:
    """A step where it stands in a procedure.

    Attributes:
        step: The step.
        kind: Its kind.
        within: The steps that it stands inside, the outermost first.
        at: Where it stands in the file.
    """

    step: Step
    kind: str
    within: tuple[Nest, ...]
    at: schema.Location

    @property
    def disturbed(self) -> bool:
        """Whether it may fail because of what it stands inside."""
        return any(nest.disturbs for nest in self.within)


def _walk(entries: tuple[StepEntry, ...], at: schema.Location, within: tuple[Nest, ...]) -> Iterator[PlacedStep]:
    for index, entry in enumerate(entries):
        here = (*at, index, entry.kind)
        yield PlacedStep(entry.step, entry.kind, within, here)
        if isinstance(entry.step, Nest):
            yield from _walk(entry.step.during, (*here, "during"), (*within, entry.step))


def load_procedure(name: str) -> Procedure:
    """Return the procedure `name`, the lab's own folder first.

    Raises:
        ConfigurationError: No such procedure (the nearest name is given), or an error in its file.
    """
    return catalog.load("procedures", name, Procedure)
