"""Load the radio while other steps run; nobody measures the load."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Annotated, Final

from fieldkit.backends.protocols import Testbed
from fieldkit.config.schema import Field, Int
from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Nest, StepEntry
from fieldkit.steps.loads import PROGRAM, LoadOptions
from fieldkit.steps.scene import BY_FIELDKIT, BY_ITSELF, Announce, Flow, ListeningPort, Planned, Scene

LIMIT_S: Final = 900.0
"""For how long the load may outlast the limits of the steps inside."""

_FOREVER_S: Final = 86_400
"""The longest that iperf3 takes."""

# Says "flows" when 10 kB more have left by interface $1, and is the command after it. iperf3 itself says nothing of
# its packets before a second is over, and old versions nothing at all while their output is a file.
_FLOWS: Final = (
    'sent() { awk -v i="$1" \'{ sub(":", " ") } $1 == i { print $10 }\' /proc/net/dev; }; '
    '(from=$(sent "$1"); until [ "$(sent "$1")" -gt $((from + 10000)) ]; do sleep 0.1; done; echo flows >&2) & '
    'shift; exec "$@"'
)


class SoakStep(LoadOptions, Nest):
    """A load of iperf3 from one robot to another, from before the first step inside until after the last.

    Attributes:
        port: As for any load; another than that of an `iperf3` inside.
        during: The steps inside.
    """

    port: Annotated[Int, Field(gt=0, lt=65536)] = 5202
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        yield from self._load(scene)
        yield from self.inside(scene)

    def _load(self, scene: Scene) -> tuple[Planned, Planned]:
        """Return server and client."""
        limit_s = LIMIT_S + sum(planned.job.limit_s for planned in self.inside(scene))
        interface = scene.robot(self.sender).profile.radio.interface
        client = self.client(scene, "-t", str(_FOREVER_S))
        ends = {
            self.receiver: (self.server(), jobs.bound(Protocol.TCP, self.port)),
            self.sender: (("sh", "-c", _FLOWS, "sh", interface, *client), "log:flows"),
        }
        server, sender = (
            Planned(
                role,
                Job(scene.folder, self.own_name("soak"), argv, limit_s=limit_s, log=self._log(role), ready=ready),
                program=PROGRAM,
                # The server leaves when its client does.
                ends=BY_FIELDKIT | (BY_ITSELF if role == self.receiver else frozenset()),
            )
            for role, (argv, ready) in ends.items()
        )
        return server, sender

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        server, client = self._load(scene)
        announce("start load", None)
        try:
            for planned in (server, client):
                jobs.start(testbed.shells[planned.role], planned.job)
            for entry in self.during:
                entry.step.run(scene, testbed, announce)
        except FieldkitError:
            # What failed first is the reason; what never started cannot be stopped.
            for planned in (client, server):
                with suppress(FieldkitError):
                    jobs.stop(testbed.shells[planned.role], planned.job)
            raise
        for planned in (client, server):
            jobs.stop(testbed.shells[planned.role], planned.job)

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.sender, self.receiver}) | self.roles_inside()

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return 0.5 + self.inside_s(protocol)

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ("a soak",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return (self._log(self.sender), self._log(self.receiver))

    def _log(self, role: Role) -> str:
        return self.own_name(f"{role}-soak.log")

    def listens(self) -> tuple[ListeningPort, ...]:
        """See `Step.listens`."""
        return (ListeningPort(self.receiver, self.port, self.sender),)

    def flows(self, scene: Scene) -> Iterator[Flow]:
        """See `Step.flows`."""
        yield self.flow(scene.protocol, self.inside_s(scene.protocol) * self.expected_bit_s(scene.protocol) / 8)
