"""Sockets for EMANE's event channel, which is UDP multicast on one interface."""

import select
import socket
import struct
import time
import uuid
from collections.abc import Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.emane_events.events import EventDatagram, SerializedEvent
from sim_backends.emane_events.options import split_channel
from sim_backends.emane_events.protobuf import MalformedEventError

_MREQN: Final = struct.Struct("=4s4si")  # struct ip_mreqn (Linux, ip(7))
_MAX_EVENT_BYTES: Final = 1200
"""Maximum total content of the events of a datagram, which then fits into an Ethernet frame with all headers. A
larger event is sent alone."""
_RECEIVE_BYTES: Final = 1 << 16


def _membership(group: str, device: str | None) -> bytes:
    """Return the value of a multicast socket option: the group and the interface.

    Raises:
        ConfigurationError: There is no such interface.
    """
    try:
        index = 0 if device is None else socket.if_nametoindex(device)
    except OSError as error:
        raise ConfigurationError(f"there is no network interface {device!r}", remedy="list them: ip link") from error
    return _MREQN.pack(socket.inet_aton(group), bytes(4), index)


def _channel_error(channel: str, device: str | None, error: OSError) -> ConfigurationError:
    where = channel if device is None else f"{channel} on {device}"
    return ConfigurationError(
        f"EMANE's event channel {where} cannot be used: {error.strerror}",
        remedy="set the device, for example lo, and check its route for multicast",
    )


class EventPublisher:
    """Publishes events.

    Args:
        channel: Multicast group and port, `224.1.2.8:45703`.
        device: Network interface; None for the interface of the route to the group.

    Raises:
        ConfigurationError: The interface cannot be used.
    """

    def __init__(self, channel: str, device: str | None = None) -> None:
        self._name, self._device = channel, device
        self._address = split_channel(channel)
        self._publisher = uuid.uuid4().bytes
        self._number = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _membership(self._address[0], device))
        except BaseException:
            self._socket.close()
            raise

    def publish(self, events: Sequence[SerializedEvent]) -> None:
        """Send events, several in a datagram if they fit.

        Raises:
            ConfigurationError: The events cannot be sent.
        """
        group: list[SerializedEvent] = []
        size_bytes = 0
        for event in events:
            if group and size_bytes + len(event.content) > _MAX_EVENT_BYTES:
                self._send(group)
                group, size_bytes = [], 0
            group.append(event)
            size_bytes += len(event.content)
        if group:
            self._send(group)

    def _send(self, events: Sequence[SerializedEvent]) -> None:
        self._number += 1
        datagram = EventDatagram(self._publisher, self._number, events).encode()
        try:
            self._socket.sendto(datagram, self._address)
        except OSError as error:
            raise _channel_error(self._name, self._device, error) from error

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class EventListener:
    """Receives events. A datagram is ignored if it is malformed, or not newer than the last one of its publisher.

    Args:
        channel: Multicast group and port, `224.1.2.8:45703`.
        device: Network interface; None for the interface of the route to the group.

    Raises:
        ConfigurationError: The channel cannot be used.
    """

    def __init__(self, channel: str, device: str | None = None) -> None:
        group, port = split_channel(channel)
        self._numbers: dict[bytes, int] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind((group, port))
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, _membership(group, device))
        except OSError as error:
            self._socket.close()
            raise _channel_error(channel, device, error) from error
        except BaseException:
            self._socket.close()
            raise

    def receive(self, deadline_s: float) -> Sequence[SerializedEvent] | None:
        """Return the events of the next valid datagram, or None if none arrives before the deadline.

        Args:
            deadline_s: The deadline, a time of `time.monotonic`.
        """
        while True:
            wait_s = max(deadline_s - time.monotonic(), 0.0)
            if not select.select([self._socket], [], [], wait_s)[0]:
                return None
            try:
                datagram = EventDatagram.decode(self._socket.recv(_RECEIVE_BYTES))
            except MalformedEventError:
                continue
            if datagram.number > self._numbers.get(datagram.publisher, -1):
                self._numbers[datagram.publisher] = datagram.number
                return datagram.events

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
