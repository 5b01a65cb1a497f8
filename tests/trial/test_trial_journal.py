import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.errors import EvidenceError
from fieldkit.model import Protocol, RepeatId, Status
from fieldkit.trial import journal
from fieldkit.trial.journal import Attempt, Entry

entries = st.builds(
    Entry,
    utc_ns=st.integers(min_value=0, max_value=2**63),
    protocol=st.sampled_from(Protocol),
    number=st.integers(min_value=1, max_value=99),
    attempt=st.integers(min_value=0, max_value=9),
    status=st.sampled_from(Status),
    reason=st.text(max_size=40),
)


@given(st.lists(entries, max_size=8), st.integers(min_value=0, max_value=200))
def test_a_journal_torn_anywhere_gives_every_whole_entry_before(
    tmp_path_factory: pytest.TempPathFactory, written: list[Entry], cut: int
) -> None:
    folder = tmp_path_factory.mktemp("trial")
    journal.append(folder, *written)
    path = folder / journal.JOURNAL_FILE
    whole = path.read_bytes()
    kept = whole[: max(0, len(whole) - cut)]
    path.write_bytes(kept)
    complete = kept.count(b"\n")
    read = journal.read(folder)
    # A last line that lost only its end of line is whole all the same.
    assert read in (written[:complete], written[: complete + 1])


def test_a_damaged_line_in_the_middle_is_an_error_with_its_number(tmp_path: Path) -> None:
    journal.append(tmp_path, *(Entry(1, Protocol.TCP, number, 1, Status.RUNNING) for number in (1, 2, 3)))
    path = tmp_path / journal.JOURNAL_FILE
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[1] = lines[1][:20]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(EvidenceError) as caught:
        journal.read(tmp_path)
    assert caught.value.where == f"{path}:2"


def test_no_journal_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="no journal"):
        journal.read(tmp_path)


def test_ended_pairs_start_and_end(tmp_path: Path) -> None:
    journal.append(
        tmp_path,
        Entry(1, Protocol.UDP, 1, 0, Status.PLANNED),
        Entry(10, Protocol.UDP, 1, 1, Status.RUNNING),
        Entry(20, Protocol.UDP, 1, 1, Status.VOID, "no bag"),
        Entry(30, Protocol.UDP, 1, 2, Status.RUNNING),
        Entry(40, Protocol.UDP, 1, 2, Status.VALID),
        Entry(50, Protocol.UDP, 2, 1, Status.RUNNING),
    )
    first, second = journal.ended(journal.read(tmp_path))
    repeat = RepeatId(Protocol.UDP, 1)
    assert first == Attempt(repeat, 1, 10, Status.VOID, "no bag")
    assert second == Attempt(repeat, 2, 30, Status.VALID, "")
    assert (first.folder, second.folder) == ("udp-01.void1", "udp-01")


def test_lines_are_json_objects(tmp_path: Path) -> None:
    journal.append(tmp_path, Entry(1, Protocol.TCP, 1, 0, Status.PLANNED))
    assert json.loads((tmp_path / journal.JOURNAL_FILE).read_text(encoding="utf-8")) == {
        "utc_ns": 1,
        "protocol": "tcp",
        "number": 1,
        "attempt": 0,
        "status": "planned",
        "reason": "",
    }
