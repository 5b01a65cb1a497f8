"""The history of a reliable writer: what it can send again, and when there is too much of that to write on."""

from typing import Final

from sim_backends.network.topics.qos import MS, Qos, RtpsTiming
from sim_backends.network.topics.rtps import Sample

_GROWTH_PAUSE_NS: Final = 10 * MS


class WriterHistory:
    """Samples that are not acknowledged.

    With `keep_all` a writer blocks while they are above a mark, until they are below another and nothing that was
    asked for again is unacknowledged. The upper mark grows while nothing is lost, and shrinks when something is
    (CycloneDDS, `ddsi_transmit.c`: `throttle_writer`, `maybe_grow_whc`; `ddsi_endpoint.c`: `set_retransmitting`).

    Args:
        qos: Of the flow.
        timing: With the marks.

    Attributes:
        samples: By sequence number, the oldest first; without holes.
        unacknowledged_bytes: Their sizes together.
    """

    def __init__(self, qos: Qos, timing: RtpsTiming) -> None:
        self._depth = qos.depth if qos.history == "keep_last" else None
        self._low_bytes = timing.low_bytes
        self._high_bytes = timing.high_bytes
        self._most_high_bytes = timing.most_high_bytes
        self._grew_ns = 0
        self._repeating = False
        self.samples: dict[int, Sample] = {}
        self.unacknowledged_bytes = 0

    @property
    def first(self) -> int | None:
        """The oldest sequence number; None where everything is acknowledged."""
        return next(iter(self.samples), None)

    def insert(self, sample: Sample) -> Sample | None:
        """Keep a sample that is sent now; return the one that it pushes out."""
        self.samples[sample.number] = sample
        self.unacknowledged_bytes += sample.size_bytes
        if self._depth is None or len(self.samples) <= self._depth:
            return None
        return self._remove(next(iter(self.samples)))

    def acknowledge(self, base: int) -> None:
        """Forget the samples before `base`."""
        for number in [number for number in self.samples if number < base]:
            self._remove(number)
        if not self.samples:
            self._repeating = False

    def clear(self) -> list[Sample]:
        """Forget everything; return what was there."""
        samples = list(self.samples.values())
        self.acknowledge(max(self.samples, default=0) + 1)
        return samples

    def note_repeat(self) -> None:
        """Take it that something is sent again: the upper mark shrinks once, until all is acknowledged."""
        if not self._repeating:
            self._repeating = True
            self._high_bytes = max(8 * self._high_bytes // 10, self._low_bytes)

    def admits(self, now_ns: int) -> bool:
        """Return whether a writer may write now, after raising the upper mark where that stands against it."""
        if self._depth is not None or self.unacknowledged_bytes <= self._high_bytes:
            return True
        room = self._most_high_bytes - self._high_bytes
        if not self._repeating and room > 0 and now_ns >= self._grew_ns + _GROWTH_PAUSE_NS:
            self._high_bytes += room // 32 or room
            self._grew_ns = now_ns
        return self.unacknowledged_bytes <= self._high_bytes

    @property
    def lets_go_on(self) -> bool:
        """Whether a writer that was blocked may write again."""
        return self.unacknowledged_bytes <= self._low_bytes and not self._repeating

    @property
    def crowding(self) -> int:
        """How full it is: 0 below half of the way between the marks, 1 below three quarters, 2 above."""
        if self._depth is not None:
            return 0
        span_bytes = self._high_bytes - self._low_bytes
        above_bytes = self.unacknowledged_bytes - self._low_bytes
        return (above_bytes >= span_bytes // 2) + (above_bytes >= 3 * span_bytes // 4)

    def _remove(self, number: int) -> Sample:
        sample = self.samples.pop(number)
        self.unacknowledged_bytes -= sample.size_bytes
        return sample
