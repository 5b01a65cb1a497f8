"""Log periodic reads of the newest received sample, as a control loop of a robot or a display reads it."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from typing import Iterator

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.records import Log, LogError

_NO_SAMPLE = (-1, 0)


class NewestSample:
    """The sample with the highest number that has arrived. Several threads may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sample = _NO_SAMPLE

    def offer(self, sequence: int, sent_ns: int) -> None:
        """Add a sample that has arrived."""
        with self._lock:
            self._sample = max(self._sample, (sequence, sent_ns))

    def read(self) -> tuple[int, int]:
        """Return the number and the send time of the newest sample; the number is -1 if none has arrived."""
        with self._lock:
            return self._sample


@contextmanager
def logged_reads(newest: NewestSample, rate_hz: float, log: Log, stop_event: threading.Event) -> Iterator[None]:
    """Read the newest sample at a rate, and log each read, while the body runs; do nothing if the rate is 0.

    If a read takes longer than a period, the reads whose scheduled times have passed meanwhile are skipped.

    Args:
        newest: The newest sample.
        rate_hz: Reads per second.
        log: The log.
        stop_event: Set by this function if the log cannot be written.

    Raises:
        LogError: After the body, for the same reasons as `Log.note`.
    """
    if rate_hz <= 0:
        yield
        return
    body_ended = threading.Event()
    errors: list[LogError] = []

    def read() -> None:
        start_s, tick = time.monotonic(), 0
        while not body_ended.wait(max(start_s + tick / rate_hz - time.monotonic(), 0)):
            sequence, sent_ns = newest.read()
            try:
                log.note(records.READ, time.time_ns(), sequence=sequence, sent_ns=sent_ns)
            except LogError as error:
                errors.append(error)
                stop_event.set()
                return
            tick = max(tick + 1, int((time.monotonic() - start_s) * rate_hz) + 1)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield
    finally:
        body_ended.set()
        reader.join()
    if errors:
        raise errors[0]
