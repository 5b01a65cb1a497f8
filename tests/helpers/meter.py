"""A kind of step as another package may have it, which declares columns by instance: `- meter: {...}`."""

from collections.abc import Iterator

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Column, Figure, Kind, Measured, columns
from fieldkit.core.model import Protocol, Role
from fieldkit.steps.base import Step, View
from fieldkit.steps.scene import Announce, Planned, Scene

TARGET = "tests.helpers.meter:Meter"


class Meter(Step):
    """It does nothing, and measures what its YAML says.

    Attributes:
        called: The name that its columns begin with.
        measures: Names of columns, in dBm.
        robot: Whose.
    """

    columns = columns(
        7, ("meter_level", "dBm", "What the meter says.", Figure("level by meter", Kind.MEDIAN), (-150, 50))
    )

    called: str = ""
    measures: tuple[str, ...] = ()
    robot: Role = Role.SENDER

    @property
    def prefix(self) -> str:
        """See `Step.prefix`."""
        return self.called

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`."""
        own = (Column(name, "dBm", "As its YAML says.", figure=Figure(name, Kind.MEDIAN)) for name in self.measures)
        return (*self.columns, *own)

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        return iter(())

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.robot})

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return 0.0

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ()

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return ()

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        return Measured.nothing(self.declared(), "there is no meter")
