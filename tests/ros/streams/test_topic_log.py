"""Logs of topics that the agent writes, with all kinds of damage that are possible on a robot."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.records import Log
from fieldkit.core.errors import EvidenceError
from fieldkit.ros.streams import topic_samples


def write_log(path: Path) -> bytes:
    log = Log(str(path))
    log.note(records.DISCOVERY_STARTED, 10)
    log.note(records.MATCHED, 30)
    for sequence in range(3):
        log.note(records.SAMPLE, 105 + 10 * sequence, size=50, sequence=sequence, sent_ns=100 + 10 * sequence)
    log.note(records.REFUSED, 140, size=50, sequence=3, sent_ns=130)
    log.note(records.SKIPPED, 150, sequence=4)
    log.note(records.SKIPPED, 160, sequence=2)
    log.note(records.FOREIGN, 170, size=7)
    log.end(200)
    return path.read_bytes()


def test_logs_of_the_agent_are_read(tmp_path: Path) -> None:
    write_log(tmp_path / "log")
    parsed = topic_samples.read_log(tmp_path / "log")
    assert (parsed.discovery_start_ns, parsed.matched_ns) == (10, 30)
    assert (parsed.refused, parsed.skipped, parsed.foreign, parsed.is_complete) == (1, 6, 1, True)
    assert parsed.samples.sequence.tolist() == [0, 1, 2]
    assert parsed.samples.size_bytes.tolist() == [50, 50, 50]
    assert parsed.samples.sent_ns.tolist() == [100, 110, 120]
    assert parsed.samples.at_ns.tolist() == [105, 115, 125]


def test_a_truncated_log_has_its_earlier_records_and_is_incomplete(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log")
    for length in range(len(records.MAGIC), len(log)):
        (tmp_path / "cut").write_bytes(log[:length])
        parsed = topic_samples.read_log(tmp_path / "cut")
        assert not parsed.is_complete
        assert len(parsed.samples) == min(max((length - len(records.MAGIC)) // topic_samples.RECORD_BYTES - 2, 0), 3)


def test_a_log_with_a_wrong_count_is_rejected(tmp_path: Path) -> None:
    log, size = write_log(tmp_path / "log"), topic_samples.RECORD_BYTES
    start = len(records.MAGIC) + 2 * size
    for damaged_log in (log[:start] + log[start + size :], log + log[-size:]):
        (tmp_path / "log").write_bytes(damaged_log)
        with pytest.raises(EvidenceError, match="does not have the number of samples"):
            topic_samples.read_log(tmp_path / "log")


@given(zeros=st.integers(0, 5000), has_end=st.booleans())
def test_zeros_after_the_last_record_are_ignored(
    zeros: int, has_end: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A killed writer leaves zeros between two records, or between its last record and the end of the file."""
    log = tmp_path_factory.getbasetemp() / "zeros"
    content = write_log(log)
    log.write_bytes(content[: None if has_end else -topic_samples.RECORD_BYTES] + bytes(zeros))
    parsed = topic_samples.read_log(log)
    assert (parsed.discovery_start_ns, parsed.matched_ns) == (10, 30)
    assert (parsed.refused, parsed.skipped, parsed.foreign, parsed.is_complete) == (1, 6, 1, has_end)
    assert parsed.samples.sequence.tolist() == [0, 1, 2]


@pytest.mark.parametrize("content", [b"", b"fieldkit", b"\xd4\xc3\xb2\xa1" * 9])
def test_another_file_is_rejected(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(content)
    with pytest.raises(EvidenceError, match="not a log of a topic"):
        topic_samples.read_log(tmp_path / "log")


@given(content=st.binary(max_size=400))
def test_any_bytes_are_read_or_rejected(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("any") / "log"
    path.write_bytes(records.MAGIC + content)
    try:
        parsed = topic_samples.read_log(path)
    except EvidenceError:
        return
    assert len(parsed.samples) <= len(content) // topic_samples.RECORD_BYTES
