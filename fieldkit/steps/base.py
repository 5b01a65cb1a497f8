"""The contract of a step: its YAML keys, jobs, requirements, files, checks and columns."""

from abc import ABC
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import EntryPoint
from inspect import isabstract
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.config import schema
from fieldkit.config.schema import CoreSchema, Field, Strict
from fieldkit.core import plugins
from fieldkit.core.columns import Column, Measured, Value, step_prefixed
from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.lazy_mapping import LazyMapping
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.remote import jobs
from fieldkit.steps import kinds
from fieldkit.steps.scene import Announce, Flow, ListeningPort, Need, Pinging, Planned, RecordedFile, Refusal, Scene
from fieldkit.steps.view import View

if TYPE_CHECKING:
    from fieldkit.steps.nest import Nest

StepName = Annotated[
    str,
    schema.pattern_field(
        r"^[a-z][a-z0-9_]{0,30}$", "a name: small letters, digits and _, a small letter first, 31 in all"
    ),
]
"""Name of a step or a bag."""
FileName = Annotated[
    str,
    schema.pattern_field(
        r"^[a-z][a-z0-9_.-]{0,40}$", "the name of a file: small letters, digits, _ . and -, 41 in all"
    ),
]
"""Name of a file in the folder of an attempt."""


class Step(Strict, ABC):
    """One action of a procedure.

    Its fields are its YAML keys. Plans, preflight, gates, rows and reports call the methods below and contain no name
    of a kind. A kind usually defines `jobs`, `check` and `measure`; every method has a default. A kind that runs one
    program is a `fieldkit.steps.program.ProgramStep`, which needs two methods.

    `jobs` is pure: `--dry-run` prints it, tests compare it with golden lines, and `run` starts the same jobs. To add
    a kind, write its module and name its class in `fieldkit.steps.kinds`, or in an entry point of the group
    `fieldkit.steps`.

    Attributes:
        columns: Columns that steps of its kind measure.
        cross_checks: Sources of these columns, and the checks between them.
        kept_bytes: Bytes of each frame that a capture must keep for the step; 0 if headers are enough.
        capture_buffer_kib: Kernel buffer that a capture needs for the step's packets; 0 if the default is enough.
        needs_complete_capture: Whether packets that a capture dropped make the step's figures wrong. If not, the step
            withholds the columns that depend on captures.
        name: Letters, digits and `_`, a lower-case letter first; distinguishes the step from others of its kind.
            Names of its jobs, files and columns begin with it.
    """

    columns: ClassVar[tuple[Column, ...]] = ()
    cross_checks: ClassVar[tuple[CrossCheck, ...]] = ()
    kept_bytes: ClassVar[int] = 0
    capture_buffer_kib: ClassVar[int] = 0
    needs_complete_capture: ClassVar[bool] = True

    name: StepName = Field(default="", exclude_if=schema.is_empty)

    @property
    def prefix(self) -> str:
        """Prefix of the names of its jobs, files and columns; empty if they have none."""
        return self.name

    def prefixed_name(self, what: str) -> str:
        """Return the name of a job or file of the step: `up.recv.bag`, or `recv.bag` for a step without a name."""
        return step_prefixed(self.prefix, what)

    @classmethod
    def kind_name(cls) -> str:
        """Return the class name in lower case without `Step`, a part of names of jobs and files."""
        return cls.__name__.removesuffix("Step").lower()

    # Execution.

    def jobs(self, scene: Scene) -> Iterator[Planned]:  # noqa: ARG002 (some steps need no robot)
        """Yield every job in the order in which it starts."""
        return iter(())

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Carry out the step. By default each job starts when the previous one has exited with code 0.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A job failed.
        """
        for planned in self.jobs(scene):
            announce(planned.job.name, None)
            shell = testbed.shells[planned.role]
            with shell.silence(planned.job.limit_s):
                code = jobs.run(shell, planned.job)
            if code != 0:
                raise scene.failure(planned, f"{planned.program} ended with exit code {code}")

    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Start processes that must be ready first, such as a listener; return the function that runs the step.

        A capture calls it in a thread while tcpdump starts. Both functions raise the errors of `run`.
        """
        return partial(self.run, scene, testbed)

    def own_jobs(self, scene: Scene) -> Iterator[Planned]:
        """Yield the jobs of the step itself, without those of the steps inside it."""
        return self.jobs(scene)

    def dry_run_notes(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (most steps have no such actions)
        """Yield a line for each action that is not a command on a robot; `--dry-run` prints them."""
        return iter(())

    def abort_notes(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (most move no robot)
        """Yield a sentence for each moving robot on what it does if the attempt is stopped immediately."""
        return iter(())

    def roles(self) -> frozenset[Role]:
        """Return the roles that the step needs. By default these are the roles among the values of its fields."""
        return frozenset(role for name in type(self).model_fields for role in _roles_in(getattr(self, name)))

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """Return the approximate duration of the step on a good link, in seconds."""
        return 0.0

    def with_record(self, duration_s: float) -> Self:  # noqa: ARG002 (most steps record nothing)
        """Return this step with every recording in it `duration_s` long."""
        return self

    def resolved(self, cast: Cast, path_s: float | None = None) -> Self:  # noqa: ARG002 (most have no such setting)
        """Return this step with each setting that depends on the robots filled in. A plan has resolved steps only.

        Args:
            cast: The robot in each role.
            path_s: Duration of the path of the robot that moves meanwhile, in seconds; None if no robot moves.
        """
        return self

    def adjustments(self, cast: Cast) -> Iterator[str]:  # noqa: ARG002 (most reduce nothing)
        """Yield a sentence for each setting that `resolved` reduces."""
        return iter(())

    # Requirements.

    def listens(self) -> tuple[ListeningPort, ...]:
        """Return the listening ports of the step, which identify its packets in a capture."""
        return ()

    def restarts(self) -> frozenset[Role]:
        """Return the roles whose robots the step restarts. Any other restart makes an attempt void."""
        return frozenset()

    def moves(self) -> frozenset[Role]:
        """Return the roles whose robots the step moves from their places."""
        return frozenset()

    def placement_error(self, earlier: Sequence["Step"], within: Sequence["Nest"]) -> str | None:  # noqa: ARG002 (most fit)
        """Return why the step is not allowed at its position in the procedure; None if it is.

        Args:
            earlier: The steps that start before it.
            within: The steps around it, the outermost first.
        """
        return None

    def may_prompt(self) -> bool:
        """Return True if the step may prompt the operator; then no other step may run at the same time."""
        return False

    def refusals(self, scene: Scene) -> Iterator[Refusal]:  # noqa: ARG002 (most work with every tool)
        """Yield the reasons why the step cannot work with the tools of the robots."""
        return iter(())

    def needs(self, scene: Scene) -> Iterator[Need]:  # noqa: ARG002 (most need only programs)
        """Yield the preflight checks of the step, in addition to the search for the programs of its `jobs`."""
        return iter(())

    def live_topics(self, role: Role) -> tuple[str, ...]:  # noqa: ARG002 (most subscribe to no topic)
        """Return the ROS topics that must be published on the robot in `role`."""
        return ()

    def bytes_left(self, scene: Scene, role: Role) -> float:  # noqa: ARG002 (small text files are estimated elsewhere)
        """Return the approximate size of its files on the robot in `role`, in bytes, without small text files."""
        return 0.0

    def reserve_bytes(self, scene: Scene, role: Role) -> int:  # noqa: ARG002 (most need no reserve)
        """Return the free disk space that its programs need on the robot beyond their output, in bytes."""
        return 0

    # Traffic and files.

    def exclusive_resources(self) -> tuple[str, ...]:
        """Return the resources that no other step with the same `name` may use in a repeat, as text: `a ping`."""
        kind = self.kind_name()
        return (f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}",)

    def files(self) -> tuple[str, ...]:
        """Return the names of all files that the step writes into an attempt's folder, including logs.

        A bag is listed with and without the suffix `.bag`: the robot's profile determines its actual name, which may
        be that of a folder.
        """
        return ()

    def laptop_files(self) -> tuple[str, ...]:
        """Return those of `files` that the laptop writes; their names are in `fieldkit.core.laptop_files`."""
        return ()

    def recorded(self, cast: Cast) -> Iterator[RecordedFile]:  # noqa: ARG002 (most record nothing)
        """Yield the recordings of the step, which other steps may send."""
        return iter(())

    def records_on(self) -> frozenset[Role]:
        """Return the roles of `recorded`, which do not depend on the cast."""
        return frozenset()

    def flows(self, scene: Scene) -> Iterator[Flow]:  # noqa: ARG002 (most send nothing over the radio)
        """Yield the traffic of the step on the radio."""
        return iter(())

    # Checks and measurements.

    def check(self, view: View) -> Iterator[str]:  # noqa: ARG002 (missing values of columns are reported by the gates)
        """Yield each reason why the evidence is incomplete or contradictory, a sentence without a full stop."""
        return iter(())

    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns that the step measures."""
        return self.columns

    def measure(self, view: View) -> Measured:  # noqa: ARG002 (some measure nothing)
        """Return a value for each of `output_columns`, or the reason why it is missing."""
        return Measured()

    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:  # noqa: ARG002 (some have no important figures)
        """Yield the most important figures for the line of a repeat: `IP loss 3.2 %`.

        Parts with the word `loss` come first in that line.
        """
        return iter(())

    def transfer(self, scene: Scene, within: Sequence["Nest"]) -> Transfer | None:  # noqa: ARG002 (most send no file)
        """Return the packet filter of the file transfer; None if the step sends no file.

        Args:
            scene: The attempt.
            within: The steps around it, the outermost first.
        """
        return None

    def pinging(self) -> Pinging | None:
        """Return the source of the step's round-trip times; None if it measures none."""
        return None


def _roles_in(value: object) -> Iterator[Role]:
    """Yield the roles in the value of a field; steps inside a step are left out."""
    if isinstance(value, Role):
        yield value
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _roles_in(key)
            yield from _roles_in(item)
    elif isinstance(value, tuple | list | set | frozenset):
        for item in value:
            yield from _roles_in(item)


def _load(point: EntryPoint) -> type[Step]:
    """Return the class of a kind.

    Raises:
        ConfigurationError: It cannot be loaded, or is not a complete subclass of `Step`.
    """
    loaded, location, remedy = plugins.load(point), plugins.location(point), plugins.REMEDY
    if not (isinstance(loaded, type) and issubclass(loaded, Step)):
        raise ConfigurationError("a kind of step must be a subclass of Step", where=location, remedy=remedy)
    if isabstract(loaded):
        missing = ", ".join(sorted(loaded.__abstractmethods__))
        raise ConfigurationError(f"the kind of step lacks {missing}", where=location, remedy=remedy)
    return loaded


@cache
def step_types() -> LazyMapping[type[Step]]:
    """Return the class of every kind of step by name, built-in kinds first.

    Raises:
        ConfigurationError: As `kinds.find`.
    """
    return LazyMapping(kinds.find(), _load)


@dataclass(frozen=True)
class StepEntry:
    """One entry under `steps:`, a mapping with one key: the kind of step.

    Attributes:
        kind: The key.
        step: The step.
    """

    kind: str
    step: Step

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: Any) -> CoreSchema:  # noqa: ANN401 (of pydantic)
        return schema.by_kind(step_types, cls, lambda entry: (entry.kind, entry.step), "step")
