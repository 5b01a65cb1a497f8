"""The interface of a transport between coordinator and federate: an address that can connect or listen."""

import hmac
import ipaddress
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Final, Protocol

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import FrameChannel

TOKEN_VARIABLE: Final = "FIELDKIT_FEDERATE_TOKEN"  # noqa: S105 (the variable's name)


class ChannelListener(Protocol):
    """Accepts channels, one at a time."""

    def accept(self, deadline_s: float | None) -> FrameChannel:
        """Return the next channel.

        Args:
            deadline_s: Time of `time.monotonic` until which to wait; None for no deadline.

        Raises:
            DeadlineError: No program has connected in time.
        """
        ...


class TransportAddress(Protocol):
    """An address of a transport; `str` returns its text for messages.

    Attributes:
        listens: True if the side that has this address listens, False if it connects; None if the federate listens
            and the coordinator connects, with the same address on both sides.
        is_loopback: True if only programs on this machine can use it.
    """

    @property
    def listens(self) -> bool | None: ...  # noqa: D102 (see above)

    @property
    def is_loopback(self) -> bool: ...  # noqa: D102 (see above)

    def connect(self, deadline_s: float) -> FrameChannel:
        """Return a channel to the program that listens, which may start later.

        Args:
            deadline_s: Time of `time.monotonic` until which to try.

        Raises:
            ConfigurationError: The transport cannot be used.
            DeadlineError: No program listened in time.
        """
        ...

    def listen(self) -> AbstractContextManager[ChannelListener]:
        """Return a listener.

        Raises:
            ConfigurationError: The address cannot be used.
        """
        ...


@dataclass(frozen=True)
class FederateTransport:
    """A kind of connection between coordinator and federate, for example TCP.

    Attributes:
        forms: Forms of its addresses, which begin with its schemes: `tcp:HOST:PORT`.
        example: An address.
        parse: Returns the address of a text that begins with one of its schemes; `ValueError` if it is invalid.
    """

    forms: Sequence[str]
    example: str
    parse: Callable[[str], TransportAddress]


def read_token(address: TransportAddress) -> str:
    """Return the token of a connection: the value of `TOKEN_VARIABLE`.

    Raises:
        ConfigurationError: There is no token, but other machines can use the address.
    """
    value = os.environ.get(TOKEN_VARIABLE, "")
    if not value and not address.is_loopback:
        raise ConfigurationError(
            f"other machines can use {address}, but there is no token",
            remedy=f"set {TOKEN_VARIABLE} to the same secret text on both sides",
        )
    return value


def is_same_token(first: str, second: str) -> bool:
    """Return True if two tokens are equal. The duration of the comparison reveals no token."""
    return hmac.compare_digest(first.encode(), second.encode())


def is_loopback(host: str) -> bool:
    """Return True if a host is `localhost` or a loopback address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class HostAndPort:
    """An address with a port; the side that listens has the scheme `SCHEME-listen`.

    Attributes:
        scheme: Its scheme, without `-listen`.
        host: Host name or IP address.
        port: Port.
        listens: True if this side listens; False if it connects.
    """

    scheme: str
    host: str
    port: int
    listens: bool = False

    def __str__(self) -> str:
        return f"{self.scheme}{'-listen' if self.listens else ''}:{self.host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """True if only programs on this machine can use it."""
        return is_loopback(self.host)


def split_host_and_port(text: str) -> tuple[str, str, int, bool]:
    """Return scheme, host, port and `listens` of `SCHEME:HOST:PORT` or `SCHEME-listen:HOST:PORT`.

    Raises:
        ValueError: The host or the port is missing, or the port is not a number from 1 to 65535.
    """
    scheme, _, host_and_port = text.partition(":")
    host, _, port = host_and_port.rpartition(":")
    if not host or not port:
        raise ValueError("host or port is missing")
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"{port!r} is not a port from 1 to 65535")
    return scheme.removesuffix("-listen"), host.strip("[]"), int(port), scheme.endswith("-listen")
