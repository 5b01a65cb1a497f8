"""`resume --failed` runs failed repeats again and keeps their evidence; the tables are always consistent."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.errors import EvidenceError
from fieldkit.core.events import Event, Note
from fieldkit.core.model import Protocol, RepeatId, Status
from fieldkit.trial import journal, store
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.running.resumption import resume_trial
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.runner import Outcome, run_trial
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.plans import write_states
from tests.helpers.runs import rows
from tests.trial.test_trial_crash import (
    KILLED,
    PING,
    STRIDES,
    assert_consistent,
    call_at_write,
    exit_after_kill,
    plan,
    robots_with_evidence,
)

PLAN = plan().model_copy(update={"repeats": 2})
FIRST_REPEAT = RepeatId(Protocol.TCP, 1)


@pytest.fixture
def incomplete_repeats(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of repeats that get incomplete evidence; a test may change the set."""
    robots_with_evidence(monkeypatch)
    names: set[str] = set()

    def fetch(_self: Robots, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        text = "" if remote.rpartition("/")[2].rpartition("-")[0] in names else PING
        (into / "ping.txt").write_text(text, encoding="utf-8")
        write_states(into)
        return []

    monkeypatch.setattr(Robots, "fetch", fetch)
    return names


def run_with_failed_repeat(out: Path, incomplete_repeats: set[str]) -> Path:
    incomplete_repeats.add(str(FIRST_REPEAT))
    outcome = run_trial(PLAN, IdleTestbed(), out, lambda _: None)
    assert outcome is not None
    assert (outcome.valid, outcome.failed) == (1, 1)
    return outcome.folder


def resume_failed(folder: Path, received_events: list[Event] | None = None) -> Outcome:
    events: list[Event] = [] if received_events is None else received_events
    outcome = resume_trial(folder, IdleTestbed(), events.append, failed=True)
    assert outcome is not None
    return outcome


def test_a_failed_repeat_is_repeated_and_its_attempts_become_void(
    tmp_path: Path, incomplete_repeats: set[str]
) -> None:
    folder = run_with_failed_repeat(tmp_path, incomplete_repeats)
    incomplete_repeats.clear()
    outcome_without_option = resume_trial(folder, IdleTestbed(), lambda _: None)
    assert outcome_without_option is not None
    assert outcome_without_option.failed == 1, "failed repeats are not repeated without the option"
    outcome = resume_failed(folder)
    assert (outcome.valid, outcome.failed) == (2, 0)
    table = rows(folder)
    assert [row["status"] for row in table if row["repeat"] == "1"] == ["void", "void", "void", "valid"]
    assert [row["attempt"] for row in table if row["repeat"] == "1"] == ["1", "2", "3", "4"]
    assert all(row["reason"] for row in table if row["status"] == "void")
    names = {path.name for path in (folder / store.REPEATS).iterdir()}
    assert names == {"tcp-01", "tcp-01.void1", "tcp-01.void2", "tcp-01.void3", "tcp-02"}
    assert_consistent(folder)


def test_a_repeat_that_is_run_again_has_new_attempts_and_may_fail_again(
    tmp_path: Path, incomplete_repeats: set[str]
) -> None:
    folder = run_with_failed_repeat(tmp_path, incomplete_repeats)
    assert resume_failed(folder).failed == 1
    assert [row["status"] for row in rows(folder) if row["repeat"] == "1"] == ["void"] * 5 + ["failed"]
    assert_consistent(folder)
    incomplete_repeats.clear()
    assert resume_failed(folder).failed == 0
    assert_consistent(folder)
    received_events: list[Event] = []
    assert resume_failed(folder, received_events).valid == 2
    assert Note("no repeat of this trial failed") in received_events


def folders_after_kills(folder: Path, stride: int) -> Iterator[Path]:
    """Resume the trial and kill fieldkit at every `stride`-th write; yield the folder after each kill."""
    moment, copy = 1 - stride, folder.with_name("kept")
    shutil.copytree(folder, copy)
    while True:
        moment += stride
        pid = os.fork()
        if pid == 0:
            call_at_write(moment, exit_after_kill)
            resume_failed(folder)
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        yield folder
        shutil.rmtree(folder)
        shutil.copytree(copy, folder)
        if code == 0:
            return
        assert code == KILLED


@pytest.mark.parametrize("stride", STRIDES)
def test_a_kill_at_any_write_is_recovered(stride: int, tmp_path: Path, incomplete_repeats: set[str]) -> None:
    folder = run_with_failed_repeat(tmp_path, incomplete_repeats)
    incomplete_repeats.clear()
    count = 0
    for killed_trial in folders_after_kills(folder, stride):
        count += stride
        resume_failed(killed_trial)
        assert Status.FAILED not in {attempt.status for attempt in journal.ended_attempts(journal.read(killed_trial))}
        assert [row["repeat"] for row in rows(killed_trial) if row["status"] == "valid"].count("1") == 1
        assert_consistent(killed_trial)
    assert count > 10, "too few writes were interrupted"


def test_a_valid_repeat_is_not_planned_again(tmp_path: Path, incomplete_repeats: set[str]) -> None:
    folder = run_with_failed_repeat(tmp_path, incomplete_repeats)
    journal.append(folder, JournalEntry(1, Protocol.TCP, 2, 0, Status.PLANNED))
    with pytest.raises(EvidenceError, match="tcp-02 is planned again, although it was valid"):
        resume_failed(folder)


def test_altered_evidence_of_a_failed_attempt_is_not_measured_again(
    tmp_path: Path, incomplete_repeats: set[str]
) -> None:
    folder = run_with_failed_repeat(tmp_path, incomplete_repeats)
    (folder / store.REPEATS / "tcp-01.failed3" / "ping.txt").write_text(PING, encoding="utf-8")
    with pytest.raises(EvidenceError, match="evidence has changed since it was measured"):
        resume_failed(folder)
