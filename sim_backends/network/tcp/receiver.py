"""The receiving end of a connection: reassembles and acknowledges the stream."""

from collections.abc import Callable

from sim_backends.network.tcp.segments import MAX_SACKS, Ranges, Segment
from sim_backends.network.tcp.tcp_options import TcpOptions
from sim_backends.network.wire import Wire, WireTimer


class Receiver:
    """Receives segments and acknowledges them.

    Its program reads immediately. The receive window is therefore never closed and never probed, and its buffer
    contains only out-of-order data, which is never discarded.

    Args:
        wire: Provides the clock.
        host: Name of its host.
        options: Window and delayed ACKs.
        transmit: Sends a segment.
        on_readable: Called with the sequence number up to which the stream is complete, whenever it increases.
        is_open: True if the connection is already open.

    Attributes:
        next_expected: The next expected sequence number (RCV.NXT); 0 before a SYN has arrived.
    """

    def __init__(
        self,
        wire: Wire,
        host: str,
        options: TcpOptions,
        *,
        transmit: Callable[[Segment], None],
        on_readable: Callable[[int], None],
        is_open: bool = False,
    ) -> None:
        self._options = options
        self._wire = wire
        self._transmit = transmit
        self._on_readable = on_readable
        self._out_of_order = Ranges()
        # One sequence number in each out-of-order range, the most recently extended range first.
        self._sack_order: list[int] = []
        self._timer = WireTimer(wire, host, self._send_ack)
        self._unacknowledged_segments = 0
        self._last_ack = int(is_open)
        self._echo_ns = 0  # the received timestamp that the next ACK echoes
        self._last_segment: Segment | None = None
        self.next_expected = int(is_open)

    def receive(self, segment: Segment) -> None:
        """Process a segment of the other end."""
        if segment.syn:
            if not self.next_expected:
                self.next_expected = 1
                self._echo_ns = segment.sent_ns
            self._last_segment = segment
            self._send_ack()
            return
        if not self.next_expected or not segment.length:
            return
        # RFC 7323, 4.3: echo the timestamp of the segment at the last ACK's number, so that the ACK delay is
        # included.
        if segment.first <= self._last_ack and segment.sent_ns >= self._echo_ns:
            self._echo_ns = segment.sent_ns
        self._last_segment = segment
        if segment.first <= self.next_expected < segment.end:
            self._advance(segment)
        else:
            if segment.first > self.next_expected:
                self._store_out_of_order(segment)
            self._send_ack()

    def _advance(self, segment: Segment) -> None:
        """Accept a segment that begins at or before the next expected byte, and acknowledge it now or later."""
        had_gap = bool(self._sack_order)
        self.next_expected = segment.end
        if had_gap:
            self._out_of_order.add(segment.first, segment.end)
            merged = self._out_of_order.containing(segment.first)
            assert merged is not None
            self.next_expected = merged[1]
            self._out_of_order.remove_before(self.next_expected)
            self._sack_order = [number for number in self._sack_order if number >= self.next_expected]
        self._unacknowledged_segments += 1
        self._on_readable(self.next_expected)
        # RFC 5681, 4.2: send an ACK immediately for every second segment, and if a gap was filled completely or
        # partly.
        if had_gap or self._unacknowledged_segments >= self._options.segments_per_ack:
            self._send_ack()
        elif self._timer.due_ns is None:
            self._timer.set(self._wire.now_ns + self._options.delayed_ack_ns)

    def _store_out_of_order(self, segment: Segment) -> None:
        """Store an out-of-order segment, and put its range first in the SACK order (RFC 2018, 4)."""
        self._out_of_order.add(segment.first, segment.end)
        block = self._out_of_order.containing(segment.first)
        assert block is not None
        other_ranges = [number for number in self._sack_order if not block[0] <= number < block[1]]
        self._sack_order = [segment.first, *other_ranges]

    def _send_ack(self) -> None:
        """Acknowledge all data that was received in order, and report out-of-order ranges by SACK."""
        assert self._last_segment is not None
        blocks = [self._out_of_order.containing(number) for number in self._sack_order[:MAX_SACKS]]
        sacks = tuple(block for block in blocks if block is not None)
        self._timer.stop()
        self._unacknowledged_segments = 0
        self._last_ack = self.next_expected
        self._transmit(
            Segment(
                syn=self._last_segment.syn,
                first=0 if self._last_segment.syn else 1,
                length=0,
                acknowledges=self.next_expected,
                sacks=sacks,
                window_bytes=self._options.receive_window_bytes,
                sent_ns=self._wire.now_ns,
                echoes_ns=self._echo_ns,
                number=self._last_segment.number,
                earlier_transmissions=self._last_segment.earlier_transmissions,
            )
        )
