"""Load the radio while other steps run, and measure only the stalls of the load."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Annotated, ClassVar, Final

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config.schema import Field, Int
from fieldkit.core.columns import Column, Measured
from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.transfers import iperf3_load, recoveries, stalls
from fieldkit.measure.transfers.deliveries import StreamDeliveries
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps import across
from fieldkit.steps.base import StepEntry
from fieldkit.steps.capabilities import Listens, SendsTraffic
from fieldkit.steps.loads import PROGRAM, LoadOptions
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import BY_EXIT, BY_FIELDKIT, Announce, Flow, ListeningPort, Planned, Scene
from fieldkit.steps.view import View

LIMIT_S: Final = 900.0
"""Time limit of the load in addition to the limits of the steps inside."""

_MAX_DURATION_S: Final = 86_400
"""Maximum duration that iperf3 accepts."""

_START_S: Final = 0.5
"""Approximate time in which server and client start and are stopped."""

_STALLS: Final = stalls.declare_columns("soak", "the load", rank=69)

# Executes the command in $2 and later arguments, and prints "flows" when interface $1 has sent 10 kB. iperf3 itself
# reports its packets only after a second. If its output is a file, old versions report nothing until they exit.
_CLIENT_SCRIPT: Final = (
    'sent() { awk -v i="$1" \'{ sub(":", " ") } $1 == i { print $10 }\' /proc/net/dev; }; '
    '(from=$(sent "$1"); until [ "$(sent "$1")" -gt $((from + 10000)) ]; do sleep 0.1; done; echo flows >&2) & '
    'shift; exec "$@"'
)


class SoakStep(LoadOptions, Nest, Listens, SendsTraffic):
    """Loads the radio while the steps in `during` run: iperf3 sends until the last of them has ended.

    Only the [stalls](method-delay.md#stalls-of-a-flow) of the load, and its [recovery](method-delay.md#recovery) from
    faults inside, are measured. Both robots need iperf3 3.1 or later. A load that ends early makes the repeat void.
    Writes `ROLE-soak.log`.

    Attributes:
        port: Port that the receiver listens on; it must differ from the port of an `iperf3` inside to the same robot.
        during: Steps that run in order while the load is sent.
    """

    flow_kind: ClassVar[str] = "soak"
    cross_checks = (*stalls.cross_checks("soak"), *recoveries.CROSS_CHECKS)

    port: Annotated[Int, Field(gt=0, lt=65536)] = 5202
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        yield from self._load(scene)
        yield from self.inside(scene)

    def _load(self, scene: Scene) -> tuple[Planned, Planned]:
        """Return the jobs of server and client."""
        limit_s = LIMIT_S + sum(planned.job.limit_s for planned in self.inside(scene))
        interface = scene.link(self.sender, self.over).interface
        client_command = self.client_command(scene, "-t", str(_MAX_DURATION_S))
        ends = {
            self.receiver: (self.server_command(), jobs.ready_when_bound(Protocol.TCP, self.port)),
            self.sender: (("sh", "-c", _CLIENT_SCRIPT, "sh", interface, *client_command), "log:flows"),
        }
        server, client = (
            Planned(
                role,
                Job(
                    scene.folder, self.prefixed_name("soak"), argv, limit_s=limit_s, log=self._log(role), ready=ready
                ),
                program=PROGRAM,
                # The server exits after its client.
                permitted_causes=BY_FIELDKIT | (BY_EXIT if role == self.receiver else frozenset()),
            )
            for role, (argv, ready) in ends.items()
        )
        return server, client

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        server, client = self._load(scene)
        announce("start load", None)
        try:
            for planned in (server, client):
                jobs.start(testbed.shells[planned.role], planned.job)
            for entry in self.during:
                entry.step.run(scene, testbed, announce)
        except FieldkitError:
            # The first error is the cause of the failure; a job that was never started cannot be stopped.
            for planned in (client, server):
                with suppress(FieldkitError):
                    jobs.stop(testbed.shells[planned.role], planned.job)
            raise
        for planned in (client, server):
            jobs.stop(testbed.shells[planned.role], planned.job)

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return _START_S + self.inside_s(protocol)

    @override
    def files(self) -> tuple[str, ...]:
        return (self._log(self.sender), self._log(self.receiver))

    def _log(self, role: Role) -> str:
        return self.prefixed_name(f"{role}-soak.log")

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of stalls, and of the recoveries from faults inside."""
        return (*_STALLS, *across.recovery_columns(self))

    @override
    def measure(self, view: View) -> Measured:
        return stalls.measure("soak", lambda: self.deliveries(view)) | across.measure(self, view)

    @property
    def destination(self) -> Role:
        """Role of the receiving robot."""
        return self.receiver

    def deliveries(self, view: View) -> Sequence[StreamDeliveries]:
        """Return the deliveries of each stream; see `SendsFlow.deliveries`."""
        source, destination = (view.capture(role) for role in (self.sender, self.receiver))
        load = self.data_streams(view.scene)
        return iperf3_load.read_deliveries(
            load, source.packets if source else None, destination.packets if destination else None
        )

    @override
    def listens(self) -> tuple[ListeningPort, ...]:
        return (ListeningPort(self.receiver, self.port, self.sender),)

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        yield self.flow(scene.protocol, self.inside_s(scene.protocol) * self.expected_bit_s(scene.protocol) / 8)
