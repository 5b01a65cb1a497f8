"""Stream samples with a sequence number and a time from one robot to another, and log both ends.

A sample is a `std_msgs/UInt8MultiArray` with nothing in its layout, so that any tool of ROS can read it. Its data
begin with a magic, the sequence number and the time; the rest is random, so that nothing on the way makes it smaller.
"""

from __future__ import annotations

import random
import struct
import threading
import time
from dataclasses import dataclass

from fieldkit.agent import records
from fieldkit.agent.middleware import Middleware, Topic
from fieldkit.agent.records import Log, LogError

HEAD = struct.Struct("<8sqq")
"""Magic, sequence number, time in nanoseconds since 1970 UTC."""
MAGIC = b"fieldkit"

LEAST_BYTES = HEAD.size

# An empty sequence of dimensions, the offset, and the length of the data; in CDR behind the header of little-endian.
_ROS1 = struct.Struct("<III")
_CDR = struct.Struct("<4sIII")
_CDR_HEADER = b"\0\1\0\0"

_POLL_S = 0.001
WAKES_S = 0.2
"""A wait without end ends so often: a signal that the kernel gives to another thread wakes nobody who waits."""
SETTLES_S = 0.5
"""Between the moment at which a publisher knows a subscription, and the first sample: that is to know it, too."""
_DRAINS_S = 2.0


@dataclass(frozen=True)
class Stream:
    """What is streamed.

    Attributes:
        over: The middleware.
        size_bytes: Data of a sample, `LEAST_BYTES` or more.
        rate_hz: Samples per second.
        duration_s: How long.
        patience_s: How long the publisher waits for a subscription.
    """

    over: str
    size_bytes: int
    rate_hz: float
    duration_s: float
    patience_s: float


class SampleCodec:
    """Makes and reads samples.

    Args:
        stream: What is streamed.
    """

    def __init__(self, stream: Stream) -> None:
        size = stream.size_bytes
        self._envelope = _ROS1.pack(0, 0, size) if stream.over == "ros1" else _CDR.pack(_CDR_HEADER, 0, 0, size)
        self._filling = random.Random(size).getrandbits(8 * (size - HEAD.size) or 1).to_bytes(size, "little")  # noqa: S311
        self._filling = self._filling[: size - HEAD.size]
        self._size = len(self._envelope) + size

    def make(self, sequence: int, at_ns: int) -> bytes:
        """Return a sample, serialized."""
        return self._envelope + HEAD.pack(MAGIC, sequence, at_ns) + self._filling

    def read(self, data: bytes) -> tuple[int, int] | None:
        """Return the sequence number and the time of a sample; None where it is none of this stream."""
        start = len(self._envelope)
        # Others fill CDR to words of 4 bytes and do not say so.
        if not 0 <= len(data) - self._size < 4 or data[start : start + len(MAGIC)] != MAGIC:
            return None
        _, sequence, sent_ns = HEAD.unpack_from(data, start)
        return sequence, sent_ns


def publish(middleware: Middleware, topic: Topic, stream: Stream, log: Log, over: threading.Event) -> None:
    """Wait until a subscription is known, send samples at their times, and log each.

    A sample whose time has passed because the one before was still being written is skipped, as a robot's timer does.

    Args:
        middleware: It has started.
        topic: What is published.
        stream: How.
        log: What is told.
        over: Set when it is to end early.

    Raises:
        LogError: As `Log.note`.
    """
    samples = SampleCodec(stream)
    publisher = middleware.publisher(topic)
    deadline_s = time.monotonic() + stream.patience_s
    while not publisher.matched():
        if time.monotonic() > deadline_s or over.wait(_POLL_S):
            return
    log.note(records.MATCHED, time.time_ns())
    over.wait(SETTLES_S)
    begun_s, sequence, tick, ticks = time.monotonic(), 0, 0, round(stream.duration_s * stream.rate_hz)
    while tick < ticks:
        early_s = begun_s + tick / stream.rate_hz - time.monotonic()
        if over.wait(early_s) if early_s > 0 else over.is_set():
            return
        sent_ns = time.time_ns()
        data = samples.make(sequence, sent_ns)
        kind = records.SAMPLE if publisher.write(data) else records.REFUSED
        log.note(kind, time.time_ns(), size=len(data), sequence=sequence, sent_ns=sent_ns)
        sequence += 1
        due = min(int((time.monotonic() - begun_s) * stream.rate_hz), ticks)
        if due > tick + 1:
            log.note(records.SKIPPED, time.time_ns(), sequence=due - tick - 1)
        tick = max(tick + 1, due)
    publisher.drain(_DRAINS_S)
    over.wait(SETTLES_S)


def subscribe(middleware: Middleware, topic: Topic, stream: Stream, log: Log, over: threading.Event) -> None:
    """Log every sample that arrives until `over` is set; arguments as of `publish`.

    Raises:
        LogError: As `Log.note`; `over` is set then.
    """
    samples = SampleCodec(stream)
    failed: list[LogError] = []

    def take(data: bytes, at_ns: int) -> None:
        found = samples.read(data)
        try:
            if found is None:
                log.note(records.FOREIGN, at_ns, size=len(data))
            else:
                log.note(records.SAMPLE, at_ns, size=len(data), sequence=found[0], sent_ns=found[1])
        except LogError as error:
            # Raised in a thread of the middleware's, it would look as if nothing came any more.
            failed.append(error)
            over.set()

    matched = middleware.subscribe(topic, take)
    known = False
    while not over.wait(_POLL_S if not known else WAKES_S):
        if not known and matched() != 0:
            known = True
            log.note(records.MATCHED, time.time_ns())
    if failed:
        raise failed[0]
