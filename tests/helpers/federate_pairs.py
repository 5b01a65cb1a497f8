"""Federates that a thread of the test serves over a pair of sockets; the test can change the frames they send."""

import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sim_backends.federates.answering import FederateService, _Run
from sim_backends.federates.channels import StreamChannel
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.handshake import AgentStart, Hello, Welcome
from sim_backends.federates.session import FederateSession
from sim_backends.world.motion import State


def now_s() -> float:
    """Return the time since boot, in seconds."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def children(since_s: float) -> set[int]:
    """Return the process ids of this process's children that were started after a time since boot.

    A pytest worker also adopts older processes of earlier tests.
    """
    pids = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text(encoding="utf-8").rpartition(")")[2].split()
            parent, started_s = int(fields[1]), (int(fields[19]) + 1) / os.sysconf("SC_CLK_TCK")
            if parent == os.getpid() and started_s >= since_s:
                pids.add(int(path.parent.name))
    return pids


Alter = Callable[[bytes], bytes | None]
"""Returns the frame that is sent in place of a frame, or None to send nothing."""

HELLO = Hello(
    PHYSICS,
    [
        AgentStart("ann", "husky", State((0.0, 0.0, 0.0), heading_rad=0.0), limit_m_s2=3.0),
        AgentStart("bob", "husky", State((5.0, 3.0, 0.0), heading_rad=1.0), limit_m_s2=3.0),
        AgentStart("cy", "iris", State((9.0, 0.0, 4.0), heading_rad=0.0), flies=True, limit_m_s2=9.0),
    ],
    end_ns=10_000_000_000,
    name="three robots",
)


class AlteredChannel(StreamChannel):
    """A channel that changes or drops the frames that a federate sends."""

    alter: Alter | None = None

    def send(self, frame: bytes, deadline_s: float | None) -> None:
        altered_frame = frame if self.alter is None else self.alter(frame)
        if altered_frame is not None:
            super().send(altered_frame, deadline_s)


@dataclass
class Pair:
    """Opens sessions with federates that threads serve.

    Attributes:
        service: The federate.
        deadline_s: Longest time to wait for a frame after the handshake.
        alter: Changes its frames; None removes a frame.
        run_class: The class that answers requests.
        stays_open: True if it does not close the connection at its end.
    """

    service: FederateService
    deadline_s: float = 20.0
    alter: Alter | None = None
    stays_open: bool = False
    run_class: type[_Run] = _Run

    def __call__(self, hello: Hello) -> tuple[FederateSession, Hello, Welcome]:
        """Return a session with a fresh federate."""
        coordinator_end, federate_end = (channel_of(side) for side in socket.socketpair())
        federate_end.alter = self.alter
        threading.Thread(target=self._serve, args=(federate_end,), daemon=True).start()
        session = FederateSession(hello.role, "test", coordinator_end, deadline_s=20.0)
        welcome = session.welcome(hello)
        session._deadline_s = self.deadline_s  # set here, because a busy machine may need longer for the handshake
        return session, hello, welcome

    def _serve(self, channel: StreamChannel) -> None:
        self.run_class(self.service, channel, "").serve()
        if self.stays_open:
            threading.Event().wait(60)
        channel.close()


def channel_of(side: socket.socket) -> AlteredChannel:
    """Return a channel that owns a socket and transmits through it."""
    fd = side.detach()
    return AlteredChannel(fd, fd)
