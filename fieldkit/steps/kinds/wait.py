"""Wait for some time, or until the operator says so."""

from collections.abc import Iterator
from typing import Annotated, ClassVar, Self

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol
from fieldkit.steps.along import AlongStep
from fieldkit.steps.scene import Announce, Planned, Scene


class WaitStep(AlongStep):
    """Waits for a time, or until the operator has done something and pressed Enter.

    With `--yes` no operator is asked.

    Attributes:
        duration: How long to wait; exactly one of this, `until` and `along` is given.
        until: What the operator must do, in the imperative: `open the door`.
    """

    needs_complete_capture: ClassVar[bool] = False

    duration: Annotated[Duration, Field(gt=0)] | None = None
    until: Annotated[str, Field(pattern=r"^\S[^\n]{0,200}$")] | None = None

    @schema.model_validator(mode="after")
    def _waits_for_one_thing(self) -> "WaitStep":
        if [self.duration is not None, self.until is not None, self.along].count(True) != 1:
            raise schema.complaint("a wait has a duration, or until: what the operator is to do, or along: true")
        return self

    @override
    def lasting(self, seconds: float) -> Self:
        return self.model_copy(update={"duration": seconds})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        return iter(())

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        yield f"the operator is asked to {self.until}" if self.until else f"wait {self.duration:g} s"

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`.

        Raises:
            ConfigurationError: There is nobody to ask.
            RobotError: It was not to go on, since a step beside it had failed.
        """
        announce("wait", self.duration)
        if self.until:
            testbed.operator.ask(self.until)
        elif scene.halt.wait(self.duration or 0.0):
            raise RobotError("the wait was cut short, since a step beside it had failed")

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        """There may be any number."""
        return ()

    @override
    def asks(self) -> bool:
        return self.until is not None

    @override
    def expected_s(self, protocol: Protocol) -> float:
        """Nobody knows how long a person takes."""
        return self.duration or 0.0
