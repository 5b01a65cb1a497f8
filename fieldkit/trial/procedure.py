"""Procedures (`procedures/*.yaml`): the steps of a trial, which refer to robots by role."""

from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

from typing_extensions import override

from fieldkit.analysis.quantities import Quantity, quantities
from fieldkit.backends.protocols import Cast
from fieldkit.config import catalog, schema
from fieldkit.config.schema import Bool, Field, Int
from fieldkit.config.sections import Sectioned
from fieldkit.core import laptop_files, plugins
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import (
    FIXED_ROLES,
    LOOP,
    MAX_REPEATS,
    MAX_STEPS,
    Post,
    Protocol,
    Role,
    Scenario,
    Topology,
    sort_roles,
)
from fieldkit.measure.evidence import host, link_samples
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.capabilities import (
    ChecksPlacement,
    Listens,
    Moves,
    Records,
    ReducesSettings,
    SendsTraffic,
    WritesOnLaptop,
)
from fieldkit.steps.legs import PathLeg
from fieldkit.steps.nest import Nest, resolved, with_record
from fieldkit.steps.scene import RecordedFile, Scene
from fieldkit.steps.variants import Variants
from fieldkit.trial import columns, step_errors
from fieldkit.trial.procedure_section import ProcedureSection

if TYPE_CHECKING:
    from fieldkit.analysis.expectations import Expectation

_OVERHEAD_S: Final = 0.5
"""Estimated duration of the parts of a repeat that are not steps, for example the creation of folders."""

Repeats = Annotated[Int, Field(gt=0, le=MAX_REPEATS)]
"""Number of repeats per protocol."""


class Place(PathLeg):
    """Place of a robot in a role that the procedure defines, relative to a reference robot.

    Attributes:
        near: Role of the reference robot: `sender`, `receiver` or `relay`. At least one of `away`, `towards`, `left`
            and `right` is also required.
        away: Distance from the reference robot, which is the robot in the role `near`, in the direction away from the
            robot at the other end of its link (for the relay: away from the sender).
        towards: Distance from the reference robot, in the direction of the robot at the other end of its link.
        left: Distance from the reference robot to the left, seen by an observer who stands at the reference robot and
            looks in the direction of `away`. With `away: 3m` and `left: 4m`, the place is 5 m from the reference
            robot.
        right: Distance from the reference robot to the right, seen by the same observer.
    """

    noun: ClassVar[str] = "place"
    split_hint: ClassVar[str] = ""

    near: Role

    @schema.model_validator(mode="after")
    def _is_near_a_fixed_role(self) -> "Place":
        if self.near not in FIXED_ROLES:
            raise schema.validation_error(f"near must be one of: {', '.join(FIXED_ROLES)}", "near")
        return self


