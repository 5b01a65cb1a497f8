"""Capture packets on both ends while other steps run."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Final

from fieldkit.config import Field, Int
from fieldkit.errors import RobotError
from fieldkit.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Announce, Planned, Scene, Shells, Step, together

if TYPE_CHECKING:
    from fieldkit.steps import Entry

# Immediate mode with the default snap length dropped 177 of 215 packets in a burst; with these, none (field notes).
SNAP_BYTES: Final = 128
BUFFER_KIB: Final = 4096

LIMIT_S: Final = 900.0


class Capture(Step):
    """tcpdump on each robot, up before the steps in `during` begin and drained after they end.

    The filter takes the port and every later fragment between the two ends: `port` alone sees first fragments only.

    Attributes:
        robots: Who captures.
        port: Port of the transfer.
        during: Steps to capture.
    """

    robots: Annotated[tuple[Role, ...], Field(min_length=1)] = (Role.SENDER, Role.RECEIVER)
    port: Annotated[Int, Field(gt=0, lt=65536)] = 1234
    during: Annotated[tuple["Entry", ...], Field(min_length=1)]

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        for role in self.robots:
            yield self._planned(scene, role)
        for entry in self.during:
            yield from entry.step.commands(scene)

    def _planned(self, scene: Scene, role: Role) -> Planned:
        profile = scene.robot(role).profile
        sender, receiver = scene.robot(Role.SENDER).address, scene.robot(Role.RECEIVER).address
        later_fragments = "ip[6:2] & 0x1fff != 0"
        options = ("-n", "-U", "--immediate-mode", "-s", str(SNAP_BYTES), "-B", str(BUFFER_KIB))
        job = Job(
            folder=scene.folder,
            name="capture",
            argv=(
                *(profile.tools.capture, "-i", profile.radio.interface, *options, "-w", f"{role}.pcap"),
                f"host {sender} and host {receiver} and (port {self.port} or {later_fragments})",
            ),
            limit_s=LIMIT_S,
            log=f"{role}-capture.log",
            ready="log:listening on",
            as_root=profile.tools.capture_right == "sudo",
        )
        return Planned(role, job, program=profile.tools.capture)

    def run(self, scene: Scene, shells: Shells, announce: Announce) -> None:
        """See `Step.run`."""
        captures = [self._planned(scene, role) for role in self.robots]
        announce("start captures", None)
        try:
            together(*(lambda one=one: jobs.start(shells[one.role], one.job) for one in captures))
            for entry in self.during:
                entry.step.run(scene, shells, announce)
        finally:
            announce("drain captures", None)
            codes = together(*(lambda one=one: self._stop(shells, one) for one in captures))
        for one, code in zip(captures, codes, strict=True):
            if code != 0:
                raise RobotError(
                    f"tcpdump ended with exit code {code}",
                    where=scene.robot(one.role).name,
                    remedy=f"see {one.job.log} of this repeat",
                )

    def _stop(self, shells: Shells, one: Planned) -> int:
        return jobs.stop(shells[one.role], one.job, signal="INT", settle=f"{one.role}.pcap")

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset(self.robots).union(*(entry.step.roles() for entry in self.during))

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return 0.2 + sum(entry.step.expected_s(protocol) for entry in self.during)
