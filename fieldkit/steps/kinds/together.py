"""Run steps at the same time."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Annotated, ClassVar, Final, TypeVar

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Field
from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Protocol
from fieldkit.core.threads import run_parallel
from fieldkit.steps import base
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.capabilities import AsksOperator, DescribesActions, Prepares
from fieldkit.steps.nest import Nest, end_inside
from fieldkit.steps.scene import Announce, Planned, Scene

T = TypeVar("T")

MAX_PARALLEL: Final = 8
"""Maximum number of simultaneous steps. OpenSSH permits 10 simultaneous commands per connection (MaxSessions), of
which two are reserved."""


class TogetherStep(Nest, Prepares, DescribesActions):
    """Runs its steps at the same time: all listeners are ready before the first step begins.

    It ends when the last of them ends. If one fails, all others are stopped, including a `wait`. For a sequence
    inside it, use a step that has `during`, for example a `capture`. A step that may prompt the operator (`fault`,
    `move`, `ask`, `wait` with `until`) cannot be inside; it may contain this step, or come before or after it. If SSH
    uses the radio under test, the commands of one step affect the measurement of another.

    Attributes:
        during: Two steps or more; at most 8 run at the same time.
    """

    parallel: ClassVar[bool] = True

    during: Annotated[tuple[StepEntry, ...], Field(min_length=2)]

    @schema.model_validator(mode="after")
    def _can_run_in_parallel(self) -> "TogetherStep":
        if (count := _max_parallel(self)) > MAX_PARALLEL:
            reason = f"{count} steps at the same time are more than {MAX_PARALLEL}: remove some"
            raise schema.validation_error(reason, "during")
        for kind, location in _operator_steps(self):
            raise schema.validation_error(
                f"{kind} may prompt the operator, so no step may run at the same time", *location
            )
        return self

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        yield from self.inside(scene)

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        names = (f"{entry.kind} {entry.step.prefix}".rstrip() for entry in self.during)
        yield f"at the same time: {', '.join(names)}"

    @override
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        inner_scene = replace(scene, halt=scene.halt.child())
        actions = self._run_all(
            [partial(base.prepare, entry.step, inner_scene, testbed) for entry in self.during], inner_scene, testbed
        )

        def carry_out(announce: Announce) -> None:
            self._run_all([partial(action, announce) for action in actions], inner_scene, testbed)

        return carry_out

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        self.prepare(scene, testbed)(announce)

    def _run_all(self, calls: list[Callable[[], T]], scene: Scene, testbed: Testbed) -> list[T]:
        """Make all calls at the same time; if one of them fails, stop the jobs for which the others wait."""

        def end() -> None:
            scene.halt.set()
            with suppress(FieldkitError):  # the first error is raised instead
                end_inside(self, scene, testbed)

        try:
            return run_parallel(lambda call: call(), calls, end_others=end)
        except Exception:
            end()  # also stops jobs of steps that did not fail
            raise
        except BaseException:
            scene.halt.set()  # the handler of Ctrl-C stops the jobs
            raise

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ()

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return max(entry.step.expected_s(protocol) for entry in self.during)


def _operator_steps(nest: Nest) -> Iterator[tuple[str, schema.Location]]:
    """Yield kind and location of each step inside, at any depth, that may prompt the operator."""
    for index, entry in enumerate(nest.during):
        location = ("during", index, entry.kind)
        if isinstance(entry.step, AsksOperator) and entry.step.may_prompt():
            yield entry.kind, location
        if isinstance(entry.step, Nest):
            yield from ((kind, (*location, *inner_location)) for kind, inner_location in _operator_steps(entry.step))


def _max_parallel(step: Step) -> int:
    """Return the maximum number of steps that run at the same time."""
    if not isinstance(step, Nest) or not step.during:
        return 1
    counts = [_max_parallel(entry.step) for entry in step.during]
    return sum(counts) if step.parallel else max(counts)
