"""Streams of samples over a fake middleware: the encoding of samples, and the times at which they are sent."""

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


def stream_of(middleware_name: str = "dds", size: int = 100, *, patience_s: float = 5.0) -> Stream:
    return Stream(middleware_name, size, rate_hz=200.0, duration_s=0.1, patience_s=patience_s)


@pytest.mark.parametrize("size", [24, 25, 100, 4097])
def test_sample_is_a_ros_message(size: int) -> None:
    """Equal to the serialization of rosbags for ROS 1 and ROS 2."""
    for middleware_name, store in (("dds", standard_types().ros2), ("ros1", standard_types().ros1)):
        sample = SampleCodec(stream_of(middleware_name, size)).encode(7, 123_456_789)
        message = (
            store.deserialize_cdr(sample, TYPE) if middleware_name == "dds" else store.deserialize_ros1(sample, TYPE)
        )
        serialized_again = (
            store.serialize_cdr(message, TYPE) if middleware_name == "dds" else store.serialize_ros1(message, TYPE)
        )
        assert bytes(serialized_again) == sample
        data = np.asarray(message.data).tobytes()  # type: ignore[attr-defined]
        assert len(data) == size
        assert struct.unpack_from("<qq", data, 8) == (7, 123_456_789)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.sampled_from(["dds", "zenoh", "ros1"]))
def test_sample_can_be_decoded(sequence: int, at_ns: int, middleware_name: str) -> None:
    codec = SampleCodec(stream_of(middleware_name))
    assert codec.decode(codec.encode(sequence, at_ns)) == (sequence, at_ns)


@given(st.binary(max_size=200))
def test_invalid_sample_is_detected(data: bytes) -> None:
    assert SampleCodec(stream_of()).decode(data) is None


class FakeMiddleware:
    """A middleware whose publisher stores samples, and whose subscription matches after some polls."""

    version = "fake"

    def __init__(self, polls: int = 1, *, accepts: Callable[[], bool] = lambda: True) -> None:
        self.written: list[bytes] = []
        self.drained = False
        self._polls_left = polls
        self._accepts = accepts

    def publisher(self, topic: Topic) -> "FakeMiddleware":
        return self

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        deliver(b"something else", 5)
        deliver(SampleCodec(stream_of()).encode(3, 17), 20)
        return lambda: 1

    def write(self, data: bytes) -> bool:
        self.written.append(data)
        return self._accepts()

    def matched(self) -> int:
        self._polls_left -= 1
        return int(self._polls_left <= 0)

    def drain(self, limit_s: float) -> None:
        self.drained = True

    def other_types(self, _: Topic) -> set[str]:
        return set()

    def close(self) -> None:
        """Do nothing."""


def read_log_rows(path: Path) -> list[tuple[int, int, int, int]]:
    """Return kind, size, sequence number and send time of each record. The last row is without its checksum."""
    *rows, last_row = topic_logs.rows(path)
    assert (last_row[0], last_row[4]) == (records.END, records.CHECKED)
    return [
        *((kind, size, sequence, sent_ns) for kind, _, size, sequence, sent_ns, _ in rows),
        (last_row[0], 0, last_row[3], 0),
    ]


def publish_and_read_log(
    tmp_path: Path, middleware: FakeMiddleware, task: Stream | None = None
) -> list[tuple[int, int, int, int]]:
    log = Log(str(tmp_path / "log"))
    stream.publish(middleware, TOPIC, task or stream_of(), log, threading.Event())
    log.end(1)
    return read_log_rows(tmp_path / "log")


def test_number_of_samples_is_rate_times_duration(tmp_path: Path) -> None:
    middleware = FakeMiddleware()
    rows = publish_and_read_log(tmp_path, middleware)
    n_skipped = sum(row[2] for row in rows if row[0] == records.SKIPPED)
    codec = [row for row in rows if row[0] == records.SAMPLE]
    assert len(codec) + n_skipped == 20
    assert [row[2] for row in codec] == list(range(len(codec)))
    assert [SampleCodec(stream_of()).decode(data) for data in middleware.written] == [row[2:] for row in codec]
    assert rows[0][0] == records.MATCHED
    assert rows[-1] == (records.END, 0, len(codec), 0)
    assert middleware.drained


def test_samples_after_the_end_are_not_skipped(tmp_path: Path) -> None:
    def block_briefly() -> bool:
        end_s = time.monotonic() + 0.03
        while time.monotonic() < end_s:
            continue
        return True

    rows = publish_and_read_log(
        tmp_path, FakeMiddleware(accepts=block_briefly), replace(stream_of(), duration_s=0.02)
    )
    assert [row[2] for row in rows if row[0] == records.SKIPPED] == [3]


def test_nothing_is_sent_without_a_subscription(tmp_path: Path) -> None:
    middleware = FakeMiddleware(polls=10**9)
    assert publish_and_read_log(tmp_path, middleware, stream_of(patience_s=0.01)) == [(records.END, 0, 0, 0)]
    assert middleware.written == []


def test_refused_samples_are_logged(tmp_path: Path) -> None:
    rows = publish_and_read_log(tmp_path, FakeMiddleware(accepts=lambda: False))
    assert {row[0] for row in rows} - {records.SKIPPED} == {records.MATCHED, records.REFUSED, records.END}


def test_samples_during_a_blocked_write_are_skipped(tmp_path: Path) -> None:
    """A write that blocks for 5 periods; the skipped samples are not sent later."""
    unset_event = threading.Event()
    rows = publish_and_read_log(tmp_path, FakeMiddleware(accepts=lambda: not unset_event.wait(0.025)))
    n_skipped = sum(row[2] for row in rows if row[0] == records.SKIPPED)
    n_sent = sum(row[0] == records.SAMPLE for row in rows)
    assert n_skipped >= 4 * (n_sent - 1)
    assert n_sent <= 5, "the stream has 20 periods, and each write takes 5"


def test_subscription_logs_arriving_samples(tmp_path: Path) -> None:
    log, finished = Log(str(tmp_path / "log")), threading.Event()
    finished.set()
    stream.subscribe(FakeMiddleware(), TOPIC, stream_of(), log, finished)
    log.end(1)
    size = len(SampleCodec(stream_of()).encode(0, 0))
    assert read_log_rows(tmp_path / "log") == [
        (records.FOREIGN, len(b"something else"), 0, 0),
        (records.SAMPLE, size, 3, 17),
        (records.END, 0, 1, 0),
    ]


def test_log_error_in_a_thread_of_the_middleware_stops_the_subscription(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The delivering thread continues, so an ignored error would appear as missing samples."""
    log, finished = Log(str(tmp_path / "log")), threading.Event()

    def raise_log_error(*_: int, **__: int) -> None:
        raise LogError("the log cannot be written")

    monkeypatch.setattr(log, "note", raise_log_error)
    with pytest.raises(LogError, match="cannot be written"):
        stream.subscribe(FakeMiddleware(), TOPIC, stream_of(), log, finished)
    assert finished.is_set()
