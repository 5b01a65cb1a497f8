"""Procedures (`procedures/*.yaml`) -> frozen objects: the scripted steps of a trial, spoken of in roles."""

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from typing_extensions import override

from fieldkit.analysis import expectations
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.quantities import Quantity, quantities
from fieldkit.backends.protocols import Cast
from fieldkit.config import catalog, loops, schema
from fieldkit.config.schema import Bool, Field, Int
from fieldkit.core import laptop_files
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import FIXED_ROLES, MOST_REPEATS, OnAbort, Post, Protocol, Role, Scenario, Topology, in_order
from fieldkit.measure.evidence import host, link_samples
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.kinds.move import PathLeg
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import RecordedFile, Scene
from fieldkit.steps.variants import Variants
from fieldkit.trial import columns

Repeats = Annotated[Int, Field(gt=0, le=MOST_REPEATS)]
"""How often each protocol is measured."""


class Place(PathLeg):
    """Place of a robot in a role of the procedure's own; its directions are those of a piece of a way.

    Attributes:
        near: The robot under test that the position is relative to: `sender`, `receiver` or `relay`. At least one of
            the four directions is required.
    """

    near: Role

    @schema.model_validator(mode="after")
    def _near_one_under_test(self) -> "Place":
        if self.near not in FIXED_ROLES:
            raise schema.complaint(f"near is one of: {', '.join(FIXED_ROLES)}", "near")
        return self