class Procedure(catalog.Named, Sectioned):
    """The steps of a repeat, by role: one YAML file in `procedures/`.

    Roles are `sender`, `receiver`, `relay`, and further roles for which the procedure gives places. See [add a
    procedure](add-a-procedure.md). Steps of a kind are distinguished by their `name`. Without names, a procedure can
    have at most one step of a kind, where `send` counts as a `transfer`. Exceptions are `record` and `capture` (one
    per robot), `fault` (one of each kind), `ask` (one per column), `wait` and `together` (any number). Files must
    have different names. Simultaneous steps must have different ports or different listening robots. Steps in one
    capture must differ in port, sender or receiver. A procedure that cannot be measured is rejected when it is
    loaded; the message contains the line.

    In `master`, sender and receiver are on opposite sides of the relay, and the distance is between each of them and
    the relay. In `masterless`, it is between sender and receiver. Protocols alternate from repeat to repeat, so that
    slow changes of the channel affect both equally.

    Attributes:
        scenario: `los` (line of sight), or `nlos`: the sender is behind a wall.
        topology: `master` or `masterless`; the command line may override it.
        protocols: List of `tcp`, `udp`; the command line may override it.
        repeats: Repeats per protocol; the command line may override it.
        attempts: Maximum number of attempts at a repeat; another attempt is made if an attempt is void.
        needs_ros_master: True if the procedure needs one ROS master for all robots. A site file without `ros_master`
            is then rejected.
        places: Positions of robots in additional roles, by role.
        expect: List of [expectations](values.md#expectations).
        steps: The steps of a repeat, in order; each entry has one key, the kind of step.
    """

    section_group = plugins.PROCEDURE_SECTIONS
    section_base = ProcedureSection

    scenario: Scenario
    topology: Topology
    protocols: Annotated[tuple[Protocol, ...], Field(min_length=1)]
    repeats: Repeats
    attempts: Annotated[Int, Field(gt=0, le=1000)] = 3
    needs_ros_master: Bool = Field(default=False, exclude_if=schema.is_empty)
    places: dict[Role, Place] = Field(default_factory=dict, exclude_if=schema.is_empty)
    expect: tuple[str, ...] = Field(default=(), exclude_if=schema.is_empty)
    steps: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @classmethod
    @override
    def expanded(cls, document: schema.Document) -> schema.Document:
        """Return the document with every `for:` expanded."""
        # Most procedures have no loops, and a document with few lines cannot exceed the maximum number of steps.
        if len(document.lines) <= MAX_STEPS and not document.has_key(LOOP):
            return document
        from fieldkit.config import loops  # noqa: PLC0415

        return loops.expand_loops(document, "steps")

    @schema.model_validator(mode="after")
    def _has_a_place_for_each_role(self) -> "Procedure":
        """Reject a role without a place: its name is probably misspelled."""
        known_roles = (*FIXED_ROLES, *self.places)
        for placed in self.walk():
            with step_errors.before_trial(f"{placed.label} cannot be planned"):
                roles = placed.step.roles()
            for role in sort_roles(roles - set(known_roles)):
                remedy = f"add a place for it: places: {{{role}: {{near: sender, left: 5m}}}}"
                raise schema.validation_error(
                    f"there is no role {role}; {did_you_mean(role, known_roles, remedy)}", *placed.at
                )
        for key, section in self.sections.items():
            for role in sort_roles(section.roles() - self.roles()):
                raise schema.validation_error(f"no step has the role {role}", key, role)
        for role in self.places:
            if role in FIXED_ROLES:
                raise schema.validation_error(
                    f"the place of the {role} is determined by the distance", "places", role
                )
            if role not in self.roles():
                raise schema.validation_error(f"no step has the role {role}", "places", role)
        return self

    @schema.model_validator(mode="after")
    def _can_be_measured(self) -> "Procedure":
        """Reject steps that would be measured incorrectly or not at all."""
        robot_files = (
            name(role)
            for role in self.roles()
            for name in (host.before_file, host.after_file, link_samples.robot_file)
        )
        used_resources, files, earlier_steps = set[tuple[str, str]](), set(robot_files), list[PlacedStep]()
        column_names = set[str]()
        for placed in self.walk():
            step = placed.step
            completed = [other.step for other in earlier_steps if not placed.runs_at_same_time_as(other)]
            with step_errors.before_trial(f"{placed.label} cannot be planned"):
                resources, file_names = step.exclusive_resources(), step.files()
                step_columns = columns.columns_of_step(step)
            if isinstance(step, ChecksPlacement) and (reason := step.placement_error(completed, placed.within)):
                raise schema.validation_error(reason, *placed.at)
            for resource in resources:
                if (step.prefix, resource) in used_resources:
                    raise schema.validation_error(_duplicate_resource_message(step, resource), *placed.at)
                used_resources.add((step.prefix, resource))
            for name in file_names:
                if reason := _file_conflict(step, name, files):
                    raise schema.validation_error(reason, *placed.at)
                files.add(name)
            if reason := next(filter(None, map(placed.port_conflict, earlier_steps)), None):
                raise schema.validation_error(reason, *placed.at, "port")
            for column in step_columns:
                if reason := columns.column_conflict(column, column_names):
                    raise schema.validation_error(reason, *placed.at)
                column_names.add(column.name)
            earlier_steps.append(placed)
        return self

    @schema.model_validator(mode="after")
    def _has_valid_expectations(self) -> "Procedure":
        for index in range(len(self.expect)):
            try:
                self._expectation(index)
            except ConfigurationError as error:
                raise schema.validation_error(f"{error.what}; {error.remedy}", "expect", index) from None
        return self

    @property
    def sections(self) -> Mapping[str, ProcedureSection]:
        """The sections that installed packages add, by key."""
        extra = self.model_extra or {}
        return {key: section for key, section in extra.items() if isinstance(section, ProcedureSection)}

    @property
    def expectations(self) -> "tuple[Expectation, ...]":
        """The expectations of the procedure."""
        return tuple(map(self._expectation, range(len(self.expect))))

    @property
    def figures(self) -> tuple[Quantity, ...]:
        """The quantities that can be aggregated over repeats, from the columns of the steps."""
        return quantities(columns.filled_columns(placed.step for placed in self.walk()))

    def _expectation(self, index: int) -> "Expectation":
        from fieldkit.analysis import expectations  # noqa: PLC0415 (few procedures have expectations)

        return expectations.parse(self.expect[index], self.figures)

    def walk(self) -> Iterator["PlacedStep"]:
        """Yield all steps in the order in which they start, including nested steps."""
        return _walk(self.steps, ("steps",), ())

    def _steps(self) -> Iterator[Step]:
        return (placed.step for placed in self.walk())

    def scene(
        self, protocol: Protocol, cast: Cast, folder: str, variants: Mapping[Role, Variants] = MappingProxyType({})
    ) -> Scene:
        """Return the inputs for the command lines and measurements of one attempt.

        Args:
            protocol: The transport protocol under test.
            cast: The robot in each role.
            folder: The attempt's folder on every robot.
            variants: The tools of each robot, as determined by the preflight checks.
        """
        recordings: dict[Role, tuple[RecordedFile, ...]] = {}
        for step in self._steps():
            for file in step.recordings(cast) if isinstance(step, Records) else ():
                recordings[file.role] = (*recordings.get(file.role, ()), file)
        scene = Scene(protocol, cast, folder, recordings, variants, sections=self.sections)
        senders = (step for step in self._steps() if isinstance(step, SendsTraffic))
        return replace(scene, flows=tuple(flow for step in senders for flow in step.flows(scene)))

    def roles(self) -> frozenset[Role]:
        """Return the roles that the steps need."""
        return frozenset().union(*(entry.step.roles() for entry in self.steps))

    def moved_roles(self) -> frozenset[Role]:
        """Return the roles of the robots that steps move."""
        return frozenset().union(*(step.moves() for step in self._steps() if isinstance(step, Moves)))

    @property
    def posts(self) -> tuple[Post, ...]:
        """The places of robots in roles that the procedure defines."""
        return tuple(Post(role, place.near, place.leg) for role, place in self.places.items())

    def expected_s(self, protocol: Protocol) -> float:
        """Return the estimated duration of one repeat on a good link, in seconds."""
        return _OVERHEAD_S + sum(entry.step.expected_s(protocol) for entry in self.steps)

    def with_record(self, duration_s: float) -> "Procedure":
        """Return this procedure with the duration `duration_s` for every recording."""
        steps = tuple(with_record(entry, duration_s) for entry in self.steps)
        return self.model_copy(update={"steps": steps})

    def resolved(self, cast: Cast) -> "Procedure":
        """Return this procedure with robot-specific values filled in, for example a maximum speed."""
        steps = tuple(resolved(entry, cast) for entry in self.steps)
        return self.model_copy(update={"steps": steps})

    def adjustments(self, cast: Cast) -> Iterator[str]:
        """Yield a sentence for each value of a step that `resolved` reduces."""
        reducing = (step for step in self._steps() if isinstance(step, ReducesSettings))
        return (line for step in reducing for line in step.adjustments(cast))


