"""An example step kind of another package that declares columns for each instance: `- meter: {...}`."""

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
    """A step without effect that declares the columns in its YAML.

    Attributes:
        called: Prefix of its columns.
        measures: Names of columns, in dBm.
        robot: The role of the robot.
    """

    columns = columns(
        7, ("meter_level", "dBm", "Level of the meter.", Figure("level by meter", Kind.MEDIAN), (-150, 50))
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
        extra_columns = (
            Column(name, "dBm", "Column from the YAML.", figure=Figure(name, Kind.MEDIAN)) for name in self.measures
        )
        return (*self.columns, *extra_columns)

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
        return Measured.all_missing(self.output_columns(), "there is no meter")
