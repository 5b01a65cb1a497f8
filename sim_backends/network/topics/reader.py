"""The reader of a flow: reassembles and orders samples, and requests missing ones from its writer.

The reader responds at the same times as CycloneDDS (`ddsi_acknack.c`, `ddsi_receive.c`), and omits a response if
CycloneDDS omits it, so that data in flight is not requested twice. It responds to heartbeats immediately. It requests
missing data immediately. It requests the same data again after a delay, or when a heartbeat shows that the writer has
responded.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

from sim_backends.network.topics.qos import SECOND, RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import AckNack, Data, Gap, Heartbeat, NackFrag, Sample, Submessage
from sim_backends.network.topics.writer import Transmit
from sim_backends.network.wire import Wire, WireTimer

_NEVER_NS: Final = -(10**18)
"""A time before the start of every run."""
_MAX_BITS: Final = 256
"""Largest number of samples, or of fragments of a sample, in the bitmap of one request."""
_INITIAL_BACKOFF: Final = ((10 * SECOND, 1), (60 * SECOND, 2), (120 * SECOND, 5))
"""Upper limits of the time since the reader was matched, each with a factor.

Up to the limit, the repetition interval is multiplied by the factor. After the last limit, the factor is 10.
"""

_Kind = Literal["ack", "nack", "nack_frag", "silent_ack", "silent_nack", "suppressed_nack"]


@dataclass(frozen=True, slots=True)
class _MissingFragments:
    """A sample and the indices of its missing fragments, from 0."""

    number: int
    missing: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Response:
    """The response that a reader may send now.

    Attributes:
        kind: Kind of response; a silent response is not sent; a suppressed response acknowledges without requesting
            data.
        numbers: Requested samples.
        missing_fragments: Requested fragments of the first sample after `numbers`; None for none.
        is_timed_repeat: True if it repeats a request only because enough time has passed since that request.
    """

    kind: _Kind
    numbers: tuple[int, ...]
    missing_fragments: _MissingFragments | None
    is_timed_repeat: bool

    @property
    def requests_data(self) -> bool:
        """True if it requests data."""
        return self.kind in {"nack", "nack_frag"}


class TopicReader:
    """A reader with one writer.

    Args:
        wire: Provides the clock.
        flow: Publisher, subscriber and quality of service.
        timing: Times of the protocol.
        transmit: Sends a message to the writer.
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
        self._is_reliable = flow.qos.reliability == "reliable"
        self._next_number = 1
        self._last_number = 0
        self._complete_samples: dict[int, Sample] = {}
        self._fragments: dict[int, tuple[set[int], int]] = {}
        self._is_matched = False
        self._has_received_heartbeat = False
        self._was_matched = self._is_rematched = False
        self._matched_ns = 0
        self._last_heartbeat_count = 0
        self._response_count = 0
        # State of the last response, and what has arrived since (see `pwr_rd_match` of CycloneDDS).
        self._last_base = 0
        # One beyond the last requested sample, and one beyond the last requested fragment of that sample.
        self._requested_end = (0, 0)
        self._requested_ns = self._acked_ns = _NEVER_NS
        self._was_timed_repeat = False
        self._has_new_heartbeat = self._is_response_requested = self._has_new_directed_heartbeat = False
        self._response_timer = WireTimer(wire, flow.subscriber, self._respond)

    @property
    def is_matched(self) -> bool:
        """True if the reader has a writer."""
        return self._is_matched

    def match(self, *, request_heartbeat: bool = True) -> None:
        """Add the writer; with `request_heartbeat`, request a heartbeat from it."""
        # A rematched reader may receive heartbeats for other readers, and accepts only the response to its own
        # request.
        self._is_rematched = request_heartbeat and self._was_matched
        self._was_matched = True
        self._is_matched = True
        self._has_received_heartbeat = not request_heartbeat
        self._matched_ns = self._wire.now_ns
        if self._is_reliable and request_heartbeat:
            self._response_timer.bring_forward(self._wire.now_ns + self._timing.first_acknack_ns)

    def remove_writer(self) -> list[Sample]:
        """Remove the writer; return the complete samples that were waiting for an earlier sample.

        The number of the last delivered sample is kept, so that no sample is delivered twice.
        """
        self._is_matched = False
        self._response_timer.stop()
        self._fragments.clear()
        undelivered = list(self._complete_samples.values())
        self._complete_samples.clear()
        for sample in undelivered:
            sample.is_stored = False
        return undelivered

    def on_message(self, message: Data | Heartbeat | Gap) -> None:
        """Process a submessage from the writer."""
        if not self._is_matched:
            return
        if isinstance(message, Data):
            self._on_data(message)
        elif self._is_reliable and isinstance(message, Gap):
            self._skip(message.first, message.end)
        elif self._is_reliable and isinstance(message, Heartbeat) and message.count > self._last_heartbeat_count:
            self._on_heartbeat(message)

    def _on_data(self, data: Data) -> None:
        """Store the fragments of a sample, and deliver all samples that are next in order."""
        number = data.sample.number
        if number < self._next_number or number in self._complete_samples:
            return
        fragments, _ = self._fragments.setdefault(number, (set(), data.fragment_count))
        fragments.update(range(data.first, data.first + data.count))
        if len(fragments) < data.fragment_count:
            # More fragments of this sample may be in flight, so only earlier samples may be missing.
            self._last_number = max(self._last_number, number - 1)
            return
        del self._fragments[number]
        self._last_number = max(self._last_number, number)
        self._complete_samples[number] = data.sample
        data.sample.is_stored = True
        if not self._is_reliable:
            # Samples that were overtaken are no longer expected, and are discarded if they arrive.
            self._skip(self._next_number, number)
        self._deliver_in_order()

    def _on_heartbeat(self, heartbeat: Heartbeat) -> None:
        self._last_heartbeat_count = heartbeat.count
        self._has_received_heartbeat |= heartbeat.directed or not self._is_rematched
        self._skip(self._next_number, heartbeat.first)
        self._last_number = max(self._last_number, heartbeat.last)
        self._has_new_heartbeat = True
        self._is_response_requested |= not heartbeat.final
        self._has_new_directed_heartbeat |= heartbeat.directed
        response = self._choose_response()
        if response.requests_data or response.kind == "ack":
            self._response_timer.bring_forward(self._wire.now_ns + self._timing.heartbeat_response_ns)
        elif response.kind != "silent_ack":
            self._response_timer.bring_forward(self._requested_ns + self._timing.nack_delay_ns)

    def _skip(self, first: int, end: int) -> None:
        """Stop waiting for samples from `first` to `end`, exclusive; ignored if an earlier sample is expected."""
        if first > self._next_number:
            return
        for number in [number for number in self._fragments if number < end]:
            del self._fragments[number]
        for number in sorted(number for number in self._complete_samples if number < end):
            self._next_number = number + 1
            self._deliver(self._complete_samples.pop(number))
        self._next_number = max(self._next_number, end)
        self._deliver_in_order()

    def _deliver_in_order(self) -> None:
        while (sample := self._complete_samples.pop(self._next_number, None)) is not None:
            self._next_number += 1
            self._deliver(sample)

    def _find_missing(self) -> tuple[tuple[int, ...], _MissingFragments | None]:
        """Return the missing samples before the first incomplete one, and the missing fragments of that sample.

        Both are limited to what one request can contain. The fragments are None if there is no incomplete sample.
        """
        numbers: list[int] = []
        for number in range(self._next_number, min(self._last_number + 1, self._next_number + _MAX_BITS)):
            if number in self._complete_samples:
                continue
            if number in self._fragments:
                fragments, fragment_count = self._fragments[number]
                missing_fragments = [part for part in range(fragment_count) if part not in fragments]
                return tuple(numbers), _MissingFragments(
                    number, tuple(part for part in missing_fragments if part < missing_fragments[0] + _MAX_BITS)
                )
            numbers.append(number)
        return tuple(numbers), None

    def _choose_response(self) -> _Response:
        """Return the response that is due now."""
        numbers, missing_fragments = self._find_missing()
        now_ns = self._wire.now_ns
        kind: _Kind = "silent_ack"
        if numbers or missing_fragments:
            may_repeat = now_ns >= self._requested_ns + self._timing.nack_delay_ns
            # True if the first missing data was not requested before.
            is_new = (
                self._next_number,
                missing_fragments.missing[0] if missing_fragments else 0,
            ) >= self._requested_end
            # True if the writer has answered the last request, and data is still missing.
            was_resent = self._has_new_directed_heartbeat and (not self._was_timed_repeat or may_repeat)
            if is_new or was_resent or may_repeat:
                requests_only_fragments = (
                    missing_fragments is not None and not numbers and not self._is_response_requested
                )
                is_timed_repeat = not is_new and not was_resent
                return _Response(
                    "nack_frag" if requests_only_fragments else "nack", numbers, missing_fragments, is_timed_repeat
                )
            kind = "silent_nack"
        may_acknowledge = self._next_number > self._last_base or now_ns >= self._acked_ns + self._timing.ack_delay_ns
        if self._has_new_heartbeat and self._is_response_requested and may_acknowledge:
            kind = "ack" if kind == "silent_ack" else "suppressed_nack"
        return _Response(kind, (), None, self._was_timed_repeat)

    def _respond(self) -> None:
        if not self._is_matched:
            return
        if not self._has_received_heartbeat:
            self._send_initial_acknack()
            return
        now_ns = self._wire.now_ns
        response = self._choose_response()
        if response.requests_data:
            self._response_timer.bring_forward(now_ns + self._timing.nack_repeat_ns)
        elif response.kind in {"silent_nack", "suppressed_nack"}:
            due_ns = self._requested_ns + self._timing.nack_delay_ns
            self._response_timer.bring_forward(due_ns if due_ns >= now_ns else now_ns + self._timing.nack_delay_ns)
        if response.kind not in {"silent_ack", "silent_nack"}:
            self._send(response)

    def _send(self, response: _Response) -> None:
        """Send a response, and record what it requests and acknowledges."""
        now_ns = self._wire.now_ns
        self._has_new_heartbeat = self._has_new_directed_heartbeat = False
        self._was_timed_repeat = response.is_timed_repeat
        submessages: tuple[Submessage, ...] = ()
        if response.kind != "nack_frag":
            self._is_response_requested = False
            self._acked_ns = now_ns
            submessages = (AckNack(self._next_number, response.numbers, self._next_count()),)
        if response.missing_fragments:
            submessages += (
                NackFrag(response.missing_fragments.number, response.missing_fragments.missing, self._next_count()),
            )
        if response.requests_data:
            self._requested_ns = now_ns
            self._requested_end = (response.numbers[-1] + 1 if response.numbers else self._next_number, 0)
            if response.missing_fragments:
                self._requested_end = response.missing_fragments.number, response.missing_fragments.missing[-1] + 1
        self._last_base = self._next_number
        self._transmit(submessages, ("acknack", self._response_count))

    def _send_initial_acknack(self) -> None:
        """Send an ACKNACK that requests a heartbeat, and repeat it until a heartbeat arrives."""
        age_ns = self._wire.now_ns - self._matched_ns
        factor = next((factor for until_ns, factor in _INITIAL_BACKOFF if age_ns <= until_ns), 10)
        self._response_timer.bring_forward(self._wire.now_ns + factor * self._timing.first_acknack_repeat_ns)
        # CycloneDDS sends the count 0, for which its writers have an exception; a normal count needs no exception.
        acknack = AckNack(self._next_number, (), self._next_count(), final=False)
        self._transmit((acknack,), ("acknack", self._response_count))

    def _next_count(self) -> int:
        self._response_count += 1
        return self._response_count