@dataclass(frozen=True)
class PlacedStep:
    """A step and its position in a procedure.

    Attributes:
        step: The step.
        kind: Kind of the step.
        within: The steps that contain this step, the outermost first.
        at: Location of the step in the file.
    """

    step: Step
    kind: str
    within: tuple[Nest, ...]
    at: schema.Location

    @property
    def disturbed(self) -> bool:
        """True if the step may fail because a step that contains it, such as a fault, disturbs it."""
        return any(nest.disturbs for nest in self.within)

    @property
    def label(self) -> str:
        """Description of the step, for example `the step transfer up`."""
        return " ".join(filter(None, ("the step", self.kind, self.step.prefix)))

    def port_conflict(self, other: "PlacedStep") -> str | None:
        """Return the reason why an earlier step conflicts with the ports of this step, or None.

        Only one program at a time can listen on a port of a robot. In one capture, packets are distinguished by the
        two robots and the port.
        """
        is_simultaneous = self.runs_at_same_time_as(other) or any(nest is other.step for nest in self.within)
        is_captured = any(nest.captures() and any(nest is around for around in other.within) for nest in self.within)
        if not (isinstance(self.step, Listens) and isinstance(other.step, Listens)):
            return None
        for listener, other_listener in product(self.step.listens(), other.step.listens()):
            is_exclusive = not (listener.shared and other_listener.shared)
            if (
                is_simultaneous
                and is_exclusive
                and (listener.role, listener.port) == (other_listener.role, other_listener.port)
            ):
                conflict = f"port {listener.port} is used twice at the same time on {listener.role}"
                return f"{conflict}; change the {listener.by} of one of them"
            if is_captured and listener.is_ambiguous_with(other_listener):
                conflict = (
                    f"port {listener.port} is used twice in one capture, from {listener.peer} to {listener.role}"
                )
                return f"{conflict}; change the {listener.by} of one of them, or use separate captures"
        return None

    def runs_at_same_time_as(self, other: "PlacedStep") -> bool:
        """Return True if an earlier step runs at the same time as this step, and neither contains the other."""
        # Compare the nested steps around both steps, from the outermost step. `fork` is the depth of the first
        # difference. The steps run at the same time if the last common step runs its inner steps in parallel.
        paths = zip((*self.within, self.step), (*other.within, other.step), strict=False)
        fork = next((index for index, (step, other_step) in enumerate(paths) if step is not other_step), 0)
        return fork > 0 and self.within[fork - 1].parallel


