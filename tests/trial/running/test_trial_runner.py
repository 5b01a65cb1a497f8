"""Events and files of a running trial; only the measurement on robots is replaced."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, LockLostError, RobotError
from fieldkit.core.events import Event, ExpectationJudged, Note, RepeatEnded, TrialEnded
from fieldkit.core.model import Protocol, RepeatId, Role, Status
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state.exchanges import Exchanges
from fieldkit.trial import gates, journal, store
from fieldkit.trial.gates import EvidenceVerdict
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.running.resumption import resumable, resume_trial
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.runner import run_trial
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.running.unfetched import unfetched_file
from fieldkit.trial.stored import verification
from fieldkit.trial.stored.rebuild import rebuild
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.nightly import mark_nightly
from tests.helpers.plans import write_states
from tests.trial.test_trial_crash import PING, plan, robots_with_evidence

STEP_S = 100.0


@pytest.fixture(autouse=True)
def _replace_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    robots_with_evidence(monkeypatch)


@pytest.fixture
def events() -> list[Event]:
    return []


def plan_of_two_repeats() -> Plan:
    return plan().model_copy(update={"repeats": 2})


def repeat_ends(events: list[Event]) -> list[RepeatEnded]:
    return [event for event in events if isinstance(event, RepeatEnded)]


def trial_in(folder: Path) -> Path:
    (plan_file,) = folder.glob("*/trial.yaml")
    return plan_file.parent


def test_the_remaining_time_is_estimated_from_finished_repeats(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    def clock() -> Iterator[float]:
        now_s = 0.0
        while True:
            yield (now_s := now_s + STEP_S)

    ticks = clock()
    monkeypatch.setattr("fieldkit.trial.running.runner.time.monotonic", lambda: next(ticks))
    run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, events.append)
    void_attempt, first, second = repeat_ends(events)
    assert (void_attempt.status, void_attempt.left_s) == (
        Status.VOID,
        2 * plan_of_two_repeats().procedure.expected_s(Protocol.TCP),
    )
    assert first.status is Status.VALID
    assert first.left_s == first.left_most_s >= STEP_S, (
        "the duration of the finished repeat includes its void attempts"
    )
    assert second.left_s == 0


def test_the_repeat_that_ctrl_c_lets_finish_is_reported(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, fetch = Stop(), Robots.fetch

    def fetch_and_stop(self: Robots, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        stop.after_repeat = not remote.endswith("tcp-01-1")
        return fetch(self, remote, into, ended_normally=ended_normally)

    monkeypatch.setattr(Robots, "fetch", fetch_and_stop)
    with pytest.raises(KeyboardInterrupt):
        run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, events.append, stop)
    assert [event.status for event in repeat_ends(events)] == [Status.VOID, Status.VALID]


def test_after_an_abort_by_another_user_fetched_folders_are_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    removed_folders: list[str | None] = []

    def begin(_self: Robots, remote: str, *, old: str | None) -> Exchanges:
        if old is not None:
            raise LockLostError("the trial was aborted by anna@one at 12:00:00 UTC", where="turtlebot-1")
        return {}

    monkeypatch.setattr(Robots, "begin", begin)
    monkeypatch.setattr(Robots, "delete_remote", lambda _, remote=None: removed_folders.append(remote))
    with pytest.raises(LockLostError):
        run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, lambda _: None)
    assert removed_folders == [f".fieldkit/{plan_of_two_repeats().trial}/tcp-01-1"]


def test_an_aborted_attempt_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    removed_folders: list[str | None] = []

    def measure(*_: object) -> None:
        raise RobotError("ping ended with exit code 130", where="turtlebot-1")

    def raise_lock_lost(_self: Robots) -> None:
        raise LockLostError("the trial was aborted by anna@one at 12:00:00 UTC", where="turtlebot-1")

    monkeypatch.setattr(Robots, "measure", measure)
    monkeypatch.setattr(Robots, "require_locks", raise_lock_lost)
    monkeypatch.setattr(Robots, "delete_remote", lambda _, remote=None: removed_folders.append(remote))
    with pytest.raises(LockLostError):
        run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, lambda _: None)
    (interrupted_attempt,) = journal.ended_attempts(journal.read(trial_in(tmp_path)))
    assert (interrupted_attempt.status, interrupted_attempt.excused) == (Status.VOID, True)
    assert interrupted_attempt.reason == "turtlebot-1: the trial was aborted by anna@one at 12:00:00 UTC"
    assert removed_folders == [f".fieldkit/{plan_of_two_repeats().trial}/tcp-01-1"]


def test_the_remedy_of_a_failed_step_is_reported(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = iter([RobotError("sending began too late", remedy="a larger `idle` leaves it more time")])

    def measure(*_: object) -> None:
        for failure in failures:
            raise failure

    monkeypatch.setattr(Robots, "measure", measure)
    run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, events.append)
    reasons_and_remedies = [(event.reason, event.remedy) for event in repeat_ends(events)]
    assert reasons_and_remedies[0] == ("sending began too late", "a larger `idle` leaves it more time")
    assert not any(remedy for _, remedy in reasons_and_remedies[1:])


def test_an_unexpected_exception_of_a_step_is_not_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(*_: object) -> None:
        raise KeyError("load")

    monkeypatch.setattr(Robots, "measure", measure)
    with pytest.raises(KeyError):
        run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, lambda _: None)
    (interrupted_attempt,) = journal.ended_attempts(journal.read(trial_in(tmp_path)))
    assert (interrupted_attempt.status, interrupted_attempt.excused, interrupted_attempt.reason) == (
        Status.VOID,
        True,
        "KeyError: 'load'",
    )


def test_evidence_missing_after_a_kill_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = store.create(tmp_path, plan_of_two_repeats())
    (repeat, _) = plan_of_two_repeats().repeats_in_order()
    journal.append(
        folder,
        JournalEntry(1, repeat.protocol, 1, 0, Status.PLANNED),
        JournalEntry(2, repeat.protocol, 1, 1, Status.RUNNING),
        JournalEntry(3, repeat.protocol, 1, 1, Status.MEASURED),
    )
    fetch, message = Robots.fetch, "turtlebot-1: it has no folder .fieldkit/x/tcp-01-1 any more"

    def fail_first_fetch(self: Robots, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        return [message] if remote.endswith("tcp-01-1") else fetch(self, remote, into, ended_normally=ended_normally)

    monkeypatch.setattr(Robots, "fetch", fail_first_fetch)
    resume_trial(folder, IdleTestbed(), lambda _: None)
    first = journal.ended_attempts(journal.read(folder))[0]
    assert (first.status, first.excused) == (Status.VOID, True)
    assert (
        first.reason
        == f"fieldkit was killed before it had fetched the evidence, which could not be fetched later; {message}"
    )


def test_evidence_left_on_a_robot_is_also_reported_after_resuming(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    fetch = Robots.fetch

    def mark_first_unfetched(self: Robots, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        if remote.endswith("tcp-01-1"):
            self.unfetched.mark(Role.SENDER, remote, into, "the link broke \udcff")
            return ["the link broke"]
        raise LockLostError("aborted")

    monkeypatch.setattr(Robots, "fetch", mark_first_unfetched)
    with pytest.raises(LockLostError):
        run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, events.append)
    folder = trial_in(tmp_path)
    note = Note(
        f"turtlebot-1: evidence that was not fetched stays on the robot; delete it if you do not need it: "
        f"~/.fieldkit/{folder.name}/tcp-01-1, ~/.fieldkit/{folder.name}/tcp-01-2"
    )
    assert note in events
    unfetched = folder / "repeats/tcp-01.void1" / unfetched_file(Role.SENDER)
    assert "the link broke ?\nthe evidence is on turtlebot-1 in ~/.fieldkit/" in unfetched.read_text(encoding="utf-8")
    events.clear()
    monkeypatch.setattr(Robots, "fetch", fetch)
    resume_trial(folder, IdleTestbed(), events.append)
    assert note in events
    assert verification.verify(folder) == []


def test_too_little_memory_makes_an_attempt_void_and_does_not_end_the_trial(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    judge, calls = gates.judge, 0

    def raise_memory_error_once(plan: Plan, repeat: RepeatId, evidence: AttemptEvidence) -> EvidenceVerdict:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise MemoryError
        return judge(plan, repeat, evidence)

    monkeypatch.setattr(gates, "judge", raise_memory_error_once)
    run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, events.append)
    void_attempt, void_without_memory, *valid = repeat_ends(events)
    assert void_without_memory.reason == "this machine has too little memory to measure it"
    assert [attempt.status for attempt in (void_attempt, void_without_memory, *valid)] == [
        Status.VOID,
        Status.VOID,
        Status.VALID,
        Status.VALID,
    ]


def interrupt(*_args: object, **_options: object) -> list[str]:
    raise KeyboardInterrupt


def test_an_attempt_stopped_during_fetching_is_fetched_by_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(Robots, "fetch", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, lambda _: None)
    folder = trial_in(tmp_path)
    assert [
        interrupted_attempt.status for interrupted_attempt in journal.interrupted_attempts(journal.read(folder))
    ] == [Status.MEASURED]
    fetched: list[str] = []

    def fetch(_self: Robots, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        fetched.append(remote)
        (into / "ping.txt").write_text(PING, encoding="utf-8")
        write_states(into)
        return []

    monkeypatch.setattr(Robots, "fetch", fetch)
    resume_trial(folder, IdleTestbed(), lambda _: None)
    first, second = journal.ended_attempts(journal.read(folder))
    assert (first.status, first.number, second.repeat.number) == (Status.VALID, 1, 2)
    assert fetched[0] == first.remote_folder(folder.name)


def test_evidence_of_an_attempt_stopped_during_its_steps_stays_on_the_robots(
    tmp_path: Path, events: list[Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(Robots, "measure", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, events.append)
    folder = trial_in(tmp_path)
    remote = f"~/.fieldkit/{folder.name}/tcp-01-1"
    for role in Robots(plan_of_two_repeats(), IdleTestbed())._roles:
        unfetched = folder / "repeats/tcp-01.void1" / unfetched_file(role)
        assert unfetched.read_text(encoding="utf-8").startswith("interrupted\n")
    for _ in range(2):
        notes = [event.text for event in events if isinstance(event, Note)]
        assert sum("was not fetched stays" in note and remote in note for note in notes) == 2
        events.clear()
        resume_trial(folder, IdleTestbed(), events.append)
    assert verification.verify(folder) == []


def fail_from_write(monkeypatch: pytest.MonkeyPatch, moment: int, error: OSError) -> list[str]:
    """Make the `moment`-th call that writes fail, and all later ones; return the list of failed calls."""
    count, failed_calls = 0, []

    def failing_call(name: str, call: Callable[..., object]) -> Callable[..., object]:
        def count_call(*args: object, **options: object) -> object:
            nonlocal count
            count += 1
            if count >= moment:
                failed_calls.append(name)
                raise error
            return None if name == "fsync" else call(*args, **options)

        return count_call

    for name in ("fsync", "write", "rename", "mkdir"):
        monkeypatch.setattr(os, name, failing_call(name, getattr(os, name)))
    return failed_calls


@pytest.mark.parametrize("stride", mark_nightly([3, 1]))
def test_a_disk_may_be_full_at_any_write(stride: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk_full, moment, is_over = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), 1 - stride, False
    while not is_over:
        out = tmp_path / str(moment := moment + stride)
        with monkeypatch.context() as patched:
            failed_calls = fail_from_write(patched, moment, disk_full)
            try:
                run_trial(plan(), IdleTestbed(), out, lambda _: None)
            except ConfigurationError as error:
                assert error.what  # noqa: PT017 (the trial may also end without an error)
            is_over = not failed_calls
        if any(out.glob("*/trial.yaml")):
            folder = trial_in(out)
            resume_trial(folder, IdleTestbed(), lambda _: None)
            assert verification.verify(folder) == []
            assert rebuild(folder).changed == ()
            assert (
                sum(attempt.status is Status.VALID for attempt in journal.ended_attempts(journal.read(folder))) == 1
            )
        shutil.rmtree(out, ignore_errors=True)
    assert moment > 30, "too few writes were interrupted"


def test_a_moved_folder_stops_the_trial_which_can_be_resumed_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetch = Robots.fetch

    def fetch_and_move_folder(self: Robots, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        output_text = fetch(self, remote, into, ended_normally=ended_normally)
        if remote.endswith("tcp-02-1"):
            trial_in(tmp_path).rename(tmp_path / "moved")
        return output_text

    monkeypatch.setattr(Robots, "fetch", fetch_and_move_folder)
    with pytest.raises(ConfigurationError, match="cannot be written: No such file or directory") as caught:
        run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, lambda _: None)
    assert caught.value.remedy == "fieldkit resume FOLDER, with the current path of the folder"
    monkeypatch.setattr(Robots, "fetch", fetch)
    resume_trial(tmp_path / "moved", IdleTestbed(), lambda _: None)
    assert verification.verify(tmp_path / "moved") == []
    assert [attempt.status for attempt in journal.ended_attempts(journal.read(tmp_path / "moved"))] == [
        "void",
        "valid",
        "valid",
    ]


def test_a_running_trial_is_not_rebuilt(tmp_path: Path) -> None:
    run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, lambda _: None)
    with (
        journal.locked(trial_in(tmp_path)),
        pytest.raises(ConfigurationError, match="another fieldkit process runs this trial"),
    ):
        rebuild(trial_in(tmp_path))


def test_changed_evidence_is_reported_on_resume(tmp_path: Path, events: list[Event]) -> None:
    run_trial(plan_of_two_repeats(), IdleTestbed(), tmp_path, events.append)
    folder = trial_in(tmp_path)
    (folder / "repeats/tcp-02/ping.txt").write_text(PING.replace("time=2", "time=9"), encoding="utf-8")
    resume_trial(folder, IdleTestbed(), events.append)
    assert Note("the evidence has changed since it was stored: repeats/tcp-02/ping.txt: changed") in events
    assert verification.verify(folder) == ["repeats/tcp-02/ping.txt: changed"]


def test_a_trial_started_with_another_version_of_a_step_package_is_not_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial = plan_of_two_repeats()
    trial = trial.model_copy(update={"versions": {**trial.versions, "lab-steps": "1.0"}})
    folder = store.create(tmp_path, trial)
    monkeypatch.setattr(plugins, "versions", lambda: {"lab-steps": "1.0", "fieldkit": "stale"})
    assert resumable(folder) == trial
    monkeypatch.setattr(plugins, "versions", lambda: {"lab-steps": "1.1"})
    with pytest.raises(ConfigurationError, match=r"started with other code \(lab-steps 1\.0\)"):
        resumable(folder)


def test_each_expectation_is_judged_before_the_trial_ends(tmp_path: Path, events: list[Event]) -> None:
    expect = ("rtt_loss < 20 % of all packets", "udp rtt_loss < 1 %")
    procedure = plan().procedure.model_copy(update={"expect": expect})
    outcome = run_trial(
        plan_of_two_repeats().model_copy(update={"procedure": procedure}), IdleTestbed(), tmp_path, events.append
    )
    assert outcome is not None
    *_, first, second, last = events
    assert isinstance(first, ExpectationJudged)
    assert isinstance(second, ExpectationJudged)
    assert isinstance(last, TrialEnded)
    assert (first.expectation, first.protocol, first.ruling) == (expect[0], "tcp", outcome.judgements[0].ruling)
    assert (first.n, first.n_valid, first.n_censored) == (2, 2, 0)
    assert (second.protocol, second.ruling, second.why, second.n_valid) == (
        "udp",
        "undecided",
        "no repeat has ended",
        0,
    )
