"""Wait for a time, or until the operator presses Enter."""

from collections.abc import Iterator
from typing import Annotated, ClassVar, Self

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol
from fieldkit.steps.along import AlongStep
from fieldkit.steps.capabilities import AsksOperator, DescribesActions
from fieldkit.steps.scene import Announce, Planned, Scene


class WaitStep(AlongStep, DescribesActions, AsksOperator):
    """Waits for a time, or until the operator has carried out an action and pressed Enter.

    With `--yes` no operator is asked.

    Attributes:
        duration: Duration of the wait. Exactly one of `duration`, `until` and `along` must be set.
        until: Action of the operator, in the imperative: `open the door`.
    """

    needs_complete_capture: ClassVar[bool] = False

    duration: Annotated[Duration, Field(gt=0)] | None = None
    until: Annotated[str, Field(pattern=r"^\S[^\n]{0,200}$")] | None = None

    @schema.model_validator(mode="after")
    def _has_one_end(self) -> "WaitStep":
        if [self.duration is not None, self.until is not None, self.along].count(True) != 1:
            raise schema.validation_error("a wait needs exactly one of duration, until and along: true")
        return self

    @override
    def with_duration(self, seconds: float) -> Self:
        return self.model_copy(update={"duration": seconds})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        return iter(())

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        yield f"the operator is asked to {self.until}" if self.until else f"wait {self.duration:g} s"

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Wait; see `Step.run`.

        Raises:
            ConfigurationError: There is no operator, because the input is not a terminal.
            RobotError: The wait was interrupted, because a simultaneous step failed.
        """
        announce("wait", self.duration)
        if self.until:
            testbed.operator.ask(self.until)
        elif scene.halt.wait(self.duration or 0.0):
            raise RobotError("the wait was interrupted, because a simultaneous step failed")

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        """Return no resources, because a repeat may have any number of waits."""
        return ()

    @override
    def may_prompt(self) -> bool:
        return self.until is not None

    @override
    def expected_s(self, protocol: Protocol) -> float:
        """Return the duration; 0 if the operator ends the wait."""
        return self.duration or 0.0