class Procedure(catalog.Named):
    """The steps of a repeat, by role: one YAML file in `procedures/`.

    Roles are `sender`, `receiver`, `relay`, and others that the procedure places. How to write one: [add a
    procedure](add-a-procedure.md). Steps of a kind are distinguished by their `name`: without one, a procedure has at
    most one `transfer` and one `ping`, one `record`, one `capture` and one `move` per robot, and one `fault` of a
    kind. Files must have different names; simultaneous steps need different ports or different listening robots;
    steps in one capture must differ in port, sender or receiver. A procedure that cannot be measured is refused when
    it is loaded, with its line.

    In `master` the distance is between each station and the relay, with the stations on opposite sides; in
    `masterless` it is between sender and receiver. Protocols alternate from repeat to repeat, so that slow changes of
    the channel affect both equally.

    Attributes:
        scenario: `los`, or `nlos`: the sender is behind a wall.
        topology: `master` or `masterless`; the command line may override it.
        protocols: List of `tcp`, `udp`; the command line may override it.
        repeats: Repeats per protocol; the command line may override it.
        attempts: Maximum number of attempts at a repeat whose evidence is not whole.
        needs_ros_master: Whether it needs one ROS master for all robots; a site file without `ros_master` is then
            refused.
        places: Positions of robots in additional roles, by role.
        on_abort: What a drone does when a repeat is aborted, by role: `land` where it is, or `return`; see
            [MAVLink](mavlink.md#where-a-trial-is-cut-short).
        expect: List of [expectations](values.md#expectations).
        steps: The steps of a repeat, in order; each entry has one key, the kind of step.
    """

    scenario: Scenario
    topology: Topology
    protocols: Annotated[tuple[Protocol, ...], Field(min_length=1)]
    repeats: Repeats
    attempts: Annotated[Int, Field(gt=0, le=1000)] = 3
    needs_ros_master: Bool = Field(default=False, exclude_if=schema.is_empty)
    places: dict[Role, Place] = Field(default_factory=dict, exclude_if=schema.is_empty)
    on_abort: dict[Role, OnAbort] = Field(default_factory=dict, exclude_if=schema.is_empty)
    expect: tuple[str, ...] = Field(default=(), exclude_if=schema.is_empty)
    steps: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @classmethod
    @override
    def written_out(cls, document: schema.Document) -> schema.Document:
        """Every `for:`."""
        return loops.written_out(document, "steps")

    @schema.model_validator(mode="after")
    def _has_a_place_for_everybody(self) -> "Procedure":
        """Refuse a role that nothing says the place of, most likely one that is not spelled right."""
        known = (*FIXED_ROLES, *self.places)
        for placed in self.walk():
            for role in in_order(placed.step.roles() - set(known)):
                say = f"say where it stands: places: {{{role}: {{near: sender, left: 5m}}}}"
                raise schema.complaint(f"there is no role {role}; {nearest(role, known, say)}", *placed.at)
        for role in self.on_abort:
            if role not in self.roles():
                raise schema.complaint(f"no step has the role {role}", "on_abort", role)
        for role in self.places:
            if role in FIXED_ROLES:
                raise schema.complaint(f"where the {role} stands the distance says", "places", role)
            if role not in self.roles():
                raise schema.complaint(f"no step has the role {role}", "places", role)
        return self

    @schema.model_validator(mode="after")
    def _can_be_measured(self) -> "Procedure":
        """Refuse what would be measured wrongly, or not at all."""
        of_robots = (name(role) for role in self.roles() for name in (host.before, host.after, link_samples.file))
        claimed, files, earlier = set[tuple[str, str]](), set(of_robots), list[PlacedStep]()
        filled = set[str]()
        for placed in self.walk():
            step = placed.step
            before = [one.step for one in earlier if not placed.is_beside(one)]
            if why := step.placement_error(before, placed.within):
                raise schema.complaint(why, *placed.at)
            for claim in step.exclusive_resources():
                if (step.prefix, claim) in claimed:
                    raise schema.complaint(_twice(step, claim), *placed.at)
                claimed.add((step.prefix, claim))
            for name in step.files():
                if why := _taken(step, name, files):
                    raise schema.complaint(why, *placed.at)
                files.add(name)
            if why := next(filter(None, map(placed.taken_for, earlier)), None):
                raise schema.complaint(why, *placed.at, "port")
            for column in columns.of_step(step):
                if why := columns.clash(column, filled):
                    raise schema.complaint(why, *placed.at)
                filled.add(column.name)
            earlier.append(placed)
        return self

    @schema.model_validator(mode="after")
    def _expects_what_it_measures(self) -> "Procedure":
        for index in range(len(self.expect)):
            try:
                self._expectation(index)
            except ConfigurationError as error:
                raise schema.complaint(f"{error.what}; {error.remedy}", "expect", index) from None
        return self

    @property
    def expectations(self) -> tuple[Expectation, ...]:
        """What is demanded of its figures."""
        return tuple(map(self._expectation, range(len(self.expect))))

    @property
    def figures(self) -> tuple[Quantity, ...]:
        """The figures that repeats make of what its steps measure."""
        return quantities(columns.filled_by(placed.step for placed in self.walk()))

    def _expectation(self, index: int) -> Expectation:
        return expectations.parse(self.expect[index], self.figures)

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
        recorded: dict[Role, tuple[RecordedFile, ...]] = {}
        for placed in self.walk():
            for made in placed.step.recorded(cast):
                recorded[made.role] = (*recorded.get(made.role, ()), made)
        scene = Scene(protocol, cast, folder, recorded, variants, on_abort=self.on_abort)
        return replace(scene, flows=tuple(flow for placed in self.walk() for flow in placed.step.flows(scene)))

    def roles(self) -> frozenset[Role]:
        """Return the roles that the steps need."""
        return frozenset().union(*(entry.step.roles() for entry in self.steps))

    def moved(self) -> frozenset[Role]:
        """Return the roles whose robots steps move."""
        return frozenset().union(*(placed.step.moves() for placed in self.walk()))

    @property
    def posts(self) -> tuple[Post, ...]:
        """The places of robots in roles of its own."""
        return tuple(Post(role, place.near, place.leg) for role, place in self.places.items())

    def expected_s(self, protocol: Protocol) -> float:
        """Return about how many seconds one repeat takes on a good link."""
        return 0.5 + sum(entry.step.expected_s(protocol) for entry in self.steps)

    def with_record(self, duration_s: float) -> "Procedure":
        """Return this procedure with every recording `duration_s` long."""
        steps = tuple(StepEntry(entry.kind, entry.step.with_record(duration_s)) for entry in self.steps)
        return self.model_copy(update={"steps": steps})

    def resolved(self, cast: Cast) -> "Procedure":
        """Return this procedure with what its steps leave to their robots filled in."""
        steps = tuple(StepEntry(entry.kind, entry.step.resolved(cast)) for entry in self.steps)
        return self.model_copy(update={"steps": steps})

    def adjustments(self, cast: Cast) -> Iterator[str]:
        """Yield in words of what `fitted` makes less than the steps say."""
        return (line for entry in self.steps for line in entry.step.adjustments(cast))


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

    @property
    def called(self) -> str:
        """The step in words: `the step transfer up`."""
        return " ".join(filter(None, ("the step", self.kind, self.step.prefix)))

    def taken_for(self, other: "PlacedStep") -> str | None:
        """Return why an earlier step leaves it no port of its own, or none that tells their packets apart, or None.

        A port of a robot takes one listener at a time. In one capture packets are told by both robots and the port.
        """
        at_once = self.is_beside(other) or any(nest is other.step for nest in self.within)
        captured = any(nest.captures() and any(nest is around for around in other.within) for nest in self.within)
        for mine, theirs in product(self.step.listens(), other.step.listens()):
            alone = not (mine.shared and theirs.shared)
            if at_once and alone and (mine.role, mine.port) == (theirs.role, theirs.port):
                return f"port {mine.port} comes twice at the same time on {mine.role}; give one another {mine.by}"
            if captured and mine.looks_like(theirs):
                what = f"port {mine.port} comes twice in one capture, from {mine.peer} to {mine.role}"
                return f"{what}; give one another {mine.by}, or each a capture of its own"
        return None

    def is_beside(self, other: "PlacedStep") -> bool:
        """Return whether an earlier step runs at the same time, neither inside the other."""
        ways = zip((*self.within, self.step), (*other.within, other.step), strict=False)
        parts = next((index for index, (mine, theirs) in enumerate(ways) if mine is not theirs), 0)
        return parts > 0 and self.within[parts - 1].parallel


