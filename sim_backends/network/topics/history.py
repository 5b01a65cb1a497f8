"""The history of a reliable writer: samples that it can send again, and the limits at which it blocks."""

from typing import Final

from sim_backends.network.topics.qos import MS, Qos, RtpsTiming
from sim_backends.network.topics.rtps import Sample

_GROWTH_PAUSE_NS: Final = 10 * MS
"""Minimum time between two increases of the high watermark."""


class WriterHistory:
    """The unacknowledged samples.

    With `keep_all` a writer blocks when the sum of the samples' sizes exceeds a high watermark. It resumes when the
    sum is at most a low watermark; after a retransmission, it resumes only when all samples are acknowledged. The
    high watermark grows while nothing is lost, and shrinks after a loss (CycloneDDS, `ddsi_transmit.c`:
    `throttle_writer`, `maybe_grow_whc`; `ddsi_endpoint.c`: `set_retransmitting`).

    Args:
        qos: Quality of service of the flow.
        timing: Contains the watermarks.

    Attributes:
        samples: Samples by sequence number, oldest first, without gaps.
        unacknowledged_bytes: Sum of the sizes of these samples.
    """

    def __init__(self, qos: Qos, timing: RtpsTiming) -> None:
        self._depth = qos.depth if qos.history == "keep_last" else None
        self._low_bytes = timing.low_bytes
        self._high_bytes = timing.high_bytes
        self._max_high_bytes = timing.max_high_bytes
        self._last_growth_ns = 0
        self._has_resent = False
        self.samples: dict[int, Sample] = {}
        self.unacknowledged_bytes = 0

    @property
    def first(self) -> int | None:
        """The oldest sequence number; None if all samples are acknowledged."""
        return next(iter(self.samples), None)

    def insert(self, sample: Sample) -> Sample | None:
        """Insert the newest sample; return the sample that it evicts, or None."""
        self.samples[sample.number] = sample
        self.unacknowledged_bytes += sample.size_bytes
        if self._depth is None or len(self.samples) <= self._depth:
            return None
        return self._remove(next(iter(self.samples)))

    def acknowledge(self, base: int) -> None:
        """Remove the samples before `base`."""
        for number in [number for number in self.samples if number < base]:
            self._remove(number)
        if not self.samples:
            self._has_resent = False

    def clear(self) -> list[Sample]:
        """Remove and return all samples."""
        samples = list(self.samples.values())
        self.acknowledge(max(self.samples, default=0) + 1)
        return samples

    def on_resend(self) -> None:
        """Reduce the high watermark by 20 % at a retransmission, but only once until all samples are acknowledged."""
        if not self._has_resent:
            self._has_resent = True
            self._high_bytes = max(8 * self._high_bytes // 10, self._low_bytes)

    def admits(self, now_ns: int) -> bool:
        """Return True if a writer may write now; raise the high watermark if it prevents writing and may grow."""
        if self._depth is not None or self.unacknowledged_bytes <= self._high_bytes:
            return True
        headroom_bytes = self._max_high_bytes - self._high_bytes
        if not self._has_resent and headroom_bytes > 0 and now_ns >= self._last_growth_ns + _GROWTH_PAUSE_NS:
            self._high_bytes += headroom_bytes // 32 or headroom_bytes
            self._last_growth_ns = now_ns
        return self.unacknowledged_bytes <= self._high_bytes

    @property
    def can_resume(self) -> bool:
        """True if a blocked writer may write again."""
        return self.unacknowledged_bytes <= self._low_bytes and not self._has_resent

    @property
    def fill_level(self) -> int:
        """Fill level: 0 below the middle between the watermarks, 1 below three quarters, otherwise 2.

        With `keep_last` it is always 0.
        """
        if self._depth is not None:
            return 0
        span_bytes = self._high_bytes - self._low_bytes
        above_bytes = self.unacknowledged_bytes - self._low_bytes
        return (above_bytes >= span_bytes // 2) + (above_bytes >= 3 * span_bytes // 4)

    def _remove(self, number: int) -> Sample:
        sample = self.samples.pop(number)
        self.unacknowledged_bytes -= sample.size_bytes
        return sample
