"""The writer of a flow: sends samples, tells its reader what there is, and sends again what that asks for.

It behaves as CycloneDDS does (`ddsi_transmit.c`, `ddsi_hbcontrol.c`, `ddsi_receive.c`), which keeps DDSI-RTPS 2.5,
clauses 8.4.7 to 8.4.9: after every sample a heartbeat in the same message, which asks for an answer only when the
sample before is long gone; heartbeats of their own while something is unacknowledged, less often the longer nobody
answers; and one after whatever was asked for again.
"""

from collections.abc import Callable, Iterable
from typing import Final

from sim_backends.network.timer import WireTimer
from sim_backends.network.topics.history import WriterHistory
from sim_backends.network.topics.qos import RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import AckNack, Data, Gap, Heartbeat, NackFrag, Sample, Submessage, ip_bytes
from sim_backends.network.wire import Wire
from sim_backends.radio.random_streams import PacketIdentity

Transmit = Callable[[tuple[Submessage, ...], PacketIdentity], None]
"""Sends a message to the other end; what draws over it are keyed by begins with the kind of message."""

PUSHED_OUT: Final = "pushed out of the writer's history before it was acknowledged"
OVERTAKEN: Final = "overtaken by a later sample"
"""What becomes of a sample that nobody sends again, unless it is lost or delivered."""
BLOCKED: Final = "the writer was blocked for longer than max_blocking_time"
_LONG_AGO_NS: Final = -(10**18)
_PIGGYBACK_PAUSE_NS: Final = 100_000
_HEARTBEATS_AT_FULL_RATE: Final = 5


