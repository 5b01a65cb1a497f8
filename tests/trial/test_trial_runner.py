"""What a trial tells and leaves behind while it runs, without robots: everything but them is the real thing."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.errors import LockLostError
from fieldkit.core.events import Event, Note, RepeatEnded
from fieldkit.core.model import Role, Status
from fieldkit.trial import journal, manifest, store
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.robots import Robots, unfetched_file
from fieldkit.trial.runner import resume_trial, run_trial
from fieldkit.trial.stop import Stop
from tests.helpers.idle_testbed import IdleTestbed
from tests.trial.test_trial_crash import PING, plan, robots_with_evidence

STEP_S = 100.0


@pytest.fixture(autouse=True)
def _no_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    robots_with_evidence(monkeypatch)


@pytest.fixture
def events() -> list[Event]:
    return []


def of_two() -> Plan:
    return plan().model_copy(update={"repeats": 2})


def ended(events: list[Event]) -> list[RepeatEnded]:
    return [event for event in events if isinstance(event, RepeatEnded)]


def only(folder: Path) -> Path:
    (found,) = folder.glob("*/trial.yaml")
    return found.parent


def test_a_void_attempt_says_nothing_of_how_long_the_others_take(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    def clock() -> Iterator[float]:
        now_s = 0.0
        while True:
            yield (now_s := now_s + STEP_S)

    ticks = clock()
    monkeypatch.setattr("fieldkit.trial.runner.time.monotonic", lambda: next(ticks))
    run_trial(of_two(), IdleTestbed(), tmp_path, events.append)
    void, first, second = ended(events)
    assert (void.status, void.left_s) == (Status.VOID, of_two().expected_s())
    assert (first.status, first.left_s) == (Status.VALID, STEP_S)
    assert second.left_s == 0


def test_the_repeat_that_ctrl_c_lets_end_is_told(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, fetch = Stop(), Robots.fetch

    def asked(self: Robots, remote: str, into: Path, *, clean: bool) -> list[str]:
        stop.asked = not remote.endswith("tcp-01-1")
        return fetch(self, remote, into, clean=clean)

    monkeypatch.setattr(Robots, "fetch", asked)
    with pytest.raises(KeyboardInterrupt):
        run_trial(of_two(), IdleTestbed(), tmp_path, events.append, stop)
    assert [one.status for one in ended(events)] == [Status.VOID, Status.VALID]


def test_after_another_s_abort_no_folder_of_a_fetched_repeat_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    removed: list[str | None] = []

    def begin(_self: Robots, remote: str, *, old: str | None) -> None:
        if old is not None:
            raise LockLostError("the trial was aborted by anna@one at 12:00:00 UTC", where="turtlebot-1")

    monkeypatch.setattr(Robots, "begin", begin)
    monkeypatch.setattr(Robots, "discard", lambda _, remote=None: removed.append(remote))
    with pytest.raises(LockLostError):
        run_trial(of_two(), IdleTestbed(), tmp_path, lambda _: None)
    assert removed == [f".fieldkit/{of_two().trial}/tcp-01-1"]


def test_evidence_that_was_gone_when_fieldkit_came_back_is_said_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = store.create(tmp_path, of_two())
    (repeat, _) = of_two().order()
    journal.append(
        folder,
        JournalEntry(1, repeat.protocol, 1, 0, Status.PLANNED),
        JournalEntry(2, repeat.protocol, 1, 1, Status.RUNNING),
        JournalEntry(3, repeat.protocol, 1, 1, Status.MEASURED),
    )
    fetch, gone = Robots.fetch, "turtlebot-1: it has no folder .fieldkit/x/tcp-01-1 any more"

    def gone_once(self: Robots, remote: str, into: Path, *, clean: bool) -> list[str]:
        return [gone] if remote.endswith("tcp-01-1") else fetch(self, remote, into, clean=clean)

    monkeypatch.setattr(Robots, "fetch", gone_once)
    resume_trial(folder, IdleTestbed(), lambda _: None)
    first = journal.ended(journal.read(folder))[0]
    assert (first.status, first.excused) == (Status.VOID, True)
    assert first.reason == f"fieldkit was killed before it had the evidence, which was not to be had later; {gone}"


def test_evidence_that_stays_on_a_robot_is_told_also_by_who_goes_on(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    fetch = Robots.fetch

    def leave_first(self: Robots, remote: str, into: Path, *, clean: bool) -> list[str]:
        if remote.endswith("tcp-01-1"):
            self._leave(Role.SENDER, remote, into, "the link broke \udcff")
            return ["the link broke"]
        raise LockLostError("aborted")

    monkeypatch.setattr(Robots, "fetch", leave_first)
    with pytest.raises(LockLostError):
        run_trial(of_two(), IdleTestbed(), tmp_path, events.append)
    folder = only(tmp_path)
    told = Note(
        f"turtlebot-1: evidence that was not fetched stays on it; delete it when nobody needs it: "
        f"~/.fieldkit/{folder.name}/tcp-01-1"
    )
    assert told in events
    kept = folder / "repeats/tcp-01.void1" / unfetched_file(Role.SENDER)
    assert "the link broke ?\nturtlebot-1 has it in ~/.fieldkit/" in kept.read_text(encoding="utf-8")
    events.clear()
    monkeypatch.setattr(Robots, "fetch", fetch)
    resume_trial(folder, IdleTestbed(), events.append)
    assert told in events
    assert manifest.verify(folder) == []


def test_who_goes_on_is_told_of_evidence_that_changed(tmp_path: Path, events: list[Event]) -> None:
    run_trial(of_two(), IdleTestbed(), tmp_path, events.append)
    folder = only(tmp_path)
    (folder / "repeats/tcp-02/ping.txt").write_text(PING.replace("time=2", "time=9"), encoding="utf-8")
    resume_trial(folder, IdleTestbed(), events.append)
    assert Note("not as it was when it was kept, and left so: repeats/tcp-02/ping.txt: changed") in events
    assert manifest.verify(folder) == ["repeats/tcp-02/ping.txt: changed"]
