"""Base class of steps that contain other steps, and functions on a step and all steps inside it."""

from abc import ABC
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import ClassVar, Self

from typing_extensions import override

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.capabilities import DependsOnCast, Records, SendsTraffic
from fieldkit.steps.scene import Flow, Planned, Scene


class Nest(Step, DependsOnCast, ABC):
    """A step that contains other steps.

    Attributes:
        during: The steps inside.
        disturbs: Whether the step may make the steps inside fail, so that their evidence may be incomplete.
        parallel: Whether the steps inside run at the same time.
        has_path: Whether the step has a path whose duration steps inside can use (`along: true`).
    """

    disturbs: ClassVar[bool] = False
    parallel: ClassVar[bool] = False
    has_path: ClassVar[bool] = False

    during: tuple[StepEntry, ...]

    def captures(self) -> Mapping[Role, str]:
        """Return the capture file of each robot that captures while the steps inside run."""
        return {}

    def inside(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job of the steps inside, in the order in which it starts."""
        for entry in self.during:
            yield from entry.step.jobs(scene)

    @override
    def roles(self) -> frozenset[Role]:
        """Return the roles of the step and of the steps inside."""
        return super().roles() | self.roles_inside()

    @override
    def resolved(self, cast: Cast, path_s: float | None = None) -> Self:
        during = tuple(resolved(entry, cast, path_s) for entry in self.during)
        return self.model_copy(update={"during": during})

    def roles_inside(self) -> frozenset[Role]:
        """Return the roles that the steps inside need."""
        return frozenset().union(*(entry.step.roles() for entry in self.during))

    def inside_s(self, protocol: Protocol) -> float:
        """Return the approximate duration of the steps inside on a good link, in seconds."""
        return sum(entry.step.expected_s(protocol) for entry in self.during)


def steps_inside(nest: Nest) -> Iterator[Step]:
    """Yield the steps inside `nest`, at any depth, in the order in which they start."""
    for entry in nest.during:
        yield entry.step
        if isinstance(entry.step, Nest):
            yield from steps_inside(entry.step)


def flows_inside(nest: Nest, scene: Scene) -> Iterator[Flow]:
    """Yield the traffic of the steps inside `nest` on the radio, at any depth."""
    for step in steps_inside(nest):
        if isinstance(step, SendsTraffic):
            yield from step.flows(scene)


def end_inside(nest: Nest, scene: Scene, testbed: Testbed) -> None:
    """Stop every running job of the steps inside `nest`.

    Raises:
        LinkError: A robot did not answer.
    """
    for planned in nest.inside(scene):
        with suppress(RobotError):  # the job was never started
            jobs.stop(testbed.shells[planned.role], planned.job)


def own_jobs(step: Step, scene: Scene) -> Iterator[Planned]:
    """Yield the jobs of a step without the jobs of the steps inside it."""
    inside = {(planned.role, planned.job.name) for planned in step.inside(scene)} if isinstance(step, Nest) else set()
    return (planned for planned in step.jobs(scene) if (planned.role, planned.job.name) not in inside)


def resolved(entry: StepEntry, cast: Cast, path_s: float | None = None) -> StepEntry:
    """Return an entry whose step, and the steps inside it, are resolved; see `DependsOnCast.resolved`."""
    step = entry.step
    return StepEntry(entry.kind, step.resolved(cast, path_s)) if isinstance(step, DependsOnCast) else entry


def with_record(entry: StepEntry, duration_s: float) -> StepEntry:
    """Return an entry whose step, and the steps inside it, have recordings of the duration `duration_s`."""
    step = entry.step
    if isinstance(step, Nest):
        step = step.model_copy(update={"during": tuple(with_record(inner, duration_s) for inner in step.during)})
    return StepEntry(entry.kind, step.with_record(duration_s) if isinstance(step, Records) else step)
