"""Send a file from one robot to another with netcat."""

import math
from collections.abc import Iterator
from typing import Annotated

from fieldkit.config import Duration, Field, Int
from fieldkit.model import Protocol, Role
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Announce, Planned, Scene, Shells, Step

FileName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.-]{0,40}$")]


class Transfer(Step):
    """The paper's transfer: `nc -l -p PORT > recv.bag` on the receiver, `nc ADDRESS PORT < scan.bag` on the sender.

    A UDP listener never ends by itself, so it gets `-w` and null stdin; a TCP sender gets `-q 0`, without which it
    would never exit (field notes).

    Attributes:
        sender: Who sends (`from`).
        receiver: Who receives (`to`).
        file: The file sent, as the recorder left it.
        into: The file written by the receiver.
        port: Port that the receiver listens on.
        idle: A UDP listener ends after so many seconds without a datagram.
        limit: A transfer that takes longer is ended where it stands, and measured as it is.
    """

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    file: FileName = "scan.bag"
    into: FileName = "recv.bag"
    port: Annotated[Int, Field(gt=0, lt=65536)] = 1234
    idle: Annotated[Duration, Field(ge=1)] = 2.0
    limit: Annotated[Duration, Field(gt=0)] = 120.0

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        udp = scene.protocol is Protocol.UDP
        listen = (*("-u",) * udp, "-l", "-p", str(self.port), *("-w", str(math.ceil(self.idle))) * udp)
        send = (*("-u",) * udp, "-q", "0", scene.robot(self.receiver).address, str(self.port))
        listener, sender = (scene.robot(role).profile.tools.netcat for role in (self.receiver, self.sender))
        yield Planned(
            self.receiver,
            Job(
                folder=scene.folder,
                name="listen",
                argv=(listener, *listen),
                limit_s=self.limit,
                log=f"{self.receiver}-listen.log",
                stdout=self.into,
                ready=jobs.bound(scene.protocol, self.port),
            ),
            program=listener,
        )
        yield Planned(
            self.sender,
            Job(
                folder=scene.folder,
                name="send",
                argv=(sender, *send),
                limit_s=self.limit,
                log=f"{self.sender}-send.log",
                stdin=self.file,
            ),
            program=sender,
        )

    def run(self, scene: Scene, shells: Shells, announce: Announce) -> None:
        """See `Step.run`.

        Between the start of the sender and the end of the listener nothing crosses a control connection: the robots
        have accepted both commands by then, and report when they are asked.
        """
        listen, send = (planned.job for planned in self.commands(scene))
        receiver = shells[self.receiver]
        announce("transfer", self.expected_s(scene.protocol))
        jobs.start(receiver, listen)
        # Longer than the robot takes to end a listener at its limit, so that it never outlives the step.
        patience_s = self.limit + jobs.REPLY_S
        listening = jobs.begin_wait(receiver, listen, patience_s)
        sending = jobs.begin(shells[self.sender], send)
        listening.end(patience_s + jobs.REPLY_S)
        # A sender outlives its listener only where the transfer broke off; its own limit has then passed too.
        sending.end(jobs.REPLY_S)

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.sender, self.receiver})

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return 0.3 + (self.idle if protocol is Protocol.UDP else 0.0)
