"""The contract of a step: data from a procedure that owns all that its kind needs, does and leaves."""

from abc import ABC
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from inspect import isabstract
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.config import schema
from fieldkit.config.schema import CoreSchema, Field, Strict
from fieldkit.core import plugins
from fieldkit.core.columns import Column, Measured, Value, prefixed
from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.remote import jobs
from fieldkit.steps import kinds
from fieldkit.steps.scene import Announce, Flow, ListeningPort, Need, Pinging, Planned, RecordedFile, Refusal, Scene
from fieldkit.steps.view import View

if TYPE_CHECKING:
    from fieldkit.steps.nest import Nest

StepName = Annotated[
    str,
    schema.shaped(r"^[a-z][a-z0-9_]{0,30}$", "a name: small letters, digits and _, a small letter first, 31 in all"),
]
FileName = Annotated[
    str, schema.shaped(r"^[a-z][a-z0-9_.-]{0,40}$", "the name of a file: small letters, digits, _ . and -, 41 in all")
]
"""What a step, and a bag, may be called."""


class Step(Strict, ABC):
    """One action of a procedure.

    Its fields are its YAML keys. Plans, preflight, gates, rows and reports call the methods below and contain no name
    of a kind. A kind usually defines `jobs`, `check` and `measure`; every method has a default. A kind that runs one
    program is a `fieldkit.steps.program.ProgramStep`, which needs two methods.

    `jobs` is pure: `--dry-run` prints it, tests compare it with golden lines, and `run` starts the same jobs. To add
    a kind, write its module and name its class in `fieldkit.steps.kinds`, or in an entry point of the group
    `fieldkit.steps`.

    Attributes:
        columns: What steps of its kind measure.
        cross_checks: Sources of these columns, and the checks between them.
        kept_bytes: Bytes of each frame that a capture must keep for the step; 0 if headers are enough.
        capture_buffer_kib: Kernel buffer that a capture needs for the step's packets; 0 if the usual one is enough.
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
        """The name that jobs, files and columns begin with; empty where they stand for themselves."""
        return self.name

    def own_name(self, what: str) -> str:
        """Return what a job or a file of the step is called: `up.recv.bag`; `recv.bag` of a step without a name."""
        return prefixed(self.prefix, what)

    @classmethod
    def kind_name(cls) -> str:
        """Return the name of the class in lower case, without `Step`: part of the names of jobs and files."""
        return cls.__name__.removesuffix("Step").lower()

    # What it does.

    def jobs(self, scene: Scene) -> Iterator[Planned]:  # noqa: ARG002 (some steps need no robot)
        """Yield every job in the order in which it starts."""
        return iter(())

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Carry the step out. By default each job starts when the one before has ended with exit code 0.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A robot could not do it.
        """
        for planned in self.jobs(scene):
            announce(planned.job.name, None)
            shell = testbed.shells[planned.role]
            with shell.silence(planned.job.limit_s):
                code = jobs.run(shell, planned.job)
            if code != 0:
                raise scene.failure(planned, f"{planned.program} ended with exit code {code}")

    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Start what must be ready before the step begins, as a listener, and return the function that runs the step.

        A capture calls it in a thread while tcpdump starts. Errors as `run`, of both.
        """
        return partial(self.run, scene, testbed)

    def own_jobs(self, scene: Scene) -> Iterator[Planned]:
        """Yield the jobs of the step itself, without those of the steps inside it."""
        return self.jobs(scene)

    def dry_run_notes(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (most steps are nothing but commands)
        """Yield a line for each action that is not a command on a robot; `--dry-run` prints them."""
        return iter(())

    def abort_notes(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (most leave robots where they are)
        """Yield a sentence about each moving robot: what it does if the attempt is stopped immediately."""
        return iter(())

    def roles(self) -> frozenset[Role]:
        """Return the roles that the step needs. By default these are the roles among the values of its fields."""
        return frozenset(role for name in type(self).model_fields for role in _roles_in(getattr(self, name)))

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """Return about how many seconds the step takes on a good link."""
        return 0.0

    def with_record(self, duration_s: float) -> Self:  # noqa: ARG002 (most steps record nothing)
        """Return this step with every recording in it `duration_s` long."""
        return self

    def resolved(self, cast: Cast, way_s: float | None = None) -> Self:  # noqa: ARG002 (most ask nothing of robots)
        """Return this step with each setting that depends on the robots filled in. A plan has resolved steps only.

        Args:
            cast: The robot in each role.
            way_s: Duration of the path of the robot that moves meanwhile; None if no robot moves.
        """
        return self

    def adjustments(self, cast: Cast) -> Iterator[str]:  # noqa: ARG002 (most do what they say, or not at all)
        """Yield a sentence for each setting that `resolved` reduces."""
        return iter(())

    # What it needs.

    def listens(self) -> tuple[ListeningPort, ...]:
        """Return the ports on which robots listen for the step. They identify its packets in a capture."""
        return ()

    def restarts(self) -> frozenset[Role]:
        """Return the roles whose robots the step restarts. Any other restart makes an attempt void."""
        return frozenset()

    def moves(self) -> frozenset[Role]:
        """Return the roles whose robots the step moves from their places."""
        return frozenset()

    def placement_error(self, earlier: Sequence["Step"], within: Sequence["Nest"]) -> str | None:  # noqa: ARG002 (most fit)
        """Return why a procedure cannot have the step at its position; None if it can.

        Args:
            earlier: The steps that begin before it.
            within: The steps around it, the outermost first.
        """
        return None

    def asks(self) -> bool:
        """Return whether the step may ask the operator to do something, so that no other step may run beside it."""
        return False

    def refusals(self, scene: Scene) -> Iterator[Refusal]:  # noqa: ARG002 (most tools can do what they are for)
        """Yield what cannot work with the tools that the robots have."""
        return iter(())

    def needs(self, scene: Scene) -> Iterator[Need]:  # noqa: ARG002 (most need programs alone)
        """Yield what the step needs of robots beside the programs of its `jobs`."""
        return iter(())

    def live_topics(self, role: Role) -> tuple[str, ...]:  # noqa: ARG002 (most hear none)
        """Return the ROS topics that must be alive on the robot in `role`."""
        return ()

    def bytes_left(self, scene: Scene, role: Role) -> float:  # noqa: ARG002 (a few lines of text are counted for all)
        """Return about how many bytes the step leaves on the robot in `role`, without text files."""
        return 0.0

    def reserve_bytes(self, scene: Scene, role: Role) -> int:  # noqa: ARG002 (most write until the disk is full)
        """Return the free bytes that its programs demand on the robot in `role`, beside what they write."""
        return 0

    # What it sends and leaves.

    def exclusive_resources(self) -> tuple[str, ...]:
        """Return what no other step with the same `name` may use in a repeat, for messages: `a ping`."""
        kind = self.kind_name()
        return (f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}",)

    def files(self) -> tuple[str, ...]:
        """Return the names of all files that the step leaves in an attempt's folder, logs too.

        A bag is listed with and without the suffix `.bag`: the robot's profile determines its actual name, which may
        be that of a folder.
        """
        return ()

    def laptop_files(self) -> tuple[str, ...]:
        """Return which of `files` the laptop writes; `fieldkit.core.laptop_files` has their names."""
        return ()

    def recorded(self, cast: Cast) -> Iterator[RecordedFile]:  # noqa: ARG002 (most make none)
        """Yield the files that the step makes and that other steps may send."""
        return iter(())

    def records_on(self) -> frozenset[Role]:
        """Return the roles of `recorded`, which do not depend on the cast."""
        return frozenset()

    def flows(self, scene: Scene) -> Iterator[Flow]:  # noqa: ARG002 (most send nothing over the radio)
        """Yield what the step sends over the radio."""
        return iter(())

    # What its evidence shows.

    def check(self, view: View) -> Iterator[str]:  # noqa: ARG002 (what it declares is asked for anyway)
        """Yield each reason why the evidence is incomplete or contradictory: a sentence without a full stop."""
        return iter(())

    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns that the step measures."""
        return self.columns

    def measure(self, view: View) -> Measured:  # noqa: ARG002 (most of those that measure nothing)
        """Return a value for each of `output_columns`, or the reason why it is missing."""
        return Measured()

    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:  # noqa: ARG002 (not all is worth a word)
        """Yield the most important figures for the line of a repeat: `IP loss 3.2 %`.

        Parts with the word `loss` come first in that line.
        """
        return iter(())

    def transfer(self, scene: Scene, within: Sequence["Nest"]) -> Transfer | None:  # noqa: ARG002 (most send no file)
        """Return the file transfer of the step and what identifies its packets; None if it sends no file.

        Args:
            scene: The attempt.
            within: The steps around it, the outermost first.
        """
        return None

    def pinging(self) -> Pinging | None:
        """Return the role and file that contain the step's round-trip times; None if it measures none."""
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


@cache
def step_types() -> Mapping[str, type[Step]]:
    """Return the class of every kind of step by name, fieldkit's own first.

    Raises:
        ConfigurationError: As `kinds.load`, or an entry point names an object that is not a complete subclass of
            `Step`.
    """
    found: dict[str, type[Step]] = {}
    for point, loaded in kinds.load():
        where, remedy = plugins.where(point), plugins.REMEDY
        if not (isinstance(loaded, type) and issubclass(loaded, Step)):
            raise ConfigurationError("a kind of step is a subclass of Step", where=where, remedy=remedy)
        if isabstract(loaded):
            lacking = ", ".join(sorted(loaded.__abstractmethods__))
            raise ConfigurationError(f"the kind of step lacks {lacking}", where=where, remedy=remedy)
        found[point.name] = loaded
    return MappingProxyType(found)


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
