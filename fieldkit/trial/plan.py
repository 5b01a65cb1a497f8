"""The frozen inputs of a trial: what `trial.yaml` holds, and all that its CSV needs beside journal and evidence."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Final

from fieldkit.analysis import claims
from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.config.schema import Field, Int, Number, Strict
from fieldkit.core import laptop_files
from fieldkit.core.columns import Column
from fieldkit.core.model import Distance, Placement, Protocol, RepeatId, Role, Topology
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import Pinging, Planned, PutProgram, Refusal, Scene
from fieldkit.steps.variants import Variants
from fieldkit.trial.columns import of_steps, trial_columns
from fieldkit.trial.frozen import Columns
from fieldkit.trial.procedure import Procedure, Repeats
from fieldkit.trial.step_packages import StepPackage

PLAN_FILE: Final = laptop_files.PLAN


class Plan(Strict):
    """A trial's frozen inputs.

    Attributes:
        schema_version: Version of the CSV columns when it was planned; a row has that of who measured it.
        trial: Name of the trial, and of its folder.
        versions: Versions of fieldkit, Python, the packages that measure, and those that add steps or backends.
        code_sha256: Hash over fieldkit's source.
        profiles_sha256: Hash over the profiles of the cast.
        procedure_sha256: Hash of the procedure.
        backend: Where the robots came from.
        session: Names the run of fieldkit on the robots' locks; a resumed trial takes its own again.
        seed: Seed of everything random.
        notes: The operator's.
        topology: Topology.
        distance: As the operator wrote it.
        distance_m: In metres.
        protocols: Protocols under test.
        repeats: Repeats per protocol.
        cast: Who plays which role.
        procedure: What is done.
        lab_bytes: How many bytes the lab itself adds to an attempt at most.
        step_packages: The package of each kind of step that does not ship with fieldkit.
        columns: What its steps measure beside the columns of every trial; None where they measure nothing else, or
            an earlier fieldkit planned it.
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
    cast: dict[Role, Robot]
    procedure: Procedure
    lab_bytes: Int = 0
    step_packages: dict[str, StepPackage] = Field(default_factory=dict, exclude_if=schema.is_empty)
    columns: Columns | None = None

    @cached_property
    def table(self) -> tuple[Column, ...]:
        """The columns of the trial's trial.csv, in order."""
        if self.columns is None:
            return trial_columns(of_steps(placed.step for placed in self.procedure.walk()))
        return trial_columns(frozen.column for frozen in self.columns)

    def order(self) -> Iterator[RepeatId]:
        """Yield the planned repeats; protocols alternate, so that a slow change of the air meets each alike."""
        return (RepeatId(protocol, number + 1) for number in range(self.repeats) for protocol in self.protocols)

    @property
    def placement(self) -> Placement:
        """Placement of the robots."""
        distance = Distance(self.distance_m, self.distance)
        return Placement(self.procedure.scenario, self.topology, distance, self.procedure.posts)

    def with_note(self, note: str) -> "Plan":
        """Return this plan with one more note of the operator's; an empty one adds nothing."""
        return self.model_copy(update={"notes": "; ".join(filter(None, (self.notes, note)))})

    def scene(self, repeat: RepeatId, folder: str, variants: Mapping[Role, Variants] = MappingProxyType({})) -> Scene:
        """Return what the command lines of one attempt depend on; `variants` as preflight found them."""
        scene = self.procedure.scene(repeat.protocol, self.cast, folder, variants)
        return replace(scene, placement=self.placement, repeat=repeat.number)

    def scenes(self, variants: Mapping[Role, Variants] = MappingProxyType({})) -> tuple[Scene, ...]:
        """Return a scene per protocol, for what holds for all of its repeats."""
        return tuple(self.procedure.scene(protocol, self.cast, "check", variants) for protocol in self.protocols)

    def jobs(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job of one attempt in the order in which it starts."""
        for entry in self.procedure.steps:
            yield from entry.step.jobs(scene)

    def puts(self) -> tuple[PutProgram, ...]:
        """Return the programs of the lab that every attempt copies to robots."""
        planned = (job for scene in self.scenes() for job in self.jobs(scene))
        return tuple(dict.fromkeys(job.put for job in planned if job.put is not None))

    def refusals(self, variants: Mapping[Role, Variants]) -> tuple[Refusal, ...]:
        """Return what of the procedure cannot work with the tools that the robots have, each once."""
        scenes, steps = self.scenes(variants), self.procedure.steps
        found = (refusal for scene in scenes for entry in steps for refusal in entry.step.refusals(scene))
        return tuple(dict.fromkeys((*found, *self._out_of_reach())))

    def _out_of_reach(self) -> Iterator[Refusal]:
        """Yield which robots nothing could bring down."""
        for role in self.procedure.on_abort:
            if self.cast[role].profile.mavlink is None:
                why = "on_abort is to bring it down, and its profile has no mavlink"
                yield Refusal(role, why, f"leave {role} out of on_abort, or take a drone")

    def shortfalls(self) -> Iterator[str]:
        """Yield what its expectations need and it does not have, in words."""
        return claims.shortfalls(self.procedure.expectations, self.procedure.figures, self.repeats)

    def dry_run_notes(self, scene: Scene) -> tuple[str, ...]:
        """Return what the testbed does beside the commands of one repeat, in words."""
        on_abort = self.procedure.on_abort.items()
        drones = (f"where it is cut short: {self.cast[role].name} is told to {how}" for role, how in on_abort)
        return (*drones, *(line for entry in self.procedure.steps for line in entry.step.dry_run_notes(scene)))

    def abort_notes(self, scene: Scene) -> tuple[str, ...]:
        """Return in words what each robot does that moves by itself where a repeat is stopped at once."""
        watched = (role for role in self.procedure.on_abort if role not in self.procedure.moved())
        told = (f"{self.cast[role].name} is told to {self.procedure.on_abort[role]}" for role in watched)
        return (*told, *(line for entry in self.procedure.steps for line in entry.step.abort_notes(scene)))

    def transfers(self, protocol: Protocol) -> tuple[Transfer, ...]:
        """Return what tells the packets of each transfer, in the order in which they begin."""
        scene = self.procedure.scene(protocol, self.cast, "")
        transfers = (placed.step.transfer(scene, placed.within) for placed in self.procedure.walk())
        return tuple(transfer for transfer in transfers if transfer is not None)

    def pingings(self) -> tuple[Pinging, ...]:
        """Return all round-trip times of a repeat, in the order in which they begin."""
        pingings = (placed.step.pinging() for placed in self.procedure.walk())
        return tuple(pinging for pinging in pingings if pinging is not None)

    def captures(self) -> Mapping[str, Role]:
        """Return whose robot makes each capture, by its file."""
        nests = (placed.step for placed in self.procedure.walk() if isinstance(placed.step, Nest))
        found = [(file, role) for nest in nests for role, file in nest.captures().items()]
        return {file: role for role in self.cast for file, of in found if of == role}

    def bags(self) -> Mapping[Role, str]:
        """Return the first file that is recorded on each robot, by its name below an attempt's folder."""
        scene = self.procedure.scene(self.protocols[0], self.cast, "")
        return {role: made[0].name for role, made in scene.recorded.items()}
