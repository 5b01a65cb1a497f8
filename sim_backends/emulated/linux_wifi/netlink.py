"""Netlink messages in the generic netlink format, and a socket of one family.

Formats: `include/uapi/linux/netlink.h` and `genetlink.h` of Linux; RFC 3549, section 2. Numbers are in the byte order
of the host. The codec is written here because the medium needs few messages of one family, and a library such as
pyroute2 would be a dependency of a program that runs inside of a virtual machine.
"""

import errno
import os
import socket
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from fieldkit.core.errors import ConfigurationError

MAX_DATAGRAM_BYTES: Final = 1 << 16
NLM_F_REQUEST: Final = 1
NLMSG_ERROR: Final = 2

_NETLINK_GENERIC: Final = 16
# The controller is the family that returns the identifiers of other families (linux/genetlink.h).
_CONTROLLER_ID: Final = 0x10
_CONTROLLER_GET_FAMILY: Final = 3
_CONTROLLER_FAMILY_ID: Final = 1
_CONTROLLER_FAMILY_NAME: Final = 2

_MESSAGE: Final = struct.Struct("=IHHII")
_GENERIC: Final = struct.Struct("=BBH")
_ATTRIBUTE: Final = struct.Struct("=HH")
_TYPE_MASK: Final = 0x3FFF
"""The two highest bits of an attribute's type are flags: nested, and network byte order."""

_RECEIVE_BUFFER_BYTES: Final = 4 << 20
_SO_RCVBUFFORCE: Final = 33
"""asm-generic/socket.h; the module `socket` lacks it."""
_TIMEOUT_S: Final = 60.0
"""Timeout of the request for the identifier of the family."""
_FIRST_PORT: Final = 1 << 30
"""Added to the process identifier to get a port number above all process identifiers (below 2^22). The kernel uses
the process identifier as port number of other netlink sockets, which for example `getaddrinfo` opens. hwsim ends the
registration when any netlink socket with the same port number is closed."""


class NetlinkFormatError(ValueError):
    """Bytes are not netlink messages."""


@dataclass(frozen=True)
class NetlinkMessage:
    """One netlink message.

    Attributes:
        type: Family identifier, or `NLMSG_ERROR`.
        flags: Flags of the message header.
        sequence: Sequence number.
        payload: Bytes after the message header, without padding.
    """

    type: int
    flags: int
    sequence: int
    payload: bytes

    def encode(self) -> bytes:
        """Return the message with header and padding. Its port number is 0, because the kernel uses the socket's."""
        size = _MESSAGE.size + len(self.payload)
        return _pad(_MESSAGE.pack(size, self.type, self.flags, self.sequence, 0) + self.payload)

    @property
    def error_number(self) -> int:
        """Error number (`errno`) in a message of type `NLMSG_ERROR`; 0 is an acknowledgement.

        Raises:
            NetlinkFormatError: The message is too short.
        """
        if len(self.payload) < 4:
            raise NetlinkFormatError(f"an error message has {len(self.payload)} bytes, fewer than 4")
        return -int(struct.unpack_from("=i", self.payload)[0])


def decode_messages(datagram: bytes) -> Iterator[NetlinkMessage]:
    """Yield the messages of a datagram.

    Raises:
        NetlinkFormatError: A length exceeds the datagram or is smaller than a header, or the datagram ends within a
            header.
    """
    offset = 0
    while offset < len(datagram):
        if len(datagram) - offset < _MESSAGE.size:
            raise NetlinkFormatError(f"{len(datagram) - offset} bytes after the last message")
        size, kind, flags, sequence, _ = _MESSAGE.unpack_from(datagram, offset)
        if not _MESSAGE.size <= size <= len(datagram) - offset:
            raise NetlinkFormatError(f"a message of {size} bytes in {len(datagram) - offset} bytes")
        yield NetlinkMessage(kind, flags, sequence, datagram[offset + _MESSAGE.size : offset + size])
        offset += _align(size)


def encode_generic(command: int, version: int, attributes: Mapping[int, bytes]) -> bytes:
    """Return the payload of a generic netlink message.

    Args:
        command: Command of the family.
        version: Version of the family.
        attributes: Value of each attribute, by type.

    Raises:
        NetlinkFormatError: A value is longer than an attribute can be.
    """
    parts = [_GENERIC.pack(command, version, 0)]
    for kind, value in attributes.items():
        if _ATTRIBUTE.size + len(value) > 0xFFFF:
            raise NetlinkFormatError(f"attribute {kind} has {len(value)} bytes, more than {0xFFFF - _ATTRIBUTE.size}")
        parts.append(_pad(_ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value))
    return b"".join(parts)


