"""The datagrams of the UDP transport: a byte stream in numbered datagrams that are acknowledged and resent.

A datagram has at most 1,200 bytes. Its header has 40 bytes: `FKUD`, `version` u8 (1), `kind` u8, `reserved` u16,
`connection` u64, `cookie` u64, `number` u64, `expected` u64. The kinds are open (1), cookie (2), data (3),
acknowledgement (4) and close (5). A data datagram contains a part of the stream after its header.

- The side that connects draws a random `connection`, and sends open with `cookie` 0. It sends open again after 50 ms
  and then at intervals that double up to 1 s, until it receives a cookie datagram. The other side has computed the
  `cookie` in it from `connection` and the sender's address. All later datagrams have this `connection` and this
  `cookie`; a datagram with other values or from another address is ignored. The side that connects sends the first
  data.
- Data datagrams are numbered from 0 in each direction. In a datagram of another kind, `number` is the number of the
  next data datagram. `expected` acknowledges all data datagrams before this number. At most 64 of them are
  unacknowledged.
- Before a side waits, it acknowledges new data. While it waits, it sends an acknowledgement every 2 s. Unacknowledged
  data are sent again after the time-out of RFC 6298, which is limited to the range from 20 ms to 2 s.
- A side that ends the connection sends close once: when all its data are acknowledged, but after 0.5 s at the latest.
  The receiver ends the connection if `number` is the number that it expects. If close is lost, the receiver ends the
  connection after an ICMP message that the port is unreachable, or after 3,600 s without a datagram.
"""

import select
import socket
import struct
import time
from contextlib import suppress
from enum import IntEnum
from typing import Final, NamedTuple

from sim_backends.federates.channels import ClosedError, DeadlineError
from sim_backends.federates.frames import HEADER_BYTES, MAX_FRAME_BYTES, ProtocolFrame, read_header

MAX_DATAGRAM_BYTES: Final = 1200
"""A size that should pass every path without fragmentation: QUIC requires this of paths (RFC 9000, section 14.1)."""
_MAGIC: Final = b"FKUD"
_HEADER: Final = struct.Struct("<4sBBHQQQQ")
DATAGRAM_HEADER_BYTES: Final = _HEADER.size
_DATA_BYTES: Final = MAX_DATAGRAM_BYTES - DATAGRAM_HEADER_BYTES
DATAGRAM_VERSION: Final = 1
_WINDOW: Final = 64
"""Largest number of unacknowledged datagrams; they fit into a receive buffer of Linux's default size."""
_LINGER_S: Final = 0.5
"""Longest wait for acknowledgements when a side ends the connection."""
_PROBE_S: Final = 2.0
"""Interval at which a side that waits sends an acknowledgement."""
_SILENCE_S: Final = 3600.0
"""Time without a datagram after which the connection ends; it is long, because a federate may be suspended."""


class DatagramKind(IntEnum):
    """Kind of a datagram."""

    OPEN = 1
    COOKIE = 2
    DATA = 3
    ACKNOWLEDGEMENT = 4
    CLOSE = 5


class DatagramHeader(NamedTuple):
    """The header of a datagram.

    Attributes:
        kind: Its kind.
        connection: Random number that the connecting side has drawn.
        cookie: Number that the listening side has computed for this connection and the peer's address.
        number: Number of the datagram, counting only datagrams with data; in a datagram without data, the number of
            the next datagram with data.
        expected: The next number that its sender expects.
    """

    kind: DatagramKind
    connection: int
    cookie: int = 0
    number: int = 0
    expected: int = 0


_KINDS: Final = {int(kind): kind for kind in DatagramKind}


def pack_datagram(header: DatagramHeader, data: bytes | memoryview = b"") -> bytes:
    """Return the bytes of a datagram."""
    kind, connection, cookie, number, expected = header
    return _HEADER.pack(_MAGIC, DATAGRAM_VERSION, kind, 0, connection, cookie, number, expected) + data


def unpack_datagram(datagram: bytes) -> DatagramHeader | None:
    """Return the header of a datagram, or None if it is not a datagram of this transport."""
    if len(datagram) < DATAGRAM_HEADER_BYTES:
        return None
    magic, version, kind, _, *numbers = _HEADER.unpack_from(datagram)
    if magic != _MAGIC or version != DATAGRAM_VERSION or kind not in _KINDS:
        return None
    return DatagramHeader(_KINDS[kind], *numbers)


