"""The reader of a flow: puts samples together and in order, and asks its writer for what it misses.

When it answers, and when it keeps quiet so that nothing is asked for twice while it is on its way, is as in
CycloneDDS (`ddsi_acknack.c`, `ddsi_receive.c`): it answers heartbeats at once; it asks at once for what it has not
asked for before, and for the same again after a delay, or when the writer has told what it sent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

from sim_backends.network.timer import WireTimer
from sim_backends.network.topics.qos import SECOND, RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import AckNack, Data, Gap, Heartbeat, NackFrag, Sample, Submessage
from sim_backends.network.topics.writer import Transmit
from sim_backends.network.wire import Wire

_LONG_AGO_NS: Final = -(10**18)
_MOST_BITS: Final = 256
_BEGIN_BACKOFF: Final = ((10 * SECOND, 1), (60 * SECOND, 2), (120 * SECOND, 5))
"""How long a reader has begun, and by how much less often it then repeats; 10 beyond."""

_Kind = Literal["ack", "nack", "nack_frag", "silent_ack", "silent_nack", "suppressed_nack"]


@dataclass(frozen=True, slots=True)
class _Lacking:
    """Fragments, from 0, that a sample lacks."""

    number: int
    missing: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Answer:
    """What a reader may say now.

    Attributes:
        kind: Silent ones are not sent; a suppressed one acknowledges, and asks for nothing.
        numbers: Samples that it asks for.
        lacking: And fragments of the one after them.
        by_delay: Whether it asks only because enough time has passed since it asked for the same.
    """

    kind: _Kind
    numbers: tuple[int, ...]
    lacking: _Lacking | None
    by_delay: bool

    @property
    def asks(self) -> bool:
        """Whether it asks for something."""
        return self.kind in {"nack", "nack_frag"}


class TopicReader:
    """A reader with one writer.

    Args:
        wire: Keeps the time.
        flow: From whom to whom, and its quality of service.
        timing: Of the protocol.
        transmit: Sends to the writer.
        deliver: Called with each sample, in order and at most once.
    """

    def __init__(
        self,
        wire: Wire,
        flow: TopicFlow,
        timing: RtpsTiming,
        transmit: Transmit,
        deliver: Callable[[Sample], None],
    ) -> None:
        self._wire = wire
        self._timing = timing
        self._transmit = transmit
        self._deliver = deliver
        self._reliable = flow.qos.reliability == "reliable"
        self._next = 1
        self._last = 0
        self._whole: dict[int, Sample] = {}
        self._parts: dict[int, tuple[set[int], int]] = {}
        self._matched = False
        self._beaten = False
        self._begun = self._anew = False
        self._begun_ns = 0
        self._heartbeats = 0
        self._answers = 0
        # What the last answer was, and what has come since (see `pwr_rd_match` of CycloneDDS).
        self._asked_from = 0
        # One beyond the last sample that was asked for, and one beyond the last fragment of that sample.
        self._asked_to = (0, 0)
        self._asked_ns = self._acknowledged_ns = _LONG_AGO_NS
        self._asked_by_delay = False
        self._heartbeat_came = self._answer_wanted = self._directed_came = False
        self._answer = WireTimer(wire, flow.subscriber, self._answer_now)

    @property
    def matched(self) -> bool:
        """Whether there is a writer to listen to."""
        return self._matched

    def match(self, *, begin: bool = True) -> None:
        """Take it that there is a writer from now on; `begin` by asking it for a heartbeat."""
        # One that begins anew may hear heartbeats that are not for it, and takes only the answer to its own question.
        self._anew = begin and self._begun
        self._begun = True
        self._matched = True
        self._beaten = not begin
        self._begun_ns = self._wire.now_ns
        if self._reliable and begin:
            self._answer.bring_forward(self._wire.now_ns + self._timing.begin_ns)

    def unmatch(self) -> list[Sample]:
        """Take it that there is no writer any more; return the samples that waited for one before them.

        Which was the last that was delivered is remembered, so that nothing is delivered twice.
        """
        self._matched = False
        self._answer.stop()
        self._parts.clear()
        waited = list(self._whole.values())
        self._whole.clear()
        for sample in waited:
            sample.held = False
        return waited

    def take(self, message: Data | Heartbeat | Gap) -> None:
        """Take what the writer sent."""
        if not self._matched:
            return
        if isinstance(message, Data):
            self._take_data(message)
        elif self._reliable and isinstance(message, Gap):
            self._skip(message.first, message.end)
        elif self._reliable and isinstance(message, Heartbeat) and message.count > self._heartbeats:
            self._take_heartbeat(message)

    def _take_data(self, data: Data) -> None:
        number = data.sample.number
        if number < self._next or number in self._whole:
            return
        parts, _ = self._parts.setdefault(number, (set(), data.of))
        parts.update(range(data.first, data.first + data.count))
        if len(parts) < data.of:
            # Of the sample itself more may be on its way.
            self._last = max(self._last, number - 1)
            return
        del self._parts[number]
        self._last = max(self._last, number)
        self._whole[number] = data.sample
        data.sample.held = True
        if not self._reliable:
            # What was overtaken is not waited for, and is not taken when it comes.
            self._skip(self._next, number)
        self._deliver_in_order()

    def _take_heartbeat(self, heartbeat: Heartbeat) -> None:
        self._heartbeats = heartbeat.count
        self._beaten |= heartbeat.directed or not self._anew
        self._skip(self._next, heartbeat.first)
        self._last = max(self._last, heartbeat.last)
        self._heartbeat_came = True
        self._answer_wanted |= not heartbeat.final
        self._directed_came |= heartbeat.directed
        answer = self._choose()
        if answer.asks or answer.kind == "ack":
            self._answer.bring_forward(self._wire.now_ns + self._timing.heartbeat_response_ns)
        elif answer.kind != "silent_ack":
            self._answer.bring_forward(self._asked_ns + self._timing.nack_delay_ns)

    def _skip(self, first: int, end: int) -> None:
        """Wait no longer for samples from `first` to before `end`."""
        if first > self._next:
            return
        for number in [number for number in self._parts if number < end]:
            del self._parts[number]
        for number in sorted(number for number in self._whole if number < end):
            self._next = number + 1
            self._deliver(self._whole.pop(number))
        self._next = max(self._next, end)
        self._deliver_in_order()

    def _deliver_in_order(self) -> None:
        while (sample := self._whole.pop(self._next, None)) is not None:
            self._next += 1
            self._deliver(sample)

    def _missing(self) -> tuple[tuple[int, ...], _Lacking | None]:
        """Return the samples that are missing up to the first of which a part is there, and what lacks of that."""
        numbers: list[int] = []
        for number in range(self._next, min(self._last + 1, self._next + _MOST_BITS)):
            if number in self._whole:
                continue
            if number in self._parts:
                parts, of = self._parts[number]
                lacking = [part for part in range(of) if part not in parts]
                return tuple(numbers), _Lacking(
                    number, tuple(one for one in lacking if one < lacking[0] + _MOST_BITS)
                )
            numbers.append(number)
        return tuple(numbers), None

    def _choose(self) -> _Answer:
        """Return what answer is due now."""
        numbers, lacking = self._missing()
        now_ns = self._wire.now_ns
        kind: _Kind = "silent_ack"
        if numbers or lacking:
            may_repeat = now_ns >= self._asked_ns + self._timing.nack_delay_ns
            unasked = (self._next, lacking.missing[0] if lacking else 0) >= self._asked_to
            written = self._directed_came and (not self._asked_by_delay or may_repeat)
            if unasked or written or may_repeat:
                only = lacking is not None and not numbers and not self._answer_wanted
                by_delay = not unasked and not written
                return _Answer("nack_frag" if only else "nack", numbers, lacking, by_delay)
            kind = "silent_nack"
        progress = self._next > self._asked_from or now_ns >= self._acknowledged_ns + self._timing.ack_delay_ns
        if self._heartbeat_came and self._answer_wanted and progress:
            kind = "ack" if kind == "silent_ack" else "suppressed_nack"
        return _Answer(kind, (), None, self._asked_by_delay)

    def _answer_now(self) -> None:
        if not self._matched:
            return
        if not self._beaten:
            self._begin()
            return
        now_ns = self._wire.now_ns
        answer = self._choose()
        if answer.asks:
            self._answer.bring_forward(now_ns + self._timing.nack_repeat_ns)
        elif answer.kind in {"silent_nack", "suppressed_nack"}:
            due_ns = self._asked_ns + self._timing.nack_delay_ns
            self._answer.bring_forward(due_ns if due_ns >= now_ns else now_ns + self._timing.nack_delay_ns)
        if answer.kind not in {"silent_ack", "silent_nack"}:
            self._send(answer)

    def _send(self, answer: _Answer) -> None:
        now_ns = self._wire.now_ns
        self._heartbeat_came = self._directed_came = False
        self._asked_by_delay = answer.by_delay
        submessages: tuple[Submessage, ...] = ()
        if answer.kind != "nack_frag":
            self._answer_wanted = False
            self._acknowledged_ns = now_ns
            submessages = (AckNack(self._next, answer.numbers, self._count()),)
        if answer.lacking:
            submessages += (NackFrag(answer.lacking.number, answer.lacking.missing, self._count()),)
        if answer.asks:
            self._asked_ns = now_ns
            self._asked_to = (answer.numbers[-1] + 1 if answer.numbers else self._next, 0)
            if answer.lacking:
                self._asked_to = answer.lacking.number, answer.lacking.missing[-1] + 1
        self._asked_from = self._next
        self._transmit(submessages, ("acknack", self._answers))

    def _begin(self) -> None:
        """Ask for a heartbeat, and again until one comes."""
        age_ns = self._wire.now_ns - self._begun_ns
        factor = next((factor for until_ns, factor in _BEGIN_BACKOFF if age_ns <= until_ns), 10)
        self._answer.bring_forward(self._wire.now_ns + factor * self._timing.begin_repeat_ns)
        # CycloneDDS counts it 0, which its writers except from their rule; counted like all others it needs none.
        begin = AckNack(self._next, (), self._count(), final=False)
        self._transmit((begin,), ("acknack", self._answers))

    def _count(self) -> int:
        self._answers += 1
        return self._answers
