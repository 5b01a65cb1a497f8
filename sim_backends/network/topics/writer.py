"""The writer of a flow: sends samples, announces them to its reader, and sends requested ones again.

It behaves like CycloneDDS (`ddsi_transmit.c`, `ddsi_hbcontrol.c`, `ddsi_receive.c`), which implements DDSI-RTPS 2.5,
clauses 8.4.7 to 8.4.9. After every sample there is a heartbeat in the same message, which requires a response only if
the previous sample was sent long ago. Separate heartbeats are sent while samples are unacknowledged; their intervals
grow if the reader does not respond. One heartbeat is sent after each retransmission.
"""

from collections.abc import Callable, Iterable
from typing import Final

from sim_backends.network.topics.history import WriterHistory
from sim_backends.network.topics.qos import RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import AckNack, Data, Gap, Heartbeat, NackFrag, Sample, Submessage, ip_bytes
from sim_backends.network.wire import Wire, WireTimer
from sim_backends.radio.core.random_streams import PacketIdentity

Transmit = Callable[[tuple[Submessage, ...], PacketIdentity], None]
"""Sends a message to the other end. The radio derives its random numbers for the message from the identity, which
begins with the kind of message."""

EVICTED: Final = "evicted from the writer's history before it was acknowledged"
OVERTAKEN: Final = "overtaken by a later sample"
"""Reason for a best-effort sample that arrived but was not delivered, because a later one had been delivered before.
A lost sample is reported with the reason of its loss."""
BLOCKED: Final = "the writer was blocked for longer than max_blocking_time"
_NEVER_NS: Final = -(10**18)
"""A time before the start of every run."""
_PIGGYBACK_PAUSE_NS: Final = 100_000
"""A message with data has no heartbeat for this time after a heartbeat, unless a response is required."""
_HEARTBEATS_AT_FULL_RATE: Final = 5
"""For every two heartbeats beyond this number since the last write, the interval doubles."""