def _taken(step: Step, name: str, files: Set[str]) -> str | None:
    """Return why a step cannot have a file of this name, None if it can."""
    if laptop_files.reserved(name) and name not in step.laptop_files():
        return f"only the laptop writes a file {name}; give it another name"
    return f"a file {name} is there already; give it, or its step, another name" if name in files else None


def _twice(step: Step, claim: str) -> str:
    """Return what is wrong where a step has what another of its name has."""
    if step.prefix:
        return f"{claim} named {step.prefix} comes twice; give one another name, inside for: one with its variable"
    return f"{claim} comes twice; tell them apart by name:, inside for: one with its variable, name: p{{bytes}}"


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


def read_procedure(path: Path) -> Procedure:
    """Return the procedure in a file, wherever that is.

    Raises:
        ConfigurationError: It cannot be read, or has an error.
    """
    return catalog.named(schema.read(path), Procedure, path.stem)


def expecting(procedures: Sequence[Procedure], text: str) -> list[Procedure]:
    """Return procedures of which those that measure the figure expect something of it, beside what they expect.

    Args:
        procedures: Some.
        text: The expectation.

    Raises:
        ConfigurationError: It is none, or of a figure that none of them measures.
    """
    wanted = expectations.parse(text, (figure for procedure in procedures for figure in procedure.figures)).quantity
    return [
        procedure.model_copy(update={"expect": (*procedure.expect, text)})
        if wanted in {figure.name for figure in procedure.figures}
        else procedure
        for procedure in procedures
    ]
