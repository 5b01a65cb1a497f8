"""A step that contains other steps."""

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
        disturbs: Whether the steps inside may fail because of it, so that their evidence may be incomplete.
        parallel: Whether the steps inside run at the same time.
        leads: Whether it has a path, whose duration steps inside can take (`along: true`).
    """

    disturbs: ClassVar[bool] = False
    parallel: ClassVar[bool] = False
    leads: ClassVar[bool] = False

    during: tuple[StepEntry, ...]

    def captures(self) -> Mapping[Role, str]:
        """Return the files of what is captured while the steps inside run, by whose packets these are."""
        return {}

    def kept_bytes_inside(self) -> int:
        """Return how many bytes of each frame a capture must keep for the steps inside, at any depth."""
        nests = (entry.step.kept_bytes_inside() for entry in self.during if isinstance(entry.step, Nest))
        return max((*nests, *(entry.step.kept_bytes for entry in self.during)), default=0)

    def leaves_inside(self) -> "Iterator[Step]":
        """Yield the steps inside that have no steps inside themselves, at any depth."""
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
        """Those of the steps inside, too."""
        return super().roles() | self.roles_inside()

    @override
    def own_jobs(self, scene: Scene) -> Iterator[Planned]:
        others = {(planned.role, planned.job.name) for planned in self.inside(scene)}
        return (planned for planned in self.jobs(scene) if (planned.role, planned.job.name) not in others)

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
    def resolved(self, cast: Cast, way_s: float | None = None) -> Self:
        during = tuple(StepEntry(entry.kind, entry.step.resolved(cast, way_s)) for entry in self.during)
        return self.model_copy(update={"during": during})

    @override
    def adjustments(self, cast: Cast) -> Iterator[str]:
        for entry in self.during:
            yield from entry.step.adjustments(cast)

    def flows_inside(self, scene: Scene) -> Iterator[Flow]:
        """Yield what the steps inside send over the radio, at any depth."""
        for entry in self.during:
            yield from entry.step.flows(scene)
            if isinstance(entry.step, Nest):
                yield from entry.step.flows_inside(scene)

    def end_inside(self, scene: Scene, testbed: Testbed) -> None:
        """End every job of the steps inside that runs.

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
        """Return about how many seconds the steps inside take on a good link."""
        return sum(entry.step.expected_s(protocol) for entry in self.during)
