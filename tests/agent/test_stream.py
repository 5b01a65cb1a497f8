"""Streams of samples: what a sample is on the wire, and when it is sent, over a middleware that only remembers."""

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

from fieldkit.agent import records, stream
from fieldkit.agent.middleware import Deliver, Topic
from fieldkit.agent.records import Log, LogError
from fieldkit.agent.stream import SampleCodec, Stream
from fieldkit.ros.types import shipped
from tests.helpers import topic_logs

TYPE = "std_msgs/msg/UInt8MultiArray"
TOPIC = Topic("/stream", TYPE)


def streamed(over: str = "dds", size: int = 100, *, patience_s: float = 5.0) -> Stream:
    return Stream(over, size, rate_hz=200.0, duration_s=0.1, patience_s=patience_s)


@pytest.mark.parametrize("size", [24, 25, 100, 4097])
def test_a_sample_is_a_message_of_ros(size: int) -> None:
    """Byte for byte what rosbags writes of it, in both generations."""
    for over, store in (("dds", shipped().ros2), ("ros1", shipped().ros1)):
        sample = SampleCodec(streamed(over, size)).encode(7, 123_456_789)
        message = store.deserialize_cdr(sample, TYPE) if over == "dds" else store.deserialize_ros1(sample, TYPE)
        again = store.serialize_cdr(message, TYPE) if over == "dds" else store.serialize_ros1(message, TYPE)
        assert bytes(again) == sample
        data = np.asarray(message.data).tobytes()  # type: ignore[attr-defined]
        assert len(data) == size
        assert struct.unpack_from("<qq", data, 8) == (7, 123_456_789)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.sampled_from(["dds", "zenoh", "ros1"]))
def test_a_sample_is_read_back(sequence: int, at_ns: int, over: str) -> None:
    samples = SampleCodec(streamed(over))
    assert samples.decode(samples.encode(sequence, at_ns)) == (sequence, at_ns)


@given(st.binary(max_size=200))
def test_what_is_no_sample_is_told_so(data: bytes) -> None:
    assert SampleCodec(streamed()).decode(data) is None


class Remembering:
    """A middleware whose publisher remembers, and whose subscription is found after some looks."""

    version = "remembering"

    def __init__(self, looks: int = 1, *, takes: Callable[[], bool] = lambda: True) -> None:
        self.written: list[bytes] = []
        self.drained = False
        self._looks = looks
        self._takes = takes

    def publisher(self, topic: Topic) -> "Remembering":
        return self

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        deliver(b"something else", 5)
        deliver(SampleCodec(streamed()).encode(3, 17), 20)
        return lambda: 1

    def write(self, data: bytes) -> bool:
        self.written.append(data)
        return self._takes()

    def matched(self) -> int:
        self._looks -= 1
        return int(self._looks <= 0)

    def drain(self, limit_s: float) -> None:
        self.drained = True

    def other_types(self, _: Topic) -> set[str]:
        return set()

    def close(self) -> None:
        """Nothing is open."""


def logged(path: Path) -> list[tuple[int, int, int, int]]:
    """Return kind, size, sequence and time sent of each record; of the end, the checksum and its mark left out."""
    *rows, end = topic_logs.rows(path)
    assert (end[0], end[4]) == (records.END, records.CHECKED)
    return [
        *((kind, size, sequence, sent_ns) for kind, _, size, sequence, sent_ns, _ in rows),
        (end[0], 0, end[3], 0),
    ]


def published(tmp_path: Path, middleware: Remembering, what: Stream | None = None) -> list[tuple[int, int, int, int]]:
    log = Log(str(tmp_path / "log"))
    stream.publish(middleware, TOPIC, what or streamed(), log, threading.Event())
    log.end(1)
    return logged(tmp_path / "log")


def test_a_stream_has_as_many_samples_as_its_rate_and_duration(tmp_path: Path) -> None:
    middleware = Remembering()
    found = published(tmp_path, middleware)
    skipped = sum(one[2] for one in found if one[0] == records.SKIPPED)
    samples = [one for one in found if one[0] == records.SAMPLE]
    assert len(samples) + skipped == 20
    assert [one[2] for one in samples] == list(range(len(samples)))
    assert [SampleCodec(streamed()).decode(data) for data in middleware.written] == [one[2:] for one in samples]
    assert found[0][0] == records.MATCHED
    assert found[-1] == (records.END, 0, len(samples), 0)
    assert middleware.drained


def test_no_sample_is_skipped_whose_time_is_after_the_end(tmp_path: Path) -> None:
    def slowly() -> bool:
        end_s = time.monotonic() + 0.03
        while time.monotonic() < end_s:
            continue
        return True

    found = published(tmp_path, Remembering(takes=slowly), replace(streamed(), duration_s=0.02))
    assert [one[2] for one in found if one[0] == records.SKIPPED] == [3]


def test_nothing_is_sent_where_nobody_is_found(tmp_path: Path) -> None:
    middleware = Remembering(looks=10**9)
    assert published(tmp_path, middleware, streamed(patience_s=0.01)) == [(records.END, 0, 0, 0)]
    assert middleware.written == []


def test_what_the_middleware_refuses_is_told(tmp_path: Path) -> None:
    found = published(tmp_path, Remembering(takes=lambda: False))
    assert {one[0] for one in found} - {records.SKIPPED} == {records.MATCHED, records.REFUSED, records.END}


def test_samples_whose_time_passes_while_one_is_written_are_skipped(tmp_path: Path) -> None:
    """A write that blocks as long as 5 periods; nothing is caught up."""
    never = threading.Event()
    found = published(tmp_path, Remembering(takes=lambda: not never.wait(0.025)))
    skipped = sum(one[2] for one in found if one[0] == records.SKIPPED)
    sent = sum(one[0] == records.SAMPLE for one in found)
    assert skipped >= 4 * (sent - 1)
    assert sent <= 5, "20 periods, of which each write takes 5"


def test_a_subscription_logs_what_arrives(tmp_path: Path) -> None:
    log, over = Log(str(tmp_path / "log")), threading.Event()
    over.set()
    stream.subscribe(Remembering(), TOPIC, streamed(), log, over)
    log.end(1)
    size = len(SampleCodec(streamed()).encode(0, 0))
    assert logged(tmp_path / "log") == [
        (records.FOREIGN, len(b"something else"), 0, 0),
        (records.SAMPLE, size, 3, 17),
        (records.END, 0, 1, 0),
    ]


def test_a_log_that_fails_in_a_thread_of_the_middlewares_ends_the_subscription(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that delivers goes on, and nothing looks as if nothing came any more."""
    log, over = Log(str(tmp_path / "log")), threading.Event()

    def fails(*_: int, **__: int) -> None:
        raise LogError("the log cannot be written")

    monkeypatch.setattr(log, "note", fails)
    with pytest.raises(LogError, match="cannot be written"):
        stream.subscribe(Remembering(), TOPIC, streamed(), log, over)
    assert over.is_set()
