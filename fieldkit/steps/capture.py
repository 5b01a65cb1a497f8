"""Capture packets on both ends while other steps run."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Final

from fieldkit.backends.protocols import Testbed
from fieldkit.config.schema import Field, Int
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Announce, Nest, Planned, Scene, together
from fieldkit.steps.variants import Tool

if TYPE_CHECKING:
    from fieldkit.steps import Entry

# Immediate mode with the default snap length dropped 177 of 215 packets in a burst; with these, none (field notes).
SNAP_BYTES: Final = 128
BUFFER_KIB: Final = 4096

LIMIT_S: Final = 900.0

# Without immediate mode the kernel hands a packet over within a second: of 215, none 0.5 s later, all 1.0 s later.
RING_S: Final = 2


class Capture(Nest):
    """tcpdump on each robot, up before the steps in `during` begin and drained after they end.

    The filter takes the port and every later fragment between the two ends: `port` alone sees first fragments only.
    It takes ICMP too, of a ping inside: a UDP transfer has no answer, and only packets in both directions tell the
    offset between two clocks.

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
        yield from self.inside(scene)

    def _planned(self, scene: Scene, role: Role) -> Planned:
        profile = scene.robot(role).profile
        sender, receiver = scene.robot(Role.SENDER).address, scene.robot(Role.RECEIVER).address
        later_fragments = "ip[6:2] & 0x1fff != 0"
        immediate = ("--immediate-mode",) if scene.tools(role).immediate_mode else ()
        options = ("-n", "-U", *immediate, "-s", str(SNAP_BYTES), "-B", str(BUFFER_KIB))
        job = Job(
            folder=scene.folder,
            name="capture",
            argv=(
                *(profile.tools.capture, "-i", profile.radio.interface, *options, "-w", f"{role}.pcap"),
                f"host {sender} and host {receiver} and (port {self.port} or icmp or {later_fragments})",
            ),
            # Never sooner than what it captures: a capture that ends at its limit looks whole.
            limit_s=LIMIT_S + sum(one.job.limit_s for one in self.inside(scene)),
            log=f"{role}-capture.log",
            ready="log:listening on",
            as_root=profile.tools.capture_right == "sudo",
        )
        return Planned(role, job, program=profile.tools.capture, tool=Tool.CAPTURE)

    def run(self, scene: Scene, lab: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        captures = [self._planned(scene, role) for role in self.robots]
        announce("start captures", None)
        try:
            together(lambda one: jobs.start(lab.shells[one.role], one.job), captures)
            for entry in self.during:
                entry.step.run(scene, lab, announce)
        except FieldkitError:
            # What was captured is kept with the attempt that failed.
            self._stop(scene, lab, captures)
            raise
        announce("drain captures", None)
        for one, code in zip(captures, self._stop(scene, lab, captures), strict=True):
            if code != 0:
                raise RobotError(
                    f"tcpdump ended with exit code {code}",
                    where=scene.robot(one.role).name,
                    remedy=f"see {one.job.log} of this repeat",
                )

    def _stop(self, scene: Scene, lab: Testbed, captures: Sequence[Planned]) -> list[int]:
        def stop(one: Planned) -> int:
            if not scene.tools(one.role).immediate_mode:
                jobs.begin_wait(lab.shells[one.role], one.job, RING_S).end(RING_S + jobs.REPLY_S)
            return jobs.stop(lab.shells[one.role], one.job, signal="INT", settle=f"{one.role}.pcap")

        return together(stop, captures)

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset(self.robots) | self.roles_inside()

    def leaves(self) -> tuple[str, ...]:
        """See `Step.leaves`."""
        return tuple(f"a capture on {role}" for role in self.robots)

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return 0.2 + self.inside_s(protocol)
