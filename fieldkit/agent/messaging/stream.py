"""Stream samples with sequence numbers and times from one robot to another, and log them on both robots.

By default, a sample is a `std_msgs/UInt8MultiArray` with an empty layout, which all ROS tools can read. Its data
start with a magic number, the sequence number and the time. Random bytes follow, so that compression does not change
the size. In an image stream, a sample is a `sensor_msgs/Image` of a synthetic camera, with number and time in its
pixels.
"""

from __future__ import annotations

import random
import struct
import threading
import time
from dataclasses import dataclass
from typing import Iterator

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.middleware import Middleware, Topic
from fieldkit.agent.messaging.newest import NewestSample, logged_reads
from fieldkit.agent.messaging.records import Log, LogError
from fieldkit.agent.video.image_message import ImageCodec

HEAD = struct.Struct("<8sqq")
"""Magic number, sequence number, time in nanoseconds since 1970 UTC."""
MAGIC = b"fieldkit"

MIN_BYTES = HEAD.size

# An empty sequence of dimensions, the offset, and the length of the data; in CDR after the encapsulation header.
_ROS1 = struct.Struct("<III")
_CDR = struct.Struct("<4sIII")
_CDR_HEADER = b"\0\1\0\0"

_POLL_S = 0.001
WAIT_S = 0.2
"""Maximum time of one wait, because a signal that the kernel delivers to another thread does not interrupt a wait."""
SETTLING_S = 0.5
"""Delay between the match of a subscription and the first sample: the subscription must match the publisher, too."""
_DRAIN_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class Stream:
    """Parameters of a stream of samples.

    Attributes:
        over: Name of the middleware.
        size_bytes: Length of the data of a sample, at least `MIN_BYTES`.
        rate_hz: Samples per second.
        duration_s: Duration.
        patience_s: Time for which the publisher waits for a subscription.
        reads_hz: Rate at which the subscriber's program reads the newest sample; 0 if it only logs arrivals.
        width: Pixels per row, if the samples are images; `size_bytes` is width times height.
        height: Rows of pixels; 0 if the samples are not images.
    """

    over: str
    size_bytes: int
    rate_hz: float
    duration_s: float
    patience_s: float
    reads_hz: float = 0.0
    width: int = 0
    height: int = 0


class SampleCodec:
    """Encodes and decodes samples.

    Args:
        stream: Parameters of the stream.
    """

    def __init__(self, stream: Stream) -> None:
        size = stream.size_bytes
        self._envelope = _ROS1.pack(0, 0, size) if stream.over == "ros1" else _CDR.pack(_CDR_HEADER, 0, 0, size)
        self._random_bytes = random.Random(size).getrandbits(8 * (size - HEAD.size) or 1).to_bytes(size, "little")  # noqa: S311
        self._random_bytes = self._random_bytes[: size - HEAD.size]
        self._size = len(self._envelope) + size
        self._image = ImageCodec(stream.width, stream.height, ros1=stream.over == "ros1") if stream.height else None

    def encode(self, sequence: int, at_ns: int) -> bytes:
        """Return a serialized sample."""
        head = HEAD.pack(MAGIC, sequence, at_ns)
        return (
            self._image.encode(sequence, at_ns, head) if self._image else self._envelope + head + self._random_bytes
        )

    def decode(self, data: bytes) -> tuple[int, int] | None:
        """Return the sequence number and the time of a sample, or None if it does not belong to this stream."""
        if self._image:
            return self._image.decode(data)
        start = len(self._envelope)
        # Some implementations pad CDR to a multiple of 4 bytes and do not indicate this in the header.
        if not 0 <= len(data) - self._size < 4 or data[start : start + len(MAGIC)] != MAGIC:
            return None
        _, sequence, sent_ns = HEAD.unpack_from(data, start)
        return sequence, sent_ns


def publish(middleware: Middleware, topic: Topic, stream: Stream, log: Log, stop_event: threading.Event) -> None:
    """Wait for a subscription, publish samples at their scheduled times, and log each of them.

    Without a subscription in `stream.patience_s`, publish nothing.

    Args:
        middleware: The started middleware.
        topic: The topic.
        stream: Parameters of the stream.
        log: The log.
        stop_event: Set to stop early.

    Raises:
        LogError: For the same reasons as `Log.note`.
    """
    codec = SampleCodec(stream)
    publisher = middleware.publisher(topic)
    deadline_s = time.monotonic() + stream.patience_s
    while not publisher.matched():
        if time.monotonic() > deadline_s or stop_event.wait(_POLL_S):
            return
    log.note(records.MATCHED, time.time_ns())
    stop_event.wait(SETTLING_S)
    for sequence in scheduled(stream.rate_hz, stream.duration_s, log, stop_event):
        sent_ns = time.time_ns()
        data = codec.encode(sequence, sent_ns)
        kind = records.SAMPLE if publisher.write(data) else records.REFUSED
        log.note(kind, time.time_ns(), size=len(data), sequence=sequence, sent_ns=sent_ns)
    if stop_event.is_set():
        return
    publisher.drain(_DRAIN_TIMEOUT_S)
    stop_event.wait(SETTLING_S)


def scheduled(rate_hz: float, duration_s: float, log: Log, stop_event: threading.Event) -> Iterator[int]:
    """Yield the number of each sample when it is due, until `stop_event` is set; log how many are skipped.

    If the caller requests the next value too late, the samples whose times have passed are skipped, as a ROS timer
    skips missed periods.

    Raises:
        LogError: For the same reasons as `Log.note`.
    """
    start_s, sequence, tick, ticks = time.monotonic(), 0, 0, round(duration_s * rate_hz)
    while tick < ticks:
        wait_s = start_s + tick / rate_hz - time.monotonic()
        if wait_s > 0:
            stop_event.wait(wait_s)
        if stop_event.is_set():
            return
        yield sequence
        sequence += 1
        due_tick = min(int((time.monotonic() - start_s) * rate_hz), ticks)
        if due_tick > tick + 1:
            log.note(records.SKIPPED, time.time_ns(), sequence=due_tick - tick - 1)
        tick = max(tick + 1, due_tick)


def subscribe(middleware: Middleware, topic: Topic, stream: Stream, log: Log, stop_event: threading.Event) -> None:
    """Log each received sample, and each read of the newest sample, until `stop_event` is set.

    See `publish` for the arguments.

    Raises:
        LogError: For the same reasons as `Log.note`; `stop_event` is set then.
    """
    codec, newest = SampleCodec(stream), NewestSample()
    errors: list[LogError] = []

    def on_sample(data: bytes, at_ns: int) -> None:
        header = codec.decode(data)
        if header is not None:
            newest.offer(*header)
        try:
            if header is None:
                log.note(records.FOREIGN, at_ns, size=len(data))
            else:
                log.note(records.SAMPLE, at_ns, size=len(data), sequence=header[0], sent_ns=header[1])
        except LogError as error:
            # An exception in a thread of the middleware would be lost, and the stream would seem to have ended.
            errors.append(error)
            stop_event.set()

    count_publishers = middleware.subscribe(topic, on_sample)
    is_matched = False
    with logged_reads(newest, stream.reads_hz, log, stop_event):
        while not stop_event.wait(_POLL_S if not is_matched else WAIT_S):
            if not is_matched and count_publishers() != 0:
                is_matched = True
                log.note(records.MATCHED, time.time_ns())
    if errors:
        raise errors[0]
