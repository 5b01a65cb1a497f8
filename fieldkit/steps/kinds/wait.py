"""Wait for some time, or until the operator says so."""

from collections.abc import Iterator
from typing import Annotated, Self

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.steps.along import AlongStep
from fieldkit.steps.scene import Announce, Planned, Scene


class WaitStep(AlongStep):
    """Nothing happens for a while: robots settle, a person does something.

    Attributes:
        duration: So long.
        until: What the operator is asked to see to, in the imperative; it goes on with the answer.
    """

    duration: Annotated[Duration, Field(gt=0)] | None = None
    until: Annotated[str, Field(pattern=r"^\S[^\n]{0,200}$")] | None = None

    @schema.model_validator(mode="after")
    def _waits_for_one_thing(self) -> "WaitStep":
        if [self.duration is not None, self.until is not None, self.along].count(True) != 1:
            raise schema.complaint("a wait has a duration, or until: what the operator is to do, or along: true")
        return self

    def lasting(self, seconds: float) -> Self:
        """See `AlongStep.lasting`."""
        return self.model_copy(update={"duration": seconds})

    def commands(self, scene: Scene) -> Iterator[Planned]:  # noqa: ARG002 (nothing runs)
        """See `Step.commands`."""
        return iter(())

    def beside(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (the same for every scene)
        """See `Step.beside`."""
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

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset()

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`; there may be any number."""
        return ()

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return ()

    def asks(self) -> bool:
        """See `Step.asks`."""
        return self.until is not None

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """See `Step.expected_s`; nobody knows how long a person takes."""
        return self.duration or 0.0