def _file_conflict(step: Step, name: str, files: Set[str]) -> str | None:
    """Return the reason why a step cannot have a file of this name, or None if it can."""
    laptop_names = step.laptop_files() if isinstance(step, WritesOnLaptop) else ()
    if laptop_files.is_reserved(name) and name not in laptop_names:
        return f"only the laptop writes a file {name}; choose another file name"
    return (
        f"another step has a file {name}; choose another name of the file or of the step" if name in files else None
    )


def _duplicate_resource_message(step: Step, resource: str) -> str:
    """Return the message for two steps with the same name that use the same exclusive resource."""
    if step.prefix:
        return (
            f"{resource} named {step.prefix} is defined twice; rename one of them. In a loop, add the variable of "
            "for: to the name"
        )
    return (
        f"{resource} is defined twice; give each of them another name. In a loop, add the variable of for: to the "
        "name, for example name: p{bytes}"
    )


def _walk(entries: tuple[StepEntry, ...], at: schema.Location, within: tuple[Nest, ...]) -> Iterator[PlacedStep]:
    for index, entry in enumerate(entries):
        location = (*at, index, entry.kind)
        yield PlacedStep(entry.step, entry.kind, within, location)
        if isinstance(entry.step, Nest):
            yield from _walk(entry.step.during, (*location, "during"), (*within, entry.step))


def load_procedure(name: str) -> Procedure:
    """Return the procedure `name`; the lab's folder is searched first.

    Raises:
        ConfigurationError: There is no such procedure, or its file has an error.
    """
    return catalog.load("procedures", name, Procedure)


def read_procedure(path: Path) -> Procedure:
    """Return the procedure in the file `path`, which can be in any folder.

    Raises:
        ConfigurationError: The file cannot be read, or has an error.
    """
    return catalog.validate_named(schema.read(path), Procedure, path.stem)