class RetransmissionTimer:
    """The retransmission timer of RFC 6298, with limits that suit a run: 20 ms and 2 s instead of 1 s and 60 s.

    Attributes:
        interval_s: Time after which unacknowledged datagrams are sent again.
    """

    _MIN_S: Final = 0.02
    _MAX_S: Final = 2.0

    def __init__(self) -> None:
        self.interval_s = 0.2
        self._smoothed_s: float | None = None
        self._variation_s = 0.0

    def add_round_trip(self, round_trip_s: float) -> None:
        """Add the time until an acknowledgement of a datagram that was sent once (section 2, Karn's algorithm)."""
        if self._smoothed_s is None:
            self._smoothed_s, self._variation_s = round_trip_s, round_trip_s / 2
        else:
            self._variation_s += (abs(self._smoothed_s - round_trip_s) - self._variation_s) / 4
            self._smoothed_s += (round_trip_s - self._smoothed_s) / 8
        interval_s = self._smoothed_s + 4 * self._variation_s
        self.interval_s = min(max(interval_s, self._MIN_S), self._MAX_S)

    def back_off(self) -> None:
        """Double the interval after it has expired (rule 5.5)."""
        self.interval_s = min(2 * self.interval_s, self._MAX_S)


# There is no thread: each side handles its timer whenever it waits.
class DatagramChannel:
    """A channel over a UDP socket that is connected to the other side, so that the kernel checks its address.

    Args:
        endpoint: The socket; the channel closes it.
        connection: Random number that the connecting side has drawn.
        cookie: Number that the listening side has computed for this connection and the peer's address.
    """

    def __init__(self, endpoint: socket.socket, connection: int, cookie: int) -> None:
        endpoint.setblocking(False)
        self._socket = endpoint
        self._readable = select.poll()
        self._readable.register(endpoint, select.POLLIN)
        self._identity = connection, cookie
        # Number of the next datagram with data to send, and of the next one to receive.
        self._number = self._expected = 0
        self._unacknowledged: dict[int, bytes] = {}
        self._sent_s: dict[int, float] = {}  # times of sending, without datagrams that were sent again
        self._timer = RetransmissionTimer()
        self._resend_s = 0.0
        self._early_data: dict[int, bytes] = {}  # received before earlier data
        self._data = bytearray()  # received in order, and not read yet
        self._must_acknowledge = False
        self._last_received_s = time.monotonic()
        self._is_closed = self._is_closed_by_peer = False

    def send(self, frame: bytes, deadline_s: float | None) -> None:
        """Implement `FrameChannel.send`."""
        if self._unacknowledged:
            self._read_available()
            self._resend_if_due(time.monotonic())
        for begin in range(0, len(frame), _DATA_BYTES):
            while len(self._unacknowledged) >= _WINDOW:
                self._wait(deadline_s)
            now_s = time.monotonic()
            if not self._unacknowledged:
                self._resend_s = now_s + self._timer.interval_s
            data = frame[begin : begin + _DATA_BYTES]
            self._unacknowledged[self._number] = data
            self._sent_s[self._number] = now_s
            self._transmit(DatagramKind.DATA, self._number, data)
            self._number += 1

    def receive(self, deadline_s: float | None, max_bytes: int = MAX_FRAME_BYTES) -> ProtocolFrame:
        """Implement `FrameChannel.receive`."""
        data = self._data
        while len(data) < HEADER_BYTES:
            self._wait(deadline_s)
        header = read_header(data, max_bytes)
        end = HEADER_BYTES + header.size
        while len(data) < end:
            self._wait(deadline_s)
        body = bytes(memoryview(data)[HEADER_BYTES:end])
        del data[:end]
        return ProtocolFrame(header, body)

    def close(self) -> None:
        """Implement `FrameChannel.close`; unacknowledged data are resent for at most half a second."""
        if self._is_closed:
            return
        limit_s = time.monotonic() + _LINGER_S
        with suppress(ClosedError, DeadlineError):
            while self._unacknowledged:
                self._wait(limit_s)
        with suppress(ClosedError):
            self._transmit(DatagramKind.CLOSE, self._number)
        self._is_closed = True
        self._socket.close()

    def handle(self, datagram: bytes) -> None:
        """Handle a received datagram; a datagram of another connection is ignored."""
        header = unpack_datagram(datagram)
        if header is None or (header.connection, header.cookie) != self._identity:
            return
        self._last_received_s = time.monotonic()
        self._acknowledge_until(header.expected)
        if header.kind is DatagramKind.DATA:
            self._add_data(header.number, datagram[DATAGRAM_HEADER_BYTES:])
        elif header.kind is DatagramKind.CLOSE and header.number == self._expected:
            self._is_closed_by_peer = True

    def _add_data(self, number: int, data: bytes) -> None:
        self._must_acknowledge = True
        is_full = len(self._data) > HEADER_BYTES + MAX_FRAME_BYTES
        if not self._expected <= number < self._expected + _WINDOW or is_full:
            return
        self._early_data[number] = data
        while (data_in_order := self._early_data.pop(self._expected, None)) is not None:
            self._data += data_in_order
            self._expected += 1

    def _acknowledge_until(self, expected: int) -> None:
        if expected > self._number or expected - 1 not in self._unacknowledged:
            return
        now_s = time.monotonic()
        if (sent_s := self._sent_s.get(expected - 1)) is not None:
            self._timer.add_round_trip(now_s - sent_s)
        for number in [number for number in self._unacknowledged if number < expected]:
            del self._unacknowledged[number]
            self._sent_s.pop(number, None)
        self._resend_s = now_s + self._timer.interval_s

    def _wait(self, deadline_s: float | None) -> None:
        """Wait for a datagram, for the time to resend, or for the time to check that the other side still exists.

        Raises:
            ClosedError: The other side closed the channel, its process has exited, or it was silent for too long.
            DeadlineError: The wait reached its deadline.
        """
        if self._is_closed or self._is_closed_by_peer:
            raise ClosedError("the connection was closed")
        if self._must_acknowledge:
            if self._read_available():
                return
            self._transmit(DatagramKind.ACKNOWLEDGEMENT, self._number)
        now_s = time.monotonic()
        limit_s = min(now_s + _PROBE_S, self._resend_s if self._unacknowledged else now_s + _PROBE_S)
        if deadline_s is not None:
            if now_s >= deadline_s:
                raise DeadlineError("the wait reached its deadline")
            limit_s = min(limit_s, deadline_s)
        # A negative timeout would wait without a limit.
        if self._readable.poll(max((limit_s - now_s) * 1e3, 0)):
            self._read_available()
            return
        now_s = time.monotonic()
        if now_s - self._last_received_s > _SILENCE_S:
            raise ClosedError(f"nothing was received for {_SILENCE_S:g} s")
        if not self._resend_if_due(now_s) and not self._unacknowledged and limit_s != deadline_s:
            # If the process has exited, its machine refuses this datagram.
            self._transmit(DatagramKind.ACKNOWLEDGEMENT, self._number)

    def _read_available(self) -> bool:
        """Read a datagram if one has arrived, and return True if so.

        Raises:
            ClosedError: The other side's process has exited.
        """
        try:
            self.handle(self._socket.recv(65536))
        except BlockingIOError:
            return False
        except ConnectionRefusedError as error:
            raise ClosedError("the connection was closed") from error
        return True

    def _resend_if_due(self, now_s: float) -> bool:
        if not self._unacknowledged or now_s < self._resend_s:
            return False
        self._timer.back_off()
        self._resend_s = now_s + self._timer.interval_s
        self._sent_s.clear()
        for number, data in self._unacknowledged.items():
            self._transmit(DatagramKind.DATA, number, data)
        return True

    def _transmit(self, kind: DatagramKind, number: int, data: bytes = b"") -> None:
        """Send a datagram; if it cannot be sent now, it counts as lost.

        Raises:
            ClosedError: The other side's process has exited.
        """
        self._must_acknowledge = False
        try:
            self._socket.send(pack_datagram(DatagramHeader(kind, *self._identity, number, self._expected), data))
        except ConnectionRefusedError as error:
            raise ClosedError("the connection was closed") from error
        except OSError:
            pass