class TopicWriter:
    """A writer with one reader.

    Args:
        wire: Keeps the time.
        flow: From whom to whom, and its quality of service.
        timing: Of the protocol.
        transmit: Sends to the reader.
        give_up: Called with a sample that is never sent, or never again, and the reason.

    Attributes:
        begun: Called when its reader begins, or begins anew.
        share: Takes heartbeats of their own that lie on whole periods, to send them with those of other writers; None
            sends them.
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
        self._reliable = flow.qos.reliability == "reliable"
        self._max_blocking_ns = flow.qos.max_blocking_ns
        self._history = WriterHistory(flow.qos, timing)
        self._waiting: dict[Sample, None] = {}
        self._last = 0
        self._matched = False
        self._answered = False
        # Counts of heartbeats and gaps, and that of the reader's last message.
        self._heartbeats = self._gaps = self._taken = 0
        self._heartbeats_since_write = 0
        self._wrote_ns = self._beat_ns = self._asked_ns = _LONG_AGO_NS
        self._beat = WireTimer(wire, flow.publisher, self._heartbeat_alone)
        self.begun: Callable[[], None] = lambda: None
        self.share: Callable[[Heartbeat], None] | None = None

    @property
    def matched(self) -> bool:
        """Whether there is a reader to write to."""
        return self._matched

    @property
    def last(self) -> int:
        """The sequence number of its last sample."""
        return self._last

    @property
    def unacknowledged(self) -> Iterable[Sample]:
        """The samples that its reader has not acknowledged, the oldest first."""
        return self._history.samples.values()

    def match(self, *, answered: bool = False) -> None:
        """Take it that there is a reader from now on; heartbeats call it unless it has `answered` already."""
        self._matched = True
        self._answered = answered
        self._heartbeats_since_write = 0
        if self._reliable and not answered:
            self._beat.bring_forward(self._wire.now_ns + self._timing.first_heartbeat_ns)

    def offer(self, sample: Sample) -> None:
        """Have a sample for its reader to ask for, of which the next heartbeat tells."""
        self._last += 1
        sample.number = self._last
        self._history.insert(sample)

    def unmatch(self, reason: str) -> None:
        """Take it that there is no reader any more: what is unacknowledged is given up."""
        self._matched = False
        self._beat.stop()
        waiting, self._waiting = self._waiting, {}
        for sample in (*self._history.clear(), *waiting):
            self._give_up(sample, reason)

    def write(self, sample: Sample) -> None:
        """Send a sample now, or when the writer is no longer blocked."""
        if not self._waiting and (not self._reliable or self._history.admits(self._wire.now_ns)):
            self._send(sample)
            return
        if not self._waiting:
            # As the writer begins to block, it asks for the acknowledgements that it waits for.
            heartbeat = self._heartbeat(final=False)
            self._transmit((heartbeat,), self._key_of((heartbeat,)))
        self._waiting[sample] = None
        if self._max_blocking_ns is not None:
            self._wire.at(self._wire.now_ns + self._max_blocking_ns, self._host, lambda: self._expire(sample))

    def take(self, message: AckNack | NackFrag) -> None:
        """Take what the reader answered: forget what it has, send again what it asks for."""
        if not self._matched or message.count <= self._taken:
            return
        self._taken = message.count
        if isinstance(message, NackFrag):
            self._answer_nack_frag(message)
            return
        self._answered = True
        self._history.acknowledge(message.base)
        if not message.final and not message.missing:
            self.begun()
            self._respond(())
        elif message.missing:
            self._answer_nack(message)
        self._go_on()

    def _send(self, sample: Sample) -> None:
        self._last += 1
        sample.number = self._last
        pushed_out = self._history.insert(sample) if self._reliable else None
        of = sample.fragments(self._timing.fragment_bytes)
        per_message = max(self._timing.message_bytes // self._timing.fragment_bytes, 1)
        for first in range(0, of, per_message):
            submessages: tuple[Submessage, ...] = (self._data(sample, first, min(per_message, of - first)),)
            if self._reliable and first + per_message >= of:
                submessages += self._piggyback()
            self._transmit(submessages, (f"data{first}", sample.key))
        if pushed_out is not None:
            self._give_up(pushed_out, PUSHED_OUT)
        if not self._reliable:
            self._give_up(sample, OVERTAKEN)

    def _data(self, sample: Sample, first: int, count: int) -> Data:
        for fragment in range(first, first + count):
            sample.times_sent[fragment] = sample.times_sent.get(fragment, 0) + 1
        fragment_bytes = self._timing.fragment_bytes
        return Data(sample, first, count, sample.fragments(fragment_bytes), fragment_bytes)

    def _piggyback(self) -> tuple[Submessage, ...]:
        now_ns = self._wire.now_ns
        # Asking is due soon, and this saves a message of its own.
        asks = now_ns >= self._wrote_ns + 4 * self._timing.heartbeat_ns // 5 or self._crowded()
        since_beat_ns = now_ns - self._beat_ns
        self._wrote_ns = now_ns
        self._keep_rate()
        if not asks and since_beat_ns <= _PIGGYBACK_PAUSE_NS:
            return ()
        return (self._heartbeat(final=not asks),)

    def _heartbeat(self, *, final: bool) -> Heartbeat:
        self._beat_ns = self._wire.now_ns
        if not final:
            self._asked_ns = self._wire.now_ns
        self._heartbeats_since_write += 1
        return self._new_heartbeat(final=final, directed=False)

    def _new_heartbeat(self, *, final: bool, directed: bool) -> Heartbeat:
        self._heartbeats += 1
        return Heartbeat(self._history.first or self._last + 1, self._last, self._heartbeats, final, directed)

    def _heartbeat_alone(self) -> None:
        if not (self._matched and (self._history.samples or not self._answered)):
            return
        now_ns = self._wire.now_ns
        if now_ns >= self._beat_ns + self._interval_ns():
            asks = now_ns >= self._wrote_ns + self._timing.heartbeat_ns or self._crowded()
            heartbeat = self._heartbeat(final=not asks)
            if self.share is None or now_ns % self._timing.heartbeat_ns:
                self._transmit((heartbeat,), self._key_of((heartbeat,)))
            else:
                self.share(heartbeat)
        self._plan_heartbeat(self._interval_ns())

    def _plan_heartbeat(self, after_ns: int) -> None:
        at_ns = self._wire.now_ns + after_ns
        if self.share is not None:
            at_ns += -at_ns % self._timing.heartbeat_ns
        self._beat.bring_forward(at_ns)

    def _interval_ns(self) -> int:
        """Return the time from one heartbeat to the next: twice as long after every second one, from the sixth on."""
        interval_ns = self._timing.heartbeat_ns
        for _ in range((self._heartbeats_since_write - _HEARTBEATS_AT_FULL_RATE) // 2):
            if 2 * interval_ns >= self._timing.heartbeat_max_ns:
                break
            interval_ns *= 2
        interval_ns >>= self._history.crowding + bool(self._waiting)
        return max(interval_ns, self._timing.heartbeat_min_ns)

    def _crowded(self) -> bool:
        """Whether so much is unacknowledged that it is time to ask."""
        return self._history.crowding > 0 and self._wire.now_ns >= self._asked_ns + self._timing.heartbeat_ask_ns

    def _keep_rate(self) -> None:
        self._heartbeats_since_write = 0
        self._plan_heartbeat(self._timing.heartbeat_ns)

    def _answer_nack(self, nack: AckNack) -> None:
        again: list[Submessage] = []
        first = self._history.first or self._last + 1
        if nack.missing[0] < first:
            again.append(Gap(nack.missing[0], first))
        for number in nack.missing:
            sample = self._history.samples.get(number)
            if sample is not None:
                # Of a larger one the reader asks for the rest once it knows how many fragments there are.
                again.append(self._data(sample, 0, 1))
        self._respond(again)

    def _answer_nack_frag(self, nack: NackFrag) -> None:
        sample = self._history.samples.get(nack.number)
        if sample is None:
            self._respond([Gap(nack.number, nack.number + 1)] if nack.number <= self._last else [])
        else:
            of = sample.fragments(self._timing.fragment_bytes)
            self._respond([self._data(sample, fragment, 1) for fragment in nack.missing if fragment < of])

    def _respond(self, again: list[Submessage] | tuple[()]) -> None:
        """Send what was asked for again, and a heartbeat, in as few messages as hold them."""
        if any(isinstance(one, Data) for one in again):
            self._history.note_repeat()
        message: tuple[Submessage, ...] = ()
        for submessage in (*again, self._new_heartbeat(final=False, directed=True)):
            if message and ip_bytes((*message, submessage)) > self._timing.answer_bytes:
                self._transmit(message, self._key_of(message))
                message = ()
            message += (submessage,)
        self._transmit(message, self._key_of(message))
        self._keep_rate()

    def _key_of(self, message: tuple[Submessage, ...]) -> PacketIdentity:
        head = message[0]
        if isinstance(head, Data):
            return f"data{head.first} again{head.sample.times_sent[head.first]}", head.sample.key
        if isinstance(head, Heartbeat):
            return "heartbeat", head.count
        self._gaps += 1
        return "gap", self._gaps

    def _go_on(self) -> None:
        """Write what waited, if the writer was blocked and no longer is."""
        if self._waiting and self._history.lets_go_on:
            while self._waiting and self._history.admits(self._wire.now_ns):
                sample = next(iter(self._waiting))
                del self._waiting[sample]
                self._send(sample)

    def _expire(self, sample: Sample) -> None:
        if sample in self._waiting:
            del self._waiting[sample]
            self._give_up(sample, BLOCKED)
