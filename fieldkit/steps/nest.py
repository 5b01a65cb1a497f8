"""Base class of steps that contain other steps."""

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
from fieldkit.steps.scene import Flow, Planned, Refusal, Scene


class Nest(Step, ABC):
    """A step that contains other steps.

    Attributes:
        during: The steps inside.
        disturbs: Whether the step may make the steps inside fail, so that their evidence may be incomplete.
        parallel: Whether the steps inside run at the same time.
        leads: Whether the step has a path whose duration steps inside can use (`along: true`).
    """

    disturbs: ClassVar[bool] = False
    parallel: ClassVar[bool] = False
    leads: ClassVar[bool] = False

    during: tuple[StepEntry, ...]

    def captures(self) -> Mapping[Role, str]:
        """Return the capture file of each robot that captures while the steps inside run."""
        return {}

    def kept_bytes_inside(self) -> int:
        """Return the maximum of `kept_bytes` of the steps inside, at any depth."""
        nests = (entry.step.kept_bytes_inside() for entry in self.during if isinstance(entry.step, Nest))
        return max((*nests, *(entry.step.kept_bytes for entry in self.during)), default=0)

    def leaves_inside(self) -> "Iterator[Step]":
        """Yield the steps inside, at any depth, that contain no steps."""
        for entry in self.during:
            if isinstance(entry.step, Nest):
                yield from entry.step.leaves_inside()
            else:
                yield entry.step

    def inside(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job of the steps inside, in the order in which it starts."""
        for entry in self.during:
            yield from entry.step.jobs(scene)

    @override
    def roles(self) -> frozenset[Role]:
        """Return the roles of the step and of the steps inside."""
        return super().roles() | self.roles_inside()

    @override
    def own_jobs(self, scene: Scene) -> Iterator[Planned]:
        inside = {(planned.role, planned.job.name) for planned in self.inside(scene)}
        return (planned for planned in self.jobs(scene) if (planned.role, planned.job.name) not in inside)

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        for entry in self.during:
            yield from entry.step.refusals(scene)

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        for entry in self.during:
            yield from entry.step.dry_run_notes(scene)

    @override
    def abort_notes(self, scene: Scene) -> Iterator[str]:
        for entry in self.during:
            yield from entry.step.abort_notes(scene)

    @override
    def with_record(self, duration_s: float) -> Self:
        during = tuple(StepEntry(entry.kind, entry.step.with_record(duration_s)) for entry in self.during)
        return self.model_copy(update={"during": during})

    @override
    def resolved(self, cast: Cast, path_s: float | None = None) -> Self:
        during = tuple(StepEntry(entry.kind, entry.step.resolved(cast, path_s)) for entry in self.during)
        return self.model_copy(update={"during": during})

    @override
    def adjustments(self, cast: Cast) -> Iterator[str]:
        for entry in self.during:
            yield from entry.step.adjustments(cast)

    def flows_inside(self, scene: Scene) -> Iterator[Flow]:
        """Yield the traffic of the steps inside on the radio, at any depth."""
        for entry in self.during:
            yield from entry.step.flows(scene)
            if isinstance(entry.step, Nest):
                yield from entry.step.flows_inside(scene)

    def end_inside(self, scene: Scene, testbed: Testbed) -> None:
        """Stop every running job of the steps inside.

        Raises:
            LinkError: A robot did not answer.
        """
        for planned in self.inside(scene):
            with suppress(RobotError):  # it was never started
                jobs.stop(testbed.shells[planned.role], planned.job)

    def roles_inside(self) -> frozenset[Role]:
        """Return the roles that the steps inside need."""
        return frozenset().union(*(entry.step.roles() for entry in self.during))

    def inside_s(self, protocol: Protocol) -> float:
        """Return the approximate duration of the steps inside on a good link, in seconds."""
        return sum(entry.step.expected_s(protocol) for entry in self.during)
