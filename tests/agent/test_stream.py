"""Streams of samples: the encoding of samples, and the times at which they are sent, over a fake middleware."""

import struct
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.messaging import records, stream
from fieldkit.agent.messaging.middleware import Deliver, Topic
from fieldkit.agent.messaging.records import Log, LogError
from fieldkit.agent.messaging.stream import SampleCodec, Stream
from fieldkit.ros.interfaces.types import standard_types
from tests.helpers import topic_logs

TYPE = "std_msgs/msg/UInt8MultiArray"
TOPIC = Topic("/stream", TYPE)


def streamed(middleware_name: str = "dds", size: int = 100, *, patience_s: float = 5.0) -> Stream:
    return Stream(middleware_name, size, rate_hz=200.0, duration_s=0.1, patience_s=patience_s)


@pytest.mark.parametrize("size", [24, 25, 100, 4097])
def test_sample_is_a_ros_message(size: int) -> None:
    """Equal to the serialization of rosbags for ROS 1 and ROS 2."""
    for middleware_name, store in (("dds", standard_types().ros2), ("ros1", standard_types().ros1)):
        sample = SampleCodec(streamed(middleware_name, size)).encode(7, 123_456_789)
        message = (
            store.deserialize_cdr(sample, TYPE) if middleware_name == "dds" else store.deserialize_ros1(sample, TYPE)
        )
        again = (
            store.serialize_cdr(message, TYPE) if middleware_name == "dds" else store.serialize_ros1(message, TYPE)
        )
        assert bytes(again) == sample
        data = np.asarray(message.data).tobytes()  # type: ignore[attr-defined]
        assert len(data) == size
        assert struct.unpack_from("<qq", data, 8) == (7, 123_456_789)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.sampled_from(["dds", "zenoh", "ros1"]))
def test_sample_can_be_decoded(sequence: int, at_ns: int, middleware_name: str) -> None:
    samples = SampleCodec(streamed(middleware_name))
    assert samples.decode(samples.encode(sequence, at_ns)) == (sequence, at_ns)


@given(st.binary(max_size=200))
def test_invalid_sample_is_detected(data: bytes) -> None:
    assert SampleCodec(streamed()).decode(data) is None


class FakeMiddleware:
    """A middleware whose publisher stores samples, and whose subscription matches after some polls."""

    version = "remembering"

    def __init__(self, polls: int = 1, *, accepts: Callable[[], bool] = lambda: True) -> None:
        self.written: list[bytes] = []
        self.drained = False
        self._polls_left = polls
        self._takes = accepts

    def publisher(self, topic: Topic) -> "FakeMiddleware":
        return self

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        deliver(b"something else", 5)
        deliver(SampleCodec(streamed()).encode(3, 17), 20)
        return lambda: 1

    def write(self, data: bytes) -> bool:
        self.written.append(data)
        return self._takes()

    def matched(self) -> int:
        self._polls_left -= 1
        return int(self._polls_left <= 0)

    def drain(self, limit_s: float) -> None:
        self.drained = True

    def other_types(self, _: Topic) -> set[str]:
        return set()

    def close(self) -> None:
        """Do nothing."""


def logged(path: Path) -> list[tuple[int, int, int, int]]:
    """Return kind, size, sequence number and send time of each record; without the checksum of the last one."""
    *rows, end = topic_logs.rows(path)
    assert (end[0], end[4]) == (records.END, records.CHECKED)
    return [
        *((kind, size, sequence, sent_ns) for kind, _, size, sequence, sent_ns, _ in rows),
        (end[0], 0, end[3], 0),
    ]


def published(
    tmp_path: Path, middleware: FakeMiddleware, task: Stream | None = None
) -> list[tuple[int, int, int, int]]:
    log = Log(str(tmp_path / "log"))
    stream.publish(middleware, TOPIC, task or streamed(), log, threading.Event())
    log.end(1)
    return logged(tmp_path / "log")


def test_number_of_samples_is_rate_times_duration(tmp_path: Path) -> None:
    middleware = FakeMiddleware()
    rows = published(tmp_path, middleware)
    skipped = sum(row[2] for row in rows if row[0] == records.SKIPPED)
    samples = [row for row in rows if row[0] == records.SAMPLE]
    assert len(samples) + skipped == 20
    assert [row[2] for row in samples] == list(range(len(samples)))
    assert [SampleCodec(streamed()).decode(data) for data in middleware.written] == [row[2:] for row in samples]
    assert rows[0][0] == records.MATCHED
    assert rows[-1] == (records.END, 0, len(samples), 0)
    assert middleware.drained


def test_samples_after_the_end_are_not_skipped(tmp_path: Path) -> None:
    def slowly() -> bool:
        end_s = time.monotonic() + 0.03
        while time.monotonic() < end_s:
            continue
        return True

    rows = published(tmp_path, FakeMiddleware(accepts=slowly), replace(streamed(), duration_s=0.02))
    assert [row[2] for row in rows if row[0] == records.SKIPPED] == [3]


def test_nothing_is_sent_without_a_subscription(tmp_path: Path) -> None:
    middleware = FakeMiddleware(polls=10**9)
    assert published(tmp_path, middleware, streamed(patience_s=0.01)) == [(records.END, 0, 0, 0)]
    assert middleware.written == []


def test_refused_samples_are_logged(tmp_path: Path) -> None:
    rows = published(tmp_path, FakeMiddleware(accepts=lambda: False))
    assert {row[0] for row in rows} - {records.SKIPPED} == {records.MATCHED, records.REFUSED, records.END}


def test_samples_during_a_blocked_write_are_skipped(tmp_path: Path) -> None:
    """A write that blocks for 5 periods; the skipped samples are not sent later."""
    never = threading.Event()
    rows = published(tmp_path, FakeMiddleware(accepts=lambda: not never.wait(0.025)))
    skipped = sum(row[2] for row in rows if row[0] == records.SKIPPED)
    sent = sum(row[0] == records.SAMPLE for row in rows)
    assert skipped >= 4 * (sent - 1)
    assert sent <= 5, "20 periods, of which each write takes 5"


def test_subscription_logs_arriving_samples(tmp_path: Path) -> None:
    log, finished = Log(str(tmp_path / "log")), threading.Event()
    finished.set()
    stream.subscribe(FakeMiddleware(), TOPIC, streamed(), log, finished)
    log.end(1)
    size = len(SampleCodec(streamed()).encode(0, 0))
    assert logged(tmp_path / "log") == [
        (records.FOREIGN, len(b"something else"), 0, 0),
        (records.SAMPLE, size, 3, 17),
        (records.END, 0, 1, 0),
    ]


def test_log_error_in_a_thread_of_the_middleware_stops_the_subscription(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The delivering thread continues, so an ignored error would look like missing samples."""
    log, finished = Log(str(tmp_path / "log")), threading.Event()

    def fails(*_: int, **__: int) -> None:
        raise LogError("the log cannot be written")

    monkeypatch.setattr(log, "note", fails)
    with pytest.raises(LogError, match="cannot be written"):
        stream.subscribe(FakeMiddleware(), TOPIC, streamed(), log, finished)
    assert finished.is_set()