class TopicWriter:
    """A writer with one reader.

    Args:
        wire: Provides the clock.
        flow: Publisher, subscriber and quality of service.
        timing: Times of the protocol.
        transmit: Sends a message to the reader.
        give_up: Called with a sample that will not be sent or will not be retransmitted, and the reason to report if
            it is never delivered.

    Attributes:
        on_reader_start: Called when its reader starts, or starts again.
        share_heartbeat: Called with each separate heartbeat that is due at a multiple of the heartbeat interval, to
            send it together with heartbeats of other writers; None if all heartbeats are sent directly.
    """

    def __init__(
        self,
        wire: Wire,
        flow: TopicFlow,
        timing: RtpsTiming,
        transmit: Transmit,
        give_up: Callable[[Sample, str], None],
    ) -> None:
        self._wire = wire
        self._host = flow.publisher
        self._timing = timing
        self._transmit = transmit
        self._give_up = give_up
        self._is_reliable = flow.qos.reliability == "reliable"
        self._max_blocking_ns = flow.qos.max_blocking_ns
        self._history = WriterHistory(flow.qos, timing)
        self._waiting_samples: dict[Sample, None] = {}
        self._last_number = 0
        self._is_matched = False
        self._reader_responded = False
        # Numbers of heartbeats and gaps, and the number of the reader's last message.
        self._heartbeat_count = self._gap_count = self._last_acknack_count = 0
        self._heartbeats_since_write = 0
        self._last_write_ns = self._last_heartbeat_ns = self._last_ack_request_ns = _NEVER_NS
        self._heartbeat_timer = WireTimer(wire, flow.publisher, self._send_heartbeat)
        self.on_reader_start: Callable[[], None] = lambda: None
        self.share_heartbeat: Callable[[Heartbeat], None] | None = None

    @property
    def is_matched(self) -> bool:
        """True if the writer has a reader."""
        return self._is_matched

    @property
    def last(self) -> int:
        """The sequence number of its last sample; 0 if there is none."""
        return self._last_number

    @property
    def unacknowledged(self) -> Iterable[Sample]:
        """The samples that its reader has not acknowledged, oldest first."""
        return self._history.samples.values()

    def match(self, *, has_responded: bool = False) -> None:
        """Add the reader; send it heartbeats unless it has already responded."""
        self._is_matched = True
        self._reader_responded = has_responded
        self._heartbeats_since_write = 0
        if self._is_reliable and not has_responded:
            self._heartbeat_timer.bring_forward(self._wire.now_ns + self._timing.first_heartbeat_ns)

    def add_historical(self, sample: Sample) -> None:
        """Add a sample without sending it; the next heartbeat announces it and the reader requests it."""
        self._last_number += 1
        sample.number = self._last_number
        self._history.insert(sample)

    def remove_reader(self, reason: str) -> None:
        """Remove the reader, and give up all samples that are unacknowledged or waiting."""
        self._is_matched = False
        self._heartbeat_timer.stop()
        waiting_samples, self._waiting_samples = self._waiting_samples, {}
        for sample in (*self._history.clear(), *waiting_samples):
            self._give_up(sample, reason)

    def write(self, sample: Sample) -> None:
        """Send a sample now, or when the writer is no longer blocked."""
        if not self._waiting_samples and (not self._is_reliable or self._history.admits(self._wire.now_ns)):
            self._send(sample)
            return
        if not self._waiting_samples:
            # When the writer starts to block, it requests the acknowledgements for which it waits.
            heartbeat = self._heartbeat(final=False)
            self._transmit((heartbeat,), self._key_of((heartbeat,)))
        self._waiting_samples[sample] = None
        if self._max_blocking_ns is not None:
            self._wire.at(self._wire.now_ns + self._max_blocking_ns, self._host, lambda: self._expire(sample))

    def on_acknack(self, message: AckNack | NackFrag) -> None:
        """Process a response of the reader: remove acknowledged samples, send requested ones again."""
        if not self._is_matched or message.count <= self._last_acknack_count:
            return
        self._last_acknack_count = message.count
        if isinstance(message, NackFrag):
            self._on_nack_frag(message)
            return
        self._reader_responded = True
        self._history.acknowledge(message.base)
        if not message.final and not message.missing:
            self.on_reader_start()
            self._respond(())
        elif message.missing:
            self._on_nack(message)
        self._resume()

    def _send(self, sample: Sample) -> None:
        """Send a new sample in as many messages as it needs; the last one has a heartbeat if one is due."""
        self._last_number += 1
        sample.number = self._last_number
        evicted_sample = self._history.insert(sample) if self._is_reliable else None
        fragment_count = sample.fragments(self._timing.fragment_bytes)
        fragments_per_message = max(self._timing.message_bytes // self._timing.fragment_bytes, 1)
        for first in range(0, fragment_count, fragments_per_message):
            count = min(fragments_per_message, fragment_count - first)
            submessages: tuple[Submessage, ...] = (self._data(sample, first, count),)
            if self._is_reliable and first + fragments_per_message >= fragment_count:
                submessages += self._piggyback()
            self._transmit(submessages, (f"data{first}", sample.key))
        if evicted_sample is not None:
            self._give_up(evicted_sample, EVICTED)
        if not self._is_reliable:
            self._give_up(sample, OVERTAKEN)  # it is sent once; the reason applies only if it arrives too late

    def _data(self, sample: Sample, first: int, count: int) -> Data:
        for fragment in range(first, first + count):
            sample.times_sent[fragment] = sample.times_sent.get(fragment, 0) + 1
        fragment_bytes = self._timing.fragment_bytes
        return Data(sample, first, count, sample.fragments(fragment_bytes), fragment_bytes)

    def _piggyback(self) -> tuple[Submessage, ...]:
        """Return the heartbeat that is sent in the same message as data, or nothing if none is due."""
        now_ns = self._wire.now_ns
        # After a pause of 80 % of the interval, a separate heartbeat would soon require a response. If the heartbeat
        # in this message requires it, the separate one is not needed.
        requires_response = (
            now_ns >= self._last_write_ns + 4 * self._timing.heartbeat_ns // 5 or self._is_above_watermark()
        )
        since_heartbeat_ns = now_ns - self._last_heartbeat_ns
        self._last_write_ns = now_ns
        self._reset_heartbeat_rate()
        if not requires_response and since_heartbeat_ns <= _PIGGYBACK_PAUSE_NS:
            return ()
        return (self._heartbeat(final=not requires_response),)

    def _heartbeat(self, *, final: bool) -> Heartbeat:
        self._last_heartbeat_ns = self._wire.now_ns
        if not final:
            self._last_ack_request_ns = self._wire.now_ns
        self._heartbeats_since_write += 1
        return self._new_heartbeat(final=final, directed=False)

    def _new_heartbeat(self, *, final: bool, directed: bool) -> Heartbeat:
        self._heartbeat_count += 1
        return Heartbeat(
            self._history.first or self._last_number + 1, self._last_number, self._heartbeat_count, final, directed
        )

    def _send_heartbeat(self) -> None:
        if not (self._is_matched and (self._history.samples or not self._reader_responded)):
            return
        now_ns = self._wire.now_ns
        if now_ns >= self._last_heartbeat_ns + self._interval_ns():
            requires_response = (
                now_ns >= self._last_write_ns + self._timing.heartbeat_ns or self._is_above_watermark()
            )
            heartbeat = self._heartbeat(final=not requires_response)
            if self.share_heartbeat is None or now_ns % self._timing.heartbeat_ns:
                self._transmit((heartbeat,), self._key_of((heartbeat,)))
            else:
                self.share_heartbeat(heartbeat)
        self._schedule_heartbeat(self._interval_ns())

    def _schedule_heartbeat(self, after_ns: int) -> None:
        at_ns = self._wire.now_ns + after_ns
        if self.share_heartbeat is not None:
            # Round up to a multiple of the interval, so that the heartbeats of several writers are due together.
            at_ns += -at_ns % self._timing.heartbeat_ns
        self._heartbeat_timer.bring_forward(at_ns)

    def _interval_ns(self) -> int:
        """Return the time to the next heartbeat.

        It is doubled after the seventh heartbeat since the last write, and again after every second one, but
        stays below its limit. It is divided while much data is unacknowledged or samples wait.
        """
        interval_ns = self._timing.heartbeat_ns
        for _ in range((self._heartbeats_since_write - _HEARTBEATS_AT_FULL_RATE) // 2):
            if 2 * interval_ns >= self._timing.heartbeat_max_ns:
                break
            interval_ns *= 2
        interval_ns >>= self._history.fill_level + bool(self._waiting_samples)
        return max(interval_ns, self._timing.heartbeat_min_ns)

    def _is_above_watermark(self) -> bool:
        """Return True if so much data is unacknowledged that a response is required now."""
        return (
            self._history.fill_level > 0
            and self._wire.now_ns >= self._last_ack_request_ns + self._timing.ack_request_min_ns
        )

    def _reset_heartbeat_rate(self) -> None:
        self._heartbeats_since_write = 0
        self._schedule_heartbeat(self._timing.heartbeat_ns)

    def _on_nack(self, nack: AckNack) -> None:
        submessages: list[Submessage] = []
        first = self._history.first or self._last_number + 1
        if nack.missing[0] < first:
            submessages.append(Gap(nack.missing[0], first))
        for number in nack.missing:
            sample = self._history.samples.get(number)
            if sample is not None:
                # The first fragment contains the number of fragments; the reader then requests the others.
                submessages.append(self._data(sample, 0, 1))
        self._respond(submessages)

    def _on_nack_frag(self, nack: NackFrag) -> None:
        sample = self._history.samples.get(nack.number)
        if sample is None:
            self._respond([Gap(nack.number, nack.number + 1)] if nack.number <= self._last_number else [])
        else:
            fragment_count = sample.fragments(self._timing.fragment_bytes)
            self._respond([self._data(sample, fragment, 1) for fragment in nack.missing if fragment < fragment_count])

    def _respond(self, submessages: list[Submessage] | tuple[()]) -> None:
        """Send the requested data and a heartbeat in as few messages as possible."""
        if any(isinstance(submessage, Data) for submessage in submessages):
            self._history.on_resend()
        message: tuple[Submessage, ...] = ()
        for submessage in (*submessages, self._new_heartbeat(final=False, directed=True)):
            if message and ip_bytes((*message, submessage)) > self._timing.retransmit_bytes:
                self._transmit(message, self._key_of(message))
                message = ()
            message += (submessage,)
        self._transmit(message, self._key_of(message))
        self._reset_heartbeat_rate()

    def _key_of(self, message: tuple[Submessage, ...]) -> PacketIdentity:
        first_submessage = message[0]
        if isinstance(first_submessage, Data):
            return (
                f"data{first_submessage.first} again{first_submessage.sample.times_sent[first_submessage.first]}",
                first_submessage.sample.key,
            )
        if isinstance(first_submessage, Heartbeat):
            return "heartbeat", first_submessage.count
        self._gap_count += 1
        return "gap", self._gap_count

    def _resume(self) -> None:
        """Write waiting samples, if the writer was blocked and may resume."""
        if self._waiting_samples and self._history.can_resume:
            while self._waiting_samples and self._history.admits(self._wire.now_ns):
                sample = next(iter(self._waiting_samples))
                del self._waiting_samples[sample]
                self._send(sample)

    def _expire(self, sample: Sample) -> None:
        if sample in self._waiting_samples:
            del self._waiting_samples[sample]
            self._give_up(sample, BLOCKED)
