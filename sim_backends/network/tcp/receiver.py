"""The receiving end of a connection: puts the stream in order and acknowledges it."""

from collections.abc import Callable

from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.tcp.ranges import Ranges
from sim_backends.network.tcp.segments import MOST_SACKS, Segment
from sim_backends.network.timer import WireTimer
from sim_backends.network.wire import Wire


class Receiver:
    """Gets segments and answers them.

    Its program reads at once. So the window that it offers never closes, nobody probes it, and what waits in it is
    only what is out of order, which it never gives up again.

    Args:
        wire: Its clock.
        host: Where it is.
        options: Window and delayed ACKs.
        transmit: Sends a segment.
        read: Told the sequence number up to which the stream is complete, whenever that moves.
        opened: Whether the connection is open already.

    Attributes:
        expected: The sequence number that it waits for (RCV.NXT); 0 before a SYN arrived.
    """

    def __init__(
        self,
        wire: Wire,
        host: str,
        options: TcpOptions,
        *,
        transmit: Callable[[Segment], None],
        read: Callable[[int], None],
        opened: bool = False,
    ) -> None:
        self._options = options
        self._wire = wire
        self._transmit = transmit
        self._read = read
        self._beyond = Ranges()
        # A sequence number in each range beyond, the one that got something last first.
        self._newest: list[int] = []
        self._timer = WireTimer(wire, host, self._say)
        self._unanswered = 0
        self._answered = int(opened)
        self._echoes_ns = 0
        self._asked: Segment | None = None
        self.expected = int(opened)

    def receive(self, segment: Segment) -> None:
        """Take a segment of the other end."""
        if segment.syn:
            if not self.expected:
                self.expected = 1
                self._echoes_ns = segment.sent_ns
            self._asked = segment
            self._say()
            return
        if not self.expected or not segment.length:
            return
        # RFC 7323, 4.3: the timestamp of what the last ACK waited for, so that a delayed ACK's delay counts.
        if segment.first <= self._answered and segment.sent_ns >= self._echoes_ns:
            self._echoes_ns = segment.sent_ns
        self._asked = segment
        if segment.first <= self.expected < segment.end:
            self._advance(segment)
        else:
            if segment.first > self.expected:
                self._keep(segment)
            self._say()

    def _advance(self, segment: Segment) -> None:
        filled = bool(self._newest)
        self.expected = segment.end
        if filled:
            self._beyond.add(segment.first, segment.end)
            joined = self._beyond.around(segment.first)
            assert joined is not None
            self.expected = joined[1]
            self._beyond.forget_before(self.expected)
            self._newest = [number for number in self._newest if number >= self.expected]
        self._unanswered += 1
        self._read(self.expected)
        # RFC 5681, 4.2: at once for every second segment, and where a gap is filled, wholly or not.
        if filled or self._unanswered >= self._options.segments_per_ack:
            self._say()
        elif self._timer.due_ns is None:
            self._timer.set(self._wire.now_ns + self._options.delayed_ack_ns)

    def _keep(self, segment: Segment) -> None:
        """Keep a segment that came too early, and put its range first (RFC 2018, 4)."""
        self._beyond.add(segment.first, segment.end)
        block = self._beyond.around(segment.first)
        assert block is not None
        apart = [number for number in self._newest if not block[0] <= number < block[1]]
        self._newest = [segment.first, *apart]

    def _say(self) -> None:
        assert self._asked is not None
        blocks = [self._beyond.around(number) for number in self._newest[:MOST_SACKS]]
        sacks = tuple(block for block in blocks if block is not None)
        self._timer.stop()
        self._unanswered = 0
        self._answered = self.expected
        self._transmit(
            Segment(
                syn=self._asked.syn,
                first=0 if self._asked.syn else 1,
                length=0,
                acknowledges=self.expected,
                sacks=sacks,
                window_bytes=self._options.receive_window_bytes,
                sent_ns=self._wire.now_ns,
                echoes_ns=self._echoes_ns,
                number=self._asked.number,
                times=self._asked.times,
            )
        )
