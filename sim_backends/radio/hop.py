"""One directed link at work: queue, serialization, loss, delay."""

from collections import deque

from sim_backends.radio import delay
from sim_backends.radio.delay import Delay
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
        # Few lengths occur, and computing these per packet costs more than looking them up.
        self._by_size: dict[int, tuple[int, Delay]] = {}

    def offer(self, now_ns: int, size_bytes: int) -> tuple[int, Delay] | None:
        """Take a packet at `now_ns`, which never decreases.

        Returns:
            When it arrives, and its delay, whose parts sum up to the time until then; None when it never arrives.
        """
        parameters = self._parameters
        transmission_ns, delayed = self._by_size.get(size_bytes) or self._look_up(size_bytes)
        arrival_ns = now_ns + transmission_ns + parameters.delay_ns
        if parameters.rate_bit_s is not None:
            queuing_ns = self._enqueue(now_ns, transmission_ns)
            if queuing_ns is None:
                return None
            if queuing_ns:
                arrival_ns += queuing_ns
                delayed += queuing_ns * delay.QUEUING_NS
        number = self.sent
        self.sent = number + 1
        if parameters.loss and self._loss_draw(number) < parameters.loss:
            self._lost += 1
            return None
        extra_ns = int(self._jitter_draw(number) * parameters.jitter_ns) if parameters.jitter_ns else 0
        if arrival_ns + extra_ns < self._last_arrival_ns:
            extra_ns = self._last_arrival_ns - arrival_ns
        if extra_ns:
            arrival_ns += extra_ns
            delayed += extra_ns * delay.PROPAGATION_NS
        self._last_arrival_ns = arrival_ns
        return arrival_ns, delayed

    def _look_up(self, size_bytes: int) -> tuple[int, Delay]:
        """Return transmission in ns and delay without waiting of packets of a size; remember them."""
        parameters = self._parameters
        transmission_ns = parameters.serialization_ns(size_bytes)
        delayed = delay.PACKET + transmission_ns * delay.TRANSMISSION_NS + parameters.delay_ns * delay.PROPAGATION_NS
        known = self._by_size[size_bytes] = transmission_ns, delayed
        return known

    def _enqueue(self, now_ns: int, transmission_ns: int) -> int | None:
        """Return how long a packet waits until it goes on the air, None when the queue is full."""
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
        self._free_ns = start_ns + transmission_ns
        return start_ns - now_ns

    @property
    def counters(self) -> LinkCounters:
        """What happened so far."""
        return LinkCounters(self.sent, self._queue_dropped, self._lost, self.delivered)
