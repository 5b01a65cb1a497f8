"""The transport over UDP: numbered datagrams that are acknowledged and resent (`datagrams`).

The listening side keeps no state until a program has returned the cookie that was sent to its address, so that a
program with a forged address cannot open a connection, as in RFC 6347, section 4.2.1.
"""

import hashlib
import secrets
import select
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import DeadlineError
from sim_backends.federates.transports.contract import FederateTransport, HostAndPort, split_host_and_port
from sim_backends.federates.transports.datagrams import (
    DatagramChannel,
    DatagramHeader,
    DatagramKind,
    pack_datagram,
    unpack_datagram,
)

_RETRY_S: Final = 0.05
"""First interval at which a connection is requested again; it doubles up to `_MAX_RETRY_S`."""
_MAX_RETRY_S: Final = 1.0


class UdpListener:
    """Accepts connections.

    A connection takes over the socket that listened, so that the other side always uses the same port. The next call
    of `accept` opens another socket. While a connection exists, other programs are refused and try again.

    Args:
        address: The address.
    """

    def __init__(self, address: "UdpAddress") -> None:
        self._address = address
        self._socket: socket.socket | None = address.bound_socket()
        self._secret = secrets.token_bytes(16)

    def close(self) -> None:
        """Stop listening."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def accept(self, deadline_s: float | None) -> DatagramChannel:
        """Implement `ChannelListener.accept`."""
        if self._socket is None:
            self._socket = self._address.bound_socket()
            self._secret = secrets.token_bytes(16)  # cookies of earlier connections are invalid
        while True:
            remaining_s = None if deadline_s is None else max(deadline_s - time.monotonic(), 0)
            if not select.select([self._socket], [], [], remaining_s)[0]:
                raise DeadlineError("no program has connected")
            try:
                datagram, peer = self._socket.recvfrom(65536)
            except OSError:
                continue
            channel = self._handle(self._socket, datagram, peer)
            if channel is not None:
                self._socket = None
                return channel

    def _handle(self, endpoint: socket.socket, datagram: bytes, peer: Any) -> DatagramChannel | None:  # noqa: ANN401 (an address)
        header = unpack_datagram(datagram)
        if header is None:
            return None
        cookie = self._cookie(header.connection, peer)
        if header.kind is DatagramKind.OPEN:
            with suppress(OSError):
                endpoint.sendto(pack_datagram(DatagramHeader(DatagramKind.COOKIE, header.connection, cookie)), peer)
        if header.kind is not DatagramKind.DATA or header.cookie != cookie:
            return None
        endpoint.connect(peer)
        channel = DatagramChannel(endpoint, header.connection, cookie)
        channel.handle(datagram)
        return channel

    def _cookie(self, connection: int, peer: object) -> int:
        text = f"{connection} {peer}".encode()
        return int.from_bytes(hashlib.blake2b(text, digest_size=8, key=self._secret).digest(), "little")


@dataclass(frozen=True)
class UdpAddress(HostAndPort):
    """A UDP address."""

    def bound_socket(self) -> socket.socket:
        """Return a socket that is bound to the address.

        Raises:
            ConfigurationError: The address cannot be used.
        """
        endpoint = socket.socket(socket.AF_INET6 if ":" in self.host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            endpoint.bind((self.host, self.port))
        except OSError as error:
            endpoint.close()
            raise ConfigurationError(
                f"cannot listen at {self}: {error}", remedy="use another port or host"
            ) from error
        return endpoint

    def connect(self, deadline_s: float) -> DatagramChannel:
        """Implement `TransportAddress.connect`."""
        connection = secrets.randbits(64)
        retry_s, problem = _RETRY_S, "no answer"
        while time.monotonic() < deadline_s:
            try:
                family, _, _, _, peer = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_DGRAM)[0]
                endpoint = socket.socket(family, socket.SOCK_DGRAM)
            except OSError as error:
                problem = str(error)
                time.sleep(_RETRY_S)
                continue
            try:
                endpoint.connect(peer)
                limit_s = min(time.monotonic() + retry_s, deadline_s)
                if (cookie := _request_cookie(endpoint, connection, limit_s)) is not None:
                    return DatagramChannel(endpoint, connection, cookie)
                retry_s = min(2 * retry_s, _MAX_RETRY_S)
            except OSError as error:
                problem = str(error)
                time.sleep(_RETRY_S)
            endpoint.close()
        raise DeadlineError(f"no connection to {self}: {problem}")

    @contextmanager
    def listen(self) -> Iterator[UdpListener]:
        """Implement `TransportAddress.listen`."""
        listener = UdpListener(self)
        try:
            yield listener
        finally:
            listener.close()


def _request_cookie(endpoint: socket.socket, connection: int, limit_s: float) -> int | None:
    """Return the cookie for a connection, or None if there was no answer in time.

    Raises:
        OSError: The connection is refused.
    """
    endpoint.send(pack_datagram(DatagramHeader(DatagramKind.OPEN, connection)))
    while (remaining_s := limit_s - time.monotonic()) > 0 and select.select([endpoint], [], [], remaining_s)[0]:
        header = unpack_datagram(endpoint.recv(65536))
        if header is not None and header.kind is DatagramKind.COOKIE and header.connection == connection:
            return header.cookie
    return None


TRANSPORT: Final = FederateTransport(
    ("udp:HOST:PORT", "udp-listen:HOST:PORT"),
    "udp:127.0.0.1:7000 or udp-listen:0.0.0.0:7000",
    lambda text: UdpAddress(*split_host_and_port(text)),
)