def decode_generic(payload: bytes) -> tuple[int, dict[int, bytes]]:
    """Return the command of a generic netlink message, and the value of each attribute by its type without flags.

    If a type is repeated, its last value is returned.

    Raises:
        NetlinkFormatError: A length exceeds the message or is smaller than a header, or the message ends within its
            header.
    """
    if len(payload) < _GENERIC.size:
        raise NetlinkFormatError(f"a generic message has {len(payload)} bytes, fewer than {_GENERIC.size}")
    command, _, _ = _GENERIC.unpack_from(payload)
    attributes = {}
    offset = _GENERIC.size
    while len(payload) - offset >= _ATTRIBUTE.size:
        size, kind = _ATTRIBUTE.unpack_from(payload, offset)
        if not _ATTRIBUTE.size <= size <= len(payload) - offset:
            raise NetlinkFormatError(f"an attribute of {size} bytes in {len(payload) - offset} bytes")
        attributes[kind & _TYPE_MASK] = payload[offset + _ATTRIBUTE.size : offset + size]
        offset += _align(size)
    return command, attributes


def family_request(name: str) -> NetlinkMessage:
    """Return the request for the identifier of a family."""
    attributes = {_CONTROLLER_FAMILY_NAME: name.encode("ascii") + b"\0"}
    payload = encode_generic(_CONTROLLER_GET_FAMILY, 1, attributes)
    return NetlinkMessage(_CONTROLLER_ID, NLM_F_REQUEST, 0, payload)


def family_identifier(name: str, reply: NetlinkMessage) -> int:
    """Return the identifier of a family from the reply to `family_request`.

    Raises:
        ConfigurationError: The reply is an error, because the kernel does not have the family.
        NetlinkFormatError: The message is not a reply to this request.
    """
    if reply.type == NLMSG_ERROR:
        raise ConfigurationError(
            f"the kernel does not have the generic netlink family {name}: {os.strerror(reply.error_number)}",
            remedy="load its module as root, for example: modprobe mac80211_hwsim radios=0",
        )
    value = decode_generic(reply.payload)[1].get(_CONTROLLER_FAMILY_ID, b"")
    if len(value) != 2:
        raise NetlinkFormatError(f"the reply to the request for family {name} has no identifier")
    return int(struct.unpack("=H", value)[0])


class FamilySocket:
    """A socket of one generic netlink family, in the network namespace of the process.

    Args:
        name: Name of the family.
        fd: Descriptor of a socket that another process has opened and bound; None to open one.

    Attributes:
        overruns: Number of times that the kernel reported to `receive` that it dropped messages because the socket
            was full.
        foreign: Number of datagrams in `receive` that were not sent by the kernel; they are ignored.

    Raises:
        ConfigurationError: The kernel does not have the family.
        NetlinkFormatError: The kernel sent bytes that are not messages.
        OSError: The socket cannot be opened, or the kernel did not answer in time.
    """

    def __init__(self, name: str, fd: int | None = None) -> None:
        self.overruns = self.foreign = 0
        self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_GENERIC, fileno=fd)
        try:
            if fd is None:
                self._socket.bind((_FIRST_PORT + os.getpid(), 0))
            self._family = self._request_family(name)
            self._socket.setblocking(False)
            self._grow_buffer()
        except BaseException:
            self._socket.close()
            raise

    def fileno(self) -> int:
        """Return the descriptor of the socket."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, payload: bytes) -> None:
        """Send a generic message, as returned by `encode_generic`, to the kernel.

        Raises:
            OSError: The kernel did not accept it; errors of the family arrive as messages later.
        """
        self._socket.sendto(NetlinkMessage(self._family, NLM_F_REQUEST, 0, payload).encode(), (0, 0))

    def receive(self) -> list[NetlinkMessage]:
        """Return the messages of the family and the errors in one datagram; an empty list if there is no datagram.

        Raises:
            NetlinkFormatError: The kernel sent bytes that are not messages.
        """
        try:
            datagram, (port, _) = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            if error.errno != errno.ENOBUFS:
                raise
            self.overruns += 1
            return []
        if port != 0:
            self.foreign += 1
            return []
        return [message for message in decode_messages(datagram) if message.type in {self._family, NLMSG_ERROR}]

    def _request_family(self, name: str) -> int:
        """Request the identifier of the family from the kernel, and return it."""
        self._socket.settimeout(_TIMEOUT_S)
        self._socket.sendto(family_request(name).encode(), (0, 0))
        while True:
            datagram, (port, _) = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
            for message in decode_messages(datagram):
                # An inherited socket may hold older messages of the family.
                if port == 0 and message.type in {_CONTROLLER_ID, NLMSG_ERROR}:
                    return family_identifier(name, message)

    def _grow_buffer(self) -> None:
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
        except PermissionError:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)


def _align(size: int) -> int:
    return (size + 3) & ~3


def _pad(value: bytes) -> bytes:
    return value + bytes(_align(len(value)) - len(value))
