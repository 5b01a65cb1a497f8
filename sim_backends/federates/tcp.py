"""TCP connections between coordinator and federate: either side may listen, and either may be started first."""

import hmac
import ipaddress
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import ClosedError, DeadlineError, StreamChannel, socket_channel
from sim_backends.federates.frames import MAX_JOIN_BYTES, MalformedFrameError, MessageKind, encode
from sim_backends.federates.handshake import decode_join, encode_join

TOKEN_VARIABLE: Final = "FIELDKIT_FEDERATE_TOKEN"  # noqa: S105 (the variable's name)
_RETRY_S: Final = 0.05
_JOIN_S: Final = 5.0
"""Longest wait for the first message of a connection, which may come from any program."""


@dataclass(frozen=True)
class TcpAddress:
    """A TCP address.

    Attributes:
        host: Host name or IP address.
        port: Port.
        listens: True if this side listens; otherwise it connects.
    """

    host: str
    port: int
    listens: bool = False

    def __str__(self) -> str:
        return f"{'tcp-listen' if self.listens else 'tcp'}:{self.host}:{self.port}"


def parse_address(text: str) -> TcpAddress | None:
    """Return the address of `tcp:HOST:PORT` or `tcp-listen:HOST:PORT`; None if the text begins with neither.

    Raises:
        ConfigurationError: Host or port is missing, or the port is not a number.
    """
    scheme, _, rest = text.partition(":")
    if scheme not in {"tcp", "tcp-listen"}:
        return None
    host, _, port = rest.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigurationError(
            f"{text!r} is not an address", remedy="write for example tcp:127.0.0.1:7000 or tcp-listen:0.0.0.0:7000"
        )
    return TcpAddress(host.strip("[]"), int(port), listens=scheme == "tcp-listen")


def token(address: TcpAddress) -> str:
    """Return the token of a connection: the value of `TOKEN_VARIABLE`.

    Raises:
        ConfigurationError: There is none, and the address is not a loopback address.
    """
    value = os.environ.get(TOKEN_VARIABLE, "")
    if not value and not _is_loopback(address.host):
        raise ConfigurationError(
            f"{address} is not on this machine, and there is no token",
            remedy=f"set {TOKEN_VARIABLE} to the same secret text on both sides",
        )
    return value


def is_same_token(one: str, other: str) -> bool:
    """Return True if two tokens are equal, in constant time."""
    return hmac.compare_digest(one.encode(), other.encode())


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def connect(address: TcpAddress, deadline_s: float) -> StreamChannel:
    """Return a connection to a listening program; refused attempts are repeated.

    Args:
        address: Its address.
        deadline_s: Time of `time.monotonic` until which to try.

    Raises:
        DeadlineError: There was no connection in time.
    """
    while True:
        left_s = deadline_s - time.monotonic()
        try:
            connection = socket.create_connection((address.host, address.port), timeout=max(left_s, 0.001))
        except OSError as error:
            if time.monotonic() + _RETRY_S >= deadline_s:
                raise DeadlineError(f"no connection to {address}: {error}") from error
            time.sleep(_RETRY_S)
            continue
        return socket_channel(connection)


@contextmanager
def listening(address: TcpAddress) -> Iterator[socket.socket]:
    """Listen at an address.

    Raises:
        ConfigurationError: The address cannot be used.
    """
    try:
        server = socket.create_server(
            (address.host, address.port), family=socket.AF_INET6 if ":" in address.host else socket.AF_INET
        )
    except OSError as error:
        raise ConfigurationError(f"cannot listen at {address}: {error}", remedy="use another port") from error
    with server:
        yield server


def accept(server: socket.socket, deadline_s: float | None) -> StreamChannel:
    """Return the next connection.

    Raises:
        DeadlineError: There was none in time.
    """
    server.settimeout(None if deadline_s is None else max(deadline_s - time.monotonic(), 0.001))
    try:
        connection, _ = server.accept()
    except TimeoutError as error:
        raise DeadlineError("no program has connected") from error
    return socket_channel(connection)


def accept_federate(address: TcpAddress, expected_token: str, deadline_s: float) -> StreamChannel:
    """Return the connection of a federate, which begins with `join` and the token; others are closed.

    Args:
        address: Address at which to listen.
        expected_token: The token.
        deadline_s: Time of `time.monotonic` until which to wait.

    Raises:
        DeadlineError: No federate with this token has connected; the message has the reason of the last rejection.
    """
    rejection = ""
    with listening(address) as server:
        while True:
            try:
                channel = accept(server, deadline_s)
            except DeadlineError as error:
                raise DeadlineError(f"no federate has connected to {address}{rejection}") from error
            try:
                frame = channel.receive(min(deadline_s, time.monotonic() + _JOIN_S), MAX_JOIN_BYTES)
                if frame.header.kind is MessageKind.JOIN and is_same_token(decode_join(frame.body), expected_token):
                    return channel
                rejection = "; a program with a wrong token was rejected"
            except (ClosedError, DeadlineError, MalformedFrameError) as error:
                rejection = f"; a connection was rejected: {error}"
            channel.close()


def join(channel: StreamChannel, own_token: str, deadline_s: float) -> None:
    """Send the first message of a federate that has connected."""
    channel.send(encode(MessageKind.JOIN, 0, 0, encode_join(own_token)), deadline_s)
