"""Reads of the newest sample at a fixed rate, and their records in the log."""

import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.newest import NewestSample, logged_reads
from fieldkit.agent.messaging.records import Log, LogError
from tests.helpers import topic_logs

LIMIT_S = 20.0


@given(st.lists(st.integers(0, 100)))
def test_newest_sample_has_the_highest_number(numbers: list[int]) -> None:
    sample = NewestSample()
    for count, number in enumerate(numbers):
        sample.offer(number, 1000 + number)
        highest = max(numbers[: count + 1])
        assert sample.read() == (highest, 1000 + highest)


class CountingLog(Log):
    """A log that sets an event after a number of reads, and optionally reports a full disk at this read."""

    def __init__(self, path: Path, *, reads: int, is_full: bool = False) -> None:
        super().__init__(str(path))
        self.reached = threading.Event()
        self._remaining_reads, self._is_full = reads, is_full

    def note(self, kind: int, at_ns: int, *, size: int = 0, sequence: int = 0, sent_ns: int = 0) -> None:
        super().note(kind, at_ns, size=size, sequence=sequence, sent_ns=sent_ns)
        self._remaining_reads -= 1
        if self._remaining_reads == 0:
            self.reached.set()
            if self._is_full:
                raise LogError("the disk is full")


def test_reads_are_logged_at_the_rate_until_the_body_ends(tmp_path: Path) -> None:
    log, sample = CountingLog(tmp_path / "log", reads=21), NewestSample()
    with logged_reads(sample, 200.0, log, threading.Event()):
        assert log.reached.wait(LIMIT_S)
        log.reached.clear()
        log._remaining_reads = 10
        sample.offer(4, 17)
        assert log.reached.wait(LIMIT_S)
    rows = topic_logs.rows(tmp_path / "log")
    assert {row[0] for row in rows} == {records.READ}
    logged_samples = [(row[3], row[4]) for row in rows]
    assert logged_samples[:21] == [(-1, 0)] * 21
    assert logged_samples[-1] == (4, 17)
    first_ns, last_ns = rows[0][-1], rows[-1][-1]
    # A read is never early, and a busy machine omits some reads.
    assert len(rows) <= (last_ns - first_ns) / 1e9 * 200 + 2


def test_no_sample_is_read_without_a_rate(tmp_path: Path) -> None:
    log = Log(str(tmp_path / "log"))
    threads = threading.active_count()
    with logged_reads(NewestSample(), 0.0, log, threading.Event()):
        assert threading.active_count() == threads
    assert topic_logs.rows(tmp_path / "log") == []


def test_full_disk_stops_the_program(tmp_path: Path) -> None:
    log, stop_event = CountingLog(tmp_path / "log", reads=3, is_full=True), threading.Event()
    with pytest.raises(LogError, match="full"), logged_reads(NewestSample(), 1000.0, log, stop_event):
        assert stop_event.wait(LIMIT_S)
