"""One directed link at work: queue, serialization, loss, delay."""

from collections import deque

from sim_backends.radio.parameters import LinkCounters, LinkParameters
from sim_backends.radio.streams import Stream


class Hop:
    """The state of one directed link.

    Packets wait in a bounded first-in-first-out queue, go on the air one after the other at the link's rate, and
    arrive after the link's delay. They never overtake each other, jitter or not, because an 802.11 receiver hands
    frames up in order (IEEE 802.11-2020, 5.1.3): one that drew less jitter than its predecessor waits for it.

    Args:
        transmitter: Who sends.
        receiver: Who receives.
        seed: Seed of the random streams, which are named by transmitter, receiver and purpose.
    """

    def __init__(self, transmitter: str, receiver: str, seed: int) -> None:
        self.transmitter = transmitter
        self.receiver = receiver
        self.sent = 0
        self.delivered = 0
        self._queue_dropped = 0
        self._lost = 0
        self._loss_draw = Stream(seed, transmitter, receiver, "loss").draw
        self._jitter_draw = Stream(seed, transmitter, receiver, "jitter").draw
        self._free_ns = 0
        self._last_arrival_ns = 0
        self._starts_ns: deque[int] = deque()
        self.use(LinkParameters())

    def use(self, parameters: LinkParameters) -> None:
        """Treat packets from now on as `parameters` say; those on their way keep their fate."""
        self._parameters = parameters
        # Few lengths occur, and computing a power per packet costs more than looking it up.
        self._loss_by_size: dict[int, float] = {}

    def offer(self, now_ns: int, size_bytes: int) -> int | None:
        """Take a packet at `now_ns`, which never decreases; return when it arrives, None when it never does."""
        parameters = self._parameters
        end_ns = now_ns
        if parameters.rate_bit_s is not None:
            queued_ns = self._enqueue(now_ns, size_bytes)
            if queued_ns is None:
                return None
            end_ns = queued_ns
        number = self.sent
        self.sent = number + 1
        loss = self._loss_by_size.get(size_bytes)
        if loss is None:
            loss = self._loss_by_size[size_bytes] = parameters.packet_loss(size_bytes)
        if loss and self._loss_draw(number) < loss:
            self._lost += 1
            return None
        arrival_ns = end_ns + parameters.delay_ns
        if parameters.jitter_ns:
            arrival_ns += int(self._jitter_draw(number) * parameters.jitter_ns)
        self._last_arrival_ns = arrival_ns = max(arrival_ns, self._last_arrival_ns)
        return arrival_ns

    def _enqueue(self, now_ns: int, size_bytes: int) -> int | None:
        """Return when the last bit of a packet leaves, None when the queue is full."""
        waiting = self._starts_ns
        while waiting and waiting[0] <= now_ns:
            waiting.popleft()
        start_ns = now_ns
        if self._free_ns > now_ns:
            if len(waiting) >= self._parameters.queue_packets:
                self._queue_dropped += 1
                return None
            start_ns = self._free_ns
            waiting.append(start_ns)
        self._free_ns = start_ns + self._parameters.serialization_ns(size_bytes)
        return self._free_ns

    @property
    def counters(self) -> LinkCounters:
        """What happened so far."""
        return LinkCounters(self.sent, self._queue_dropped, self._lost, self.delivered)
