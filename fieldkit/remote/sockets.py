"""TCP sockets of SSH connections: their connection, and the timeouts after which the kernel closes them."""

import socket
from collections.abc import Callable
from dataclasses import dataclass

Connect = Callable[[float], socket.socket]
"""Returns a new socket connected to the robot's SSH server; raises OSError after the given timeout in seconds."""


@dataclass(frozen=True)
class Timing:
    """Timeouts of an SSH connection. The kernel closes a connection after about `probe_s` + `dead_s` without answers.

    Attributes:
        connect_s: Timeout from name resolution to the end of the login. It is shorter than the 10 s within which a
            lost link must be reported, because the loss of an unused link is detected late.
        probe_s: Silence after which the kernel sends keepalive probes, in whole seconds.
        dead_s: Age of unacknowledged data at which the connection is lost. With SSH keepalives alone, paramiko
            reported a dead connection as active for more than 25 s in field tests.
        reply_s: Minimum remaining time of a repeated command.
        pause_s: First pause between attempts to reconnect; it is doubled after each attempt, up to `probe_s`.
    """

    connect_s: float = 8.0
    probe_s: int = 2
    dead_s: float = 5.0
    reply_s: float = 10.0
    pause_s: float = 0.2


def over_tcp(host: str, port: int) -> Connect:
    """Return a function that connects to an SSH server over this computer's network."""
    return lambda timeout_s: socket.create_connection((host, port), timeout=timeout_s)


def enable_keepalive(stream: socket.socket, timing: Timing) -> None:
    """Make the kernel close the connection if the peer does not answer, also while no data is sent.

    Small packets are then also sent without a delay (TCP_NODELAY).
    """
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    set_timeout(stream, timing.dead_s)
    stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, timing.probe_s)
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, timing.probe_s)


def set_timeout(stream: socket.socket, seconds: float) -> None:
    """Set the maximum age of unacknowledged data or probes; Linux then ignores the number of probes (tcp(7))."""
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(seconds * 1000))
