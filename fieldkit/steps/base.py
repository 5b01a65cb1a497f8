"""The contract of a step: its YAML keys, jobs, requirements, files, checks and columns."""

from abc import ABC
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import EntryPoint
from inspect import isabstract
from typing import Annotated, Any, ClassVar

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import CoreSchema, Field, Strict
from fieldkit.core import plugins
from fieldkit.core.columns import Column, Measured, step_prefixed
from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.lazy_mapping import LazyMapping
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.steps import capabilities, kinds
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View

StepName = Annotated[
    str,
    schema.pattern_field(
        r"^[a-z][a-z0-9_]{0,30}$", "a name of at most 31 lower-case letters, digits and _, with a letter first"
    ),
]
"""Name of a step or of a bag, a recording of ROS topics."""
FileName = Annotated[
    str,
    schema.pattern_field(
        r"^[a-z][a-z0-9_.-]{0,40}$",
        "a file name of at most 41 lower-case letters, digits, _ . and -, with a letter first",
    ),
]
"""Name of a file in the folder of an attempt."""


class Step(Strict, ABC):
    """One action of a procedure.

    Its fields are its YAML keys. The code of plans, preflight checks, evidence checks, `trial.csv` and reports calls
    the methods below, and does not depend on the kind of step. A kind usually defines `jobs`, `check` and `measure`;
    every method has a default. A kind that runs one program is a `fieldkit.steps.program.ProgramStep`, which needs
    two methods. Methods that few kinds need are in `fieldkit.steps.capabilities`.

    `jobs` has no side effects: `--dry-run` prints its jobs, tests compare them with stored lines, and `run` starts
    them. To add a kind, write its module and name its class in `fieldkit.steps.kinds`, or in an entry point of the
    group `fieldkit.steps`.

    Attributes:
        columns: Columns that steps of its kind measure, unless the kind overrides `output_columns`.
        cross_checks: Sources of these columns, and the checks between them.
        kept_bytes: Bytes of each frame that a capture must keep for the step; 0 if the default number is enough.
        capture_buffer_kib: Kernel buffer that a capture needs for the step's packets; 0 if the default is enough.
        needs_complete_capture: Whether a repeat is void if a capture around the step dropped packets. If not, the
            step leaves the columns that depend on the capture empty.
        name: Lower-case letters, digits and `_`, with a letter first. It distinguishes the step from others of its
            kind. The names of its jobs, files and columns start with it.
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

    def prefixed_name(self, base_name: str) -> str:
        """Return the name of a job or file of the step: `up.recv.bag`, or `recv.bag` for a step without a name."""
        return step_prefixed(self.prefix, base_name)

    @classmethod
    def kind_name(cls) -> str:
        """Return the kind as it occurs in names of jobs and files: the class name in lower case, without `Step`."""
        return cls.__name__.removesuffix("Step").lower()

    def jobs(self, scene: Scene) -> Iterator[Planned]:  # noqa: ARG002 (some steps need no robot)
        """Yield the jobs in the order in which they start."""
        return iter(())

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Run the step. By default each job starts when the previous one has exited with code 0.

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

    def roles(self) -> frozenset[Role]:
        """Return the roles that the step needs. By default these are the roles among the values of its fields."""
        return frozenset(role for name in type(self).model_fields for role in _roles_in(getattr(self, name)))

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (subclasses need it)
        """Return the approximate duration of the step on a good link, in seconds."""
        return 0.0

    def exclusive_resources(self) -> tuple[str, ...]:
        """Return the resources that no other step with the same `name` may use in a repeat, for example `a ping`."""
        kind = self.kind_name()
        return (f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}",)

    def files(self) -> tuple[str, ...]:
        """Return the names of all files that the step writes into an attempt's folder, including logs.

        A bag is listed with and without the suffix `.bag`: the robot's profile determines its actual name, which may
        be the name of a folder.
        """
        return ()

    def check(self, view: View) -> Iterator[str]:  # noqa: ARG002 (subclasses need it)
        """Yield each reason why the evidence is incomplete or contradictory, a sentence without a full stop."""
        return iter(())

    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns that the step measures."""
        return self.columns

    def measure(self, view: View) -> Measured:  # noqa: ARG002 (by default a step measures nothing)
        """Return a value for each of `output_columns`, or the reason why it is missing."""
        return Measured()


def _roles_in(value: object) -> Iterator[Role]:
    """Yield the roles in the value of a field, without the roles of steps inside the step."""
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
        ConfigurationError: The class cannot be loaded, or is not a complete subclass of `Step`.
    """
    step_class, location, remedy = plugins.load(point), plugins.location(point), plugins.REMEDY
    if not (isinstance(step_class, type) and issubclass(step_class, Step)):
        raise ConfigurationError("a kind of step must be a subclass of Step", where=location, remedy=remedy)
    if isabstract(step_class):
        missing = ", ".join(sorted(step_class.__abstractmethods__))
        raise ConfigurationError(f"the kind of step lacks {missing}", where=location, remedy=remedy)
    if missing := ", ".join(capabilities.missing_methods(step_class)):
        reason = f"the kind of step has only a part of a capability: it lacks {missing}"
        raise ConfigurationError(reason, where=location, remedy=remedy)
    return step_class


@cache
def step_types() -> LazyMapping[type[Step]]:
    """Return the class of every kind of step by name, built-in kinds first.

    Raises:
        ConfigurationError: For the same reasons as `kinds.find`.
    """
    return LazyMapping(kinds.find(), _load)


def prepare(step: Step, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
    """Start the processes of a step that must be ready first; return the function that runs the step."""
    return (
        step.prepare(scene, testbed) if isinstance(step, capabilities.Prepares) else partial(step.run, scene, testbed)
    )


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
    def __get_pydantic_core_schema__(cls, *_: Any) -> CoreSchema:  # noqa: ANN401 (pydantic declares them as Any)
        return schema.by_kind(step_types, cls, lambda entry: (entry.kind, entry.step), "step")
