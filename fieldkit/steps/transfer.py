"""Send a file from one robot to another with netcat."""

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Annotated, Final

from fieldkit.backends.protocols import Testbed
from fieldkit.config.schema import Duration, Field, Int
from fieldkit.core.errors import RobotError
from fieldkit.core.model import DelayParts, Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps import netcat
from fieldkit.steps.base import Announce, Planned, Refusal, Scene, Step
from fieldkit.steps.variants import Netcat, Tool

FileName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.-]{0,40}$")]
BagName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.-]{0,40}(/[a-z][a-z0-9_.-]{0,40})?$")]

DELAYS: Final = "medium.txt"

_TRADITIONAL: Final = "sudo apt-get install netcat-traditional, and netcat: nc.traditional in its profile"


def delays_text(before: DelayParts, after: DelayParts) -> str:
    """Return what came to `before` until `after`, a line per number: `packets 215`, then the parts in ns."""
    return "".join(
        f"{item.name} {getattr(after, item.name) - getattr(before, item.name)}\n" for item in fields(after)
    )


class Transfer(Step):
    """The paper's transfer: `nc -l -p PORT > recv.bag` on the receiver, `nc ADDRESS PORT < scan.bag` on the sender.

    What is typed depends on the netcats that the robots have: `fieldkit.steps.netcat`.

    Attributes:
        sender: Who sends (`from`).
        receiver: Who receives (`to`).
        file: The file sent; None for the bag that the procedure records on the sender.
        into: The file written by the receiver.
        port: Port that the receiver listens on.
        idle: A UDP listener ends after so many seconds without a datagram.
        limit: A transfer that takes longer is ended where it stands, and measured as it is.
    """

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    file: BagName | None = None
    into: FileName = "recv.bag"
    port: Annotated[Int, Field(gt=0, lt=65536)] = 1234
    idle: Annotated[Duration, Field(ge=1)] = 2.0
    limit: Annotated[Duration, Field(gt=0)] = 120.0

    def sent(self, bags: Mapping[Role, str]) -> str:
        """Return the name of the file sent, given the bag that is recorded on each robot."""
        return self.file or bags[self.sender]

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        listener, sender = (scene.robot(role).profile.tools.netcat for role in (self.receiver, self.sender))
        theirs, ours = scene.tools(self.receiver).netcat, scene.tools(self.sender).netcat
        address = scene.robot(self.receiver).address
        yield Planned(
            self.receiver,
            Job(
                folder=scene.folder,
                name="listen",
                argv=netcat.listen(theirs, listener, scene.protocol, self.port, math.ceil(self.idle)),
                limit_s=self.limit,
                log=f"{self.receiver}-listen.log",
                stdout=self.into,
                ready=jobs.bound(scene.protocol, self.port),
            ),
            program=listener,
            tool=Tool.NETCAT,
        )
        yield Planned(
            self.sender,
            Job(
                folder=scene.folder,
                name="send",
                argv=netcat.send(ours, sender, scene.protocol, address, self.port),
                limit_s=self.limit,
                log=f"{self.sender}-send.log",
                stdin=self.sent(scene.bags),
            ),
            program=sender,
            tool=Tool.NETCAT,
        )

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`."""
        if scene.protocol is not Protocol.UDP:
            return
        ends = {role: scene.tools(role).netcat for role in (self.sender, self.receiver)}
        for role, kind in ends.items():
            if kind is Netcat.BUSYBOX:
                yield Refusal(role, "busybox nc has no UDP", _TRADITIONAL)
        if netcat.cut_short(ends[self.sender], ends[self.receiver]):
            size = netcat.DATAGRAM_BYTES[ends[self.sender]]
            what = f"its netcat cuts off the datagrams of {size} bytes that the sender's sends"
            yield Refusal(
                self.receiver, what, "sudo apt-get install netcat-openbsd, and netcat: nc.openbsd in its profile"
            )

    def run(self, scene: Scene, lab: Testbed, announce: Announce) -> None:
        """See `Step.run`.

        Between the start of the sender and the end of the listener nothing crosses a control connection: the robots
        have accepted both commands by then, and report when they are asked.
        """
        oracle = lab.oracle
        before = None if oracle is None else oracle.delays(self.sender, self.receiver)
        listen, send = (planned.job for planned in self.commands(scene))
        receiver = lab.shells[self.receiver]
        announce("transfer", self.expected_s(scene.protocol))
        started_s = time.monotonic()
        jobs.start(receiver, listen)
        # Longer than the robot takes to end a listener at its limit, so that it never outlives the step.
        patience_s = self.limit + jobs.REPLY_S
        listening = jobs.begin_wait(receiver, listen, patience_s)
        sending = jobs.begin(lab.shells[self.sender], send)
        if scene.protocol is Protocol.UDP:
            self._demand_listener(time.monotonic() - started_s, scene)
        listening.end(patience_s + jobs.REPLY_S)
        # A sender outlives its listener only where the transfer broke off; its own limit has then passed too.
        sending.end(jobs.REPLY_S)
        if oracle is not None and before is not None and scene.here is not None:
            after = oracle.delays(self.sender, self.receiver)
            (scene.here / DELAYS).write_text(delays_text(before, after), encoding="ascii")

    def _demand_listener(self, waited_s: float, scene: Scene) -> None:
        """Tell a listener that was gone before the sender began from a radio that lost everything."""
        if waited_s >= self.idle:
            raise RobotError(
                f"sending began up to {waited_s:.1f} s after listening, which ends after {self.idle:g} s of silence",
                where=scene.robot(self.sender).name,
                remedy="look at the control link; a larger `idle` in the procedure leaves it more time",
            )

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.sender, self.receiver})

    def leaves(self) -> tuple[str, ...]:
        """See `Step.leaves`."""
        return ("a transfer", f"the file {self.into}", f"the file {DELAYS}")

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return 0.3 + (self.idle if protocol is Protocol.UDP else 0.0)
