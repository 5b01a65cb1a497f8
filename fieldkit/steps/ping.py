"""Measure round-trip times with ping."""

from collections.abc import Iterator
from typing import Annotated, Final

from fieldkit.config import Duration, Field, Int, Strict
from fieldkit.errors import RobotError
from fieldkit.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Announce, Planned, Scene, Shells, Step

LAST_REPLY_S: Final = 2

Payload = Annotated[Int, Field(ge=0, le=65507)]


class Payloads(Strict):
    """ICMP payload in bytes per protocol; the defaults are what the paper calls each protocol's window.

    Attributes:
        tcp: For TCP repeats.
        udp: For UDP repeats.
    """

    tcp: Payload = 502
    udp: Payload = 8192


class Ping(Step):
    """iputils ping with raw lines kept.

    Attributes:
        sender: Who asks (`from`).
        receiver: Who answers (`to`).
        count: Echo requests.
        interval: Seconds between them; below 0.2 s old iputils needs root.
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
        tool = scene.robot(self.sender).profile.tools.ping
        yield Planned(
            self.sender,
            Job(
                folder=scene.folder,
                name="ping",
                argv=(
                    *("env", "LC_ALL=C", tool, "-n", "-D", *options),
                    scene.robot(self.receiver).address,
                ),
                limit_s=self.count * self.interval + LAST_REPLY_S + 10.0,
                log=f"{self.sender}-ping.log",
                stdout="ping.txt",
            ),
            program=tool,
        )

    def run(self, scene: Scene, shells: Shells, announce: Announce) -> None:
        """See `Step.run`."""
        (planned,) = self.commands(scene)
        announce("ping", self.expected_s(scene.protocol))
        code = jobs.run(shells[self.sender], planned.job)
        if code not in {0, 1}:  # 1: some or all replies are missing, which is a measurement
            raise RobotError(
                f"ping ended with exit code {code}",
                where=scene.robot(self.sender).name,
                remedy=f"see {planned.job.log} of this repeat",
            )

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.sender, self.receiver})

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """See `Step.expected_s`."""
        return (self.count - 1) * self.interval
