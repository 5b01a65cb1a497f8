"""Measure round-trip times with ping."""

from collections.abc import Iterable, Iterator
from typing import Annotated, Final

from fieldkit.backends.protocols import Testbed
from fieldkit.config.schema import Duration, Field, Int, Strict
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Announce, Planned, Refusal, Scene, Step
from fieldkit.steps.variants import PingTool, Tool

LAST_REPLY_S: Final = 2
OLD_INTERVAL_S: Final = 0.2

Payload = Annotated[Int, Field(ge=0, le=65507)]


def command_line(scene: Scene, role: Role, options: Iterable[str], address: str) -> tuple[str, ...]:
    """Return how the robot in `role` pings `address`, for output that can be read: no names, time stamps, English."""
    # busybox has no time stamps, and resolves no names anyway.
    stamps = () if scene.tools(role).ping is PingTool.BUSYBOX else ("-n", "-D")
    return ("env", "LC_ALL=C", scene.robot(role).profile.tools.ping, *stamps, *options, address)


class Payloads(Strict):
    """ICMP payload in bytes per protocol; the defaults are what the paper calls each protocol's window.

    Attributes:
        tcp: For TCP repeats.
        udp: For UDP repeats.
    """

    tcp: Payload = 502
    udp: Payload = 8192


class Ping(Step):
    """ping with raw lines kept.

    Attributes:
        sender: Who asks (`from`).
        receiver: Who answers (`to`).
        count: Echo requests.
        interval: Seconds between them; below 0.2 s iputils before 20210722 needs root.
        payload_bytes: ICMP payload per protocol.
    """

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    count: Annotated[Int, Field(gt=0)] = 10
    interval: Annotated[Duration, Field(ge=0.002)] = 0.2
    payload_bytes: Payloads = Payloads()

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        payload = self.payload_bytes.udp if scene.protocol is Protocol.UDP else self.payload_bytes.tcp
        options = ("-c", str(self.count), "-i", f"{self.interval:g}", "-s", str(payload), "-W", str(LAST_REPLY_S))
        yield Planned(
            self.sender,
            Job(
                folder=scene.folder,
                name="ping",
                argv=command_line(scene, self.sender, options, scene.robot(self.receiver).address),
                limit_s=self.count * self.interval + LAST_REPLY_S + 10.0,
                log=f"{self.sender}-ping.log",
                stdout="ping.txt",
            ),
            program=scene.robot(self.sender).profile.tools.ping,
            tool=Tool.PING,
        )

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`."""
        tools = scene.tools(self.sender)
        if tools.ping is PingTool.IPUTILS_OLD and not tools.root and self.interval < OLD_INTERVAL_S:
            yield Refusal(
                self.sender,
                f"its ping lets only root send every {1e3 * self.interval:g} ms (iputils before 20210722)",
                "interval: 200ms in the procedure, or user: root in the site file",
            )

    def run(self, scene: Scene, lab: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        (planned,) = self.commands(scene)
        announce("ping", self.expected_s(scene.protocol))
        code = jobs.run(lab.shells[self.sender], planned.job)
        if code not in {0, 1}:  # 1: some or all replies are missing, which is a measurement
            raise RobotError(
                f"ping ended with exit code {code}",
                where=scene.robot(self.sender).name,
                remedy=f"see {planned.job.log} of this repeat",
            )

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.sender, self.receiver})

    def leaves(self) -> tuple[str, ...]:
        """See `Step.leaves`."""
        return ("a ping",)

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """See `Step.expected_s`."""
        return (self.count - 1) * self.interval
