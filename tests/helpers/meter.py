"""A kind of step as another package may have it, which declares columns by instance: `- meter: {...}`."""

from collections.abc import Iterator

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Column, Figure, Kind, Measured, columns
from fieldkit.core.model import Protocol, Role
from fieldkit.steps.base import Step
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View

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
    @override
    def prefix(self) -> str:
        return self.called

    @override
    def output_columns(self) -> tuple[Column, ...]:
        own = (Column(name, "dBm", "As its YAML says.", figure=Figure(name, Kind.MEDIAN)) for name in self.measures)
        return (*self.columns, *own)

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        return iter(())

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        pass

    @override
    def roles(self) -> frozenset[Role]:
        return frozenset({self.robot})

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return 0.0

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ()

    @override
    def files(self) -> tuple[str, ...]:
        return ()

    @override
    def measure(self, view: View) -> Measured:
        return Measured.nothing(self.output_columns(), "there is no meter")
