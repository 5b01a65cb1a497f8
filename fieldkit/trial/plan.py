"""The frozen inputs of a trial: the content of `trial.yaml`, and the columns of its table."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Final

from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.config.profiles import TELEMETRY
from fieldkit.config.schema import Field, Int, Number, Strict
from fieldkit.core import laptop_files
from fieldkit.core.columns import Column
from fieldkit.core.model import Distance, Placement, Protocol, RepeatId, Role, Topology
from fieldkit.steps.capabilities import DescribesActions, HasRefusals, Moves
from fieldkit.steps.scene import Planned, PutProgram, Refusal, Scene
from fieldkit.steps.variants import Variants
from fieldkit.trial import step_errors
from fieldkit.trial.columns import additional_columns, trial_columns
from fieldkit.trial.frozen import Columns
from fieldkit.trial.procedure import Procedure, Repeats
from fieldkit.trial.procedure_section import ProcedureSection
from fieldkit.trial.step_packages import StepPackage

PLAN_FILE: Final = laptop_files.PLAN


def simulators_text(simulators: Mapping[str, str]) -> str:
    """Return the simulators of a backend as text, such as `physics mujoco, network ns3`; empty without simulators."""
    return ", ".join(f"{purpose} {name}" for purpose, name in simulators.items())


class Plan(Strict):
    """A trial's frozen inputs.

    Attributes:
        schema_version: Version of the CSV columns when the trial was planned; each row has the version that was
            used for its measurement.
        trial: Name of the trial and of its folder.
        versions: Versions of fieldkit, Python, packages for measurements, and packages that add steps or backends.
        code_sha256: First 16 digits of the hash of fieldkit's source.
        profiles_sha256: First 16 digits of the hash of the profiles and roles of the cast.
        procedure_sha256: First 16 digits of the hash of the procedure, without its expectations.
        backend: Name of the backend.
        session: ID of the run of fieldkit that started the trial. The locks on the robots contain it, and a resumed
            trial uses it again.
        seed: Seed of all random numbers.
        notes: Notes of the operator.
        topology: Topology.
        distance: Distance as written by the operator.
        distance_m: Distance in metres.
        protocols: Protocols under test.
        repeats: Repeats per protocol.
        record_s: Duration of every recording in seconds, if the operator gave one; the procedure contains it.
        cast: The robot in each role.
        procedure: The procedure.
        lab_bytes: Maximum number of bytes that the testbed itself adds to an attempt, such as data of an emulator.
        simulators: Physics, network and sync policy of a backend that simulates them; otherwise empty.
        step_packages: The package of each kind of step that does not ship with fieldkit.
        radios: Channel and regulatory domain of each robot's radio at the start, which must not change during the
            trial; empty if they are unknown.
        columns: Columns of the trial's table that not every trial has; None if the trial was planned by an earlier
            version of fieldkit, which did not store them.
    """

    schema_version: Int
    trial: Annotated[str, Field(pattern=r"^[0-9A-Za-z][^/\x00]*$")]
    versions: dict[str, str]
    code_sha256: str
    profiles_sha256: str
    procedure_sha256: str
    backend: str
    session: str
    seed: Int
    notes: str
    topology: Topology
    distance: str
    distance_m: Number
    protocols: tuple[Protocol, ...]
    repeats: Repeats
    record_s: Number | None = Field(default=None, exclude_if=schema.is_empty)
    cast: dict[Role, Robot]
    procedure: Procedure
    lab_bytes: Int = 0
    simulators: dict[str, str] = Field(default_factory=dict, exclude_if=schema.is_empty)
    step_packages: dict[str, StepPackage] = Field(default_factory=dict, exclude_if=schema.is_empty)
    radios: dict[Role, dict[str, str]] = Field(default_factory=dict, exclude_if=schema.is_empty)
    columns: Columns | None = None

    @property
    def backend_with_simulators(self) -> str:
        """Name of the backend with its simulators, if it has any. Trials with other simulators are not comparable."""
        return f"{self.backend} ({simulators_text(self.simulators)})" if self.simulators else self.backend

    @cached_property
    def table(self) -> tuple[Column, ...]:
        """The columns of the trial's trial.csv, in order."""
        if self.columns is None:
            return trial_columns(additional_columns(placed.step for placed in self.procedure.walk()))
        return trial_columns(frozen.column for frozen in self.columns)

    def repeats_in_order(self) -> Iterator[RepeatId]:
        """Yield the planned repeats. Protocols alternate, so that slow changes of the channel affect both equally."""
        return (RepeatId(protocol, number + 1) for number in range(self.repeats) for protocol in self.protocols)

    def overrides(self) -> Iterator[tuple[str, str]]:
        """Yield the options of `fieldkit trial` that replaced settings of the procedure, each with its value."""
        if self.topology is not self.procedure.topology:
            yield "--topology", self.topology
        if self.protocols != self.procedure.protocols:
            yield from (("--protocol", protocol) for protocol in self.protocols)
        if self.repeats != self.procedure.repeats:
            yield "--repeats", str(self.repeats)
        if self.record_s is not None:
            yield "--record", f"{self.record_s:.9g}s"

    @property
    def placement(self) -> Placement:
        """Placement of the robots."""
        distance = Distance(self.distance_m, self.distance)
        return Placement(self.procedure.scenario, self.topology, distance, self.procedure.posts)

    def with_note(self, note: str) -> "Plan":
        """Return this plan with a note of the operator appended; an empty note adds nothing."""
        return self.model_copy(update={"notes": "; ".join(filter(None, (self.notes, note)))})

    def scene(self, repeat: RepeatId, folder: str, variants: Mapping[Role, Variants] = MappingProxyType({})) -> Scene:
        """Return the inputs for the command lines of one attempt. `variants` are the tools of each robot."""
        scene = self.procedure.scene(repeat.protocol, self.cast, folder, variants)
        return replace(scene, placement=self.placement, repeat=repeat.number)

    def scenes(self, variants: Mapping[Role, Variants] = MappingProxyType({})) -> tuple[Scene, ...]:
        """Return a scene for each protocol. It is used for values that are the same in all repeats of a protocol."""
        return tuple(self.procedure.scene(protocol, self.cast, "check", variants) for protocol in self.protocols)

    def jobs(self, scene: Scene) -> Iterator[Planned]:
        """Yield all jobs of one attempt in the order in which they start."""
        for entry in self.procedure.steps:
            with step_errors.before_trial(f"the commands of the step {entry.kind} cannot be derived"):
                planned_jobs = tuple(entry.step.jobs(scene))
            yield from planned_jobs

    def program_copies(self) -> tuple[PutProgram, ...]:
        """Return the programs of the lab that are copied to robots in every attempt."""
        planned_jobs = (job for scene in self.scenes() for job in self.jobs(scene))
        return tuple(dict.fromkeys(job.put for job in planned_jobs if job.put is not None))

    def refusals(self, variants: Mapping[Role, Variants]) -> tuple[Refusal, ...]:
        """Return the parts of the procedure that cannot work with the robots' tools, without duplicates."""
        steps = [placed.step for placed in self.procedure.walk() if isinstance(placed.step, HasRefusals)]
        step_refusals = (
            refusal for scene in self.scenes(variants) for step in steps for refusal in step.refusals(scene)
        )
        section_refusals = (refusal for section in self._sections() for refusal in section.refusals(self))
        return tuple(dict.fromkeys((*step_refusals, *section_refusals, *self._telemetry_refusals())))

    def _telemetry_refusals(self) -> Iterable[Refusal]:
        cast = telemetry_cast(self)
        if not cast:
            return ()
        from fieldkit.telemetry import telemetry_queries  # noqa: PLC0415 (few profiles have sources)

        return telemetry_queries.refusals(cast, self.cast)

    def _sections(self) -> Iterable[ProcedureSection]:
        return self.procedure.sections.values()

    def dry_run_notes(self, scene: Scene) -> tuple[str, ...]:
        """Return sentences about the actions of one repeat that are not commands on robots."""
        section_notes = (line for section in self._sections() for line in section.dry_run_notes(self))
        steps = (placed.step for placed in self.procedure.walk() if isinstance(placed.step, DescribesActions))
        return (*section_notes, *(line for step in steps for line in step.dry_run_notes(scene)))

    def abort_notes(self, scene: Scene) -> tuple[str, ...]:
        """Return a sentence about the reaction of each robot that moves automatically if a repeat is aborted."""
        section_notes = (line for section in self._sections() for line in section.abort_notes(self))
        steps = (placed.step for placed in self.procedure.walk() if isinstance(placed.step, Moves))
        return (*section_notes, *(line for step in steps for line in step.abort_notes(scene)))


def telemetry_cast(plan: Plan) -> dict[Role, Robot]:
    """Return the robots of the procedure whose profiles have telemetry sources."""
    roles = sorted(plan.procedure.roles() & plan.cast.keys())
    return {role: plan.cast[role] for role in roles if TELEMETRY in plan.cast[role].profile.sections}
