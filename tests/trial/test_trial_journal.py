import json
import resource
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, RepeatId, Status
from fieldkit.trial import journal
from fieldkit.trial.journal import Attempt, JournalEntry

entries = st.builds(
    JournalEntry,
    utc_ns=st.integers(min_value=0, max_value=2**63 - 1),
    protocol=st.sampled_from(Protocol),
    number=st.integers(min_value=1, max_value=99),
    attempt=st.integers(min_value=0, max_value=9),
    status=st.sampled_from(Status),
    reason=st.text(max_size=40),
)


@given(st.lists(entries, max_size=8), st.integers(min_value=0, max_value=200))
def test_all_complete_entries_of_a_torn_journal_are_read(
    tmp_path_factory: pytest.TempPathFactory, written_entries: list[JournalEntry], lost_bytes: int
) -> None:
    folder = tmp_path_factory.mktemp("trial")
    journal.append(folder, *written_entries)
    path = folder / journal.JOURNAL_FILE
    content = path.read_bytes()
    truncated = content[: max(0, len(content) - lost_bytes)]
    path.write_bytes(truncated)
    complete_lines = truncated.count(b"\n")
    read_entries = journal.read(folder)
    # A last line that lost only its line end is still complete.
    assert read_entries in (written_entries[:complete_lines], written_entries[: complete_lines + 1])


def test_a_damaged_line_in_the_middle_is_an_error_with_its_number(tmp_path: Path) -> None:
    journal.append(tmp_path, *(JournalEntry(1, Protocol.TCP, number, 1, Status.RUNNING) for number in (1, 2, 3)))
    path = tmp_path / journal.JOURNAL_FILE
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[1] = lines[1][:20]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(EvidenceError) as caught:
        journal.read(tmp_path)
    assert caught.value.where == f"{path}:2"


def test_a_missing_journal_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="the journal cannot be read"):
        journal.read(tmp_path)


def test_ended_attempts_have_their_start_times(tmp_path: Path) -> None:
    journal.append(
        tmp_path,
        JournalEntry(1, Protocol.UDP, 1, 0, Status.PLANNED),
        JournalEntry(10, Protocol.UDP, 1, 1, Status.RUNNING),
        JournalEntry(20, Protocol.UDP, 1, 1, Status.VOID, "no bag"),
        JournalEntry(30, Protocol.UDP, 1, 2, Status.RUNNING),
        JournalEntry(40, Protocol.UDP, 1, 2, Status.VALID),
        JournalEntry(50, Protocol.UDP, 2, 1, Status.RUNNING),
    )
    first, second = journal.ended_attempts(journal.read(tmp_path))
    repeat = RepeatId(Protocol.UDP, 1)
    assert first == Attempt(repeat, 1, 10, Status.VOID, "no bag")
    assert second == Attempt(repeat, 2, 30, Status.VALID, "")
    assert (first.folder, second.folder) == ("udp-01.void1", "udp-01")


@given(st.lists(entries, max_size=6), st.integers(min_value=0, max_value=200), entries)
def test_entries_that_are_appended_after_a_repair_are_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    written_entries: list[JournalEntry],
    lost_bytes: int,
    next_entry: JournalEntry,
) -> None:
    folder = tmp_path_factory.mktemp("trial")
    journal.append(folder, *written_entries)
    path = folder / journal.JOURNAL_FILE
    content = path.read_bytes()
    path.write_bytes(content[: max(0, len(content) - lost_bytes)])
    before = journal.read(folder)
    journal.remove_torn_line(folder)
    journal.append(folder, next_entry)
    assert journal.read(folder) == [*before, next_entry]


def test_an_attempt_without_an_end_was_interrupted(tmp_path: Path) -> None:
    journal.append(
        tmp_path,
        JournalEntry(10, Protocol.UDP, 1, 1, Status.RUNNING),
        JournalEntry(15, Protocol.UDP, 1, 1, Status.MEASURED),
        JournalEntry(20, Protocol.UDP, 1, 1, Status.VALID),
        JournalEntry(30, Protocol.UDP, 2, 1, Status.RUNNING),
        JournalEntry(40, Protocol.UDP, 3, 1, Status.RUNNING),
        JournalEntry(45, Protocol.UDP, 3, 1, Status.MEASURED),
    )
    assert journal.interrupted_attempts(journal.read(tmp_path)) == [
        Attempt(RepeatId(Protocol.UDP, 2), 1, 30, Status.RUNNING),
        Attempt(RepeatId(Protocol.UDP, 3), 1, 40, Status.MEASURED),
    ]


def test_a_full_disk_does_not_change_the_journal(tmp_path: Path) -> None:
    journal.append(tmp_path, JournalEntry(1, Protocol.TCP, 1, 0, Status.PLANNED))
    before = (tmp_path / journal.JOURNAL_FILE).read_bytes()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 20, limit[1]))
    try:
        with pytest.raises(OSError, match="No space left"):
            journal.append(tmp_path, JournalEntry(2, Protocol.TCP, 1, 1, Status.RUNNING))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert (tmp_path / journal.JOURNAL_FILE).read_bytes() == before


def test_lines_are_json_objects(tmp_path: Path) -> None:
    journal.append(tmp_path, JournalEntry(1, Protocol.TCP, 1, 0, Status.PLANNED))
    assert json.loads((tmp_path / journal.JOURNAL_FILE).read_text(encoding="utf-8")) == {
        "utc_ns": 1,
        "protocol": "tcp",
        "number": 1,
        "attempt": 0,
        "status": "planned",
        "reason": "",
        "excused": False,
    }
