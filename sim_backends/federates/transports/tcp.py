"""The transport over TCP: the frames follow each other in the byte stream of a connection."""

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import DeadlineError, StreamChannel, socket_channel
from sim_backends.federates.transports.contract import FederateTransport, HostAndPort, split_host_and_port

_RETRY_S: Final = 0.05
"""Pause after a failed attempt to connect."""


class TcpListener:
    """Accepts connections.

    Args:
        server: The socket that listens.
    """

    def __init__(self, server: socket.socket) -> None:
        self._server = server

    def accept(self, deadline_s: float | None) -> StreamChannel:
        """Implement `ChannelListener.accept`."""
        self._server.settimeout(None if deadline_s is None else max(deadline_s - time.monotonic(), 0.001))
        try:
            connection, _ = self._server.accept()
        except TimeoutError as error:
            raise DeadlineError("no program has connected") from error
        return socket_channel(connection)


@dataclass(frozen=True)
class TcpAddress(HostAndPort):
    """A TCP address."""

    def connect(self, deadline_s: float) -> StreamChannel:
        """Implement `TransportAddress.connect`; failed attempts are repeated until the deadline."""
        while True:
            remaining_s = deadline_s - time.monotonic()
            try:
                connection = socket.create_connection((self.host, self.port), timeout=max(remaining_s, 0.001))
            except OSError as error:
                if time.monotonic() + _RETRY_S >= deadline_s:
                    raise DeadlineError(f"no connection to {self}: {error}") from error
                time.sleep(_RETRY_S)
                continue
            return socket_channel(connection)

    @contextmanager
    def listen(self) -> Iterator[TcpListener]:
        """Implement `TransportAddress.listen`."""
        try:
            server = socket.create_server(
                (self.host, self.port), family=socket.AF_INET6 if ":" in self.host else socket.AF_INET
            )
        except OSError as error:
            raise ConfigurationError(
                f"cannot listen at {self}: {error}", remedy="use another port or host"
            ) from error
        with server:
            yield TcpListener(server)


TRANSPORT: Final = FederateTransport(
    ("tcp:HOST:PORT", "tcp-listen:HOST:PORT"),
    "tcp:127.0.0.1:7000 or tcp-listen:0.0.0.0:7000",
    lambda text: TcpAddress(*split_host_and_port(text)),
)
