"""Measure the handovers of a robot between access points while other steps run."""

from collections.abc import Iterator, Mapping
from typing import Annotated

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.model import Protocol, Role
from fieldkit.core.units import format_count
from fieldkit.measure.evidence import handovers, ping
from fieldkit.steps.base import StepEntry
from fieldkit.steps.capabilities import DescribesActions, Roams, Summarizes
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.nest import Nest, steps_inside
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View


class RoamStep(Nest, DescribesActions, Roams, Summarizes):
    """Measures the handovers of a station between access points while the steps in `during` run.

    Exactly one `ping` from the robot must be inside, so that answers and link samples have times of the same clock.
    The access points are read from the samples of the robot's radio, about five per second. The resolution of a gap
    is the interval of the ping. A real robot needs `iw`; robots of a lab need
    [radio.access_points](method-radio.md#roaming) in the site file.

    Attributes:
        robot: Role of the robot that roams.
        ping_pong: A handover back to an access point within this time after leaving it is a ping-pong handover.
        during: Steps that run in order, usually a `move` with the `ping`.
    """

    cross_checks = (
        CrossCheck(
            quantity="access points",
            columns=("roam_ap_*", "roam_handovers", "roam_ping_pongs"),
            source="`ROLE-link.txt`, or `link.csv` of a lab",
            against=(),
            tolerance="only the driver of the robot reports its access point",
            outcome=CheckOutcome.UNCHECKED,
        ),
        CrossCheck(
            quantity="gaps of handovers",
            columns=("roam_gap_*", "roam_lost"),
            source="`ping.txt`, `ROLE-link.txt` or `link.csv`",
            against=("the summary of ping, and the captures, as for the other columns of the ping",),
            tolerance="a gap may differ by one interval of the ping",
        ),
    )

    robot: Role
    ping_pong: Annotated[Duration, Field(gt=0)] = 10.0
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @schema.model_validator(mode="after")
    def _has_one_ping(self) -> "RoamStep":
        if len(self._pings()) != 1:
            raise schema.validation_error(
                f"a roam needs exactly one ping from {self.robot} inside; it has {len(self._pings())}", "during"
            )
        return self

    def _pings(self) -> list[PingStep]:
        return [step for step in steps_inside(self) if isinstance(step, PingStep) and step.sender == self.robot]

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        yield from self.inside(scene)

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        yield f"the access points of {scene.robot(self.robot).name} are read from the samples of its radio"

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        for entry in self.during:
            entry.step.run(scene, testbed, announce)

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of handovers, which only trials with this step have."""
        return handovers.COLUMNS

    @override
    def measure(self, view: View) -> Measured:
        (step,) = self._pings()
        output = view.evidence.read_or_none(ping.read, step.ping_source().file)
        samples = view.evidence.links(self.robot)
        return handovers.measure(samples, output, step.interval, self.ping_pong)

    @override
    def roams(self) -> frozenset[Role]:
        return frozenset({self.robot})

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(count := values.get("roam_handovers"), int):
            yield format_count(count, "handover")
        if isinstance(gap_s := values.get("roam_gap_s"), float):
            yield f"gap {1e3 * gap_s:.0f} ms"

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self.inside_s(protocol)
