"""Opening the robots of a trial: the order of the steps, the clean-up, and the note about trials not started."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.core import runtime, seeds
from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError, RobotError
from fieldkit.core.events import Event, Note, Sink
from fieldkit.core.model import Protocol, Status, Topology
from fieldkit.core.prompts import Operator, Question
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Shells
from fieldkit.trial import journal, store
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.running import locks, opening, preflight, resumption, runner
from fieldkit.trial.running.locks import Holder
from fieldkit.trial.running.runner import Outcome
from fieldkit.trial.running.stop import Stop
from tests.helpers.casts import CAST, plain_plan
from tests.helpers.idle_testbed import IdleTestbed

TESTBED = IdleTestbed()


class UnusedOperator:
    """An operator who must not be asked."""

    def ask(self, request: str, *, may_skip: bool = False) -> Any:  # noqa: ANN401 (never returns)
        raise AssertionError(request, may_skip)

    def enter(self, question: Question) -> str:
        raise AssertionError(question)


class Recorder:
    """A backend that records the calls of itself, of the preflight checks, of the locks and of the runner.

    Args:
        failing: Errors to raise, by the name of the call.
    """

    by_hand = False
    lab_bytes = 0
    permissions: frozenset[str] = frozenset()

    def __init__(self, failing: Mapping[str, BaseException]) -> None:
        self.failing = dict(failing)
        self.done: list[str] = []
        self.events: list[Event] = []
        self.holder: Holder | None = None
        self.seeds: list[int] = []

    def note(self, event: str) -> None:
        self.done.append(event)
        if event in self.failing:
            raise self.failing[event]

    @contextmanager
    def record_both_ends(self, event: str) -> Iterator[None]:
        self.note(event)
        try:
            yield
        finally:
            self.done.append(f"{event} ends")

    def cast(self, topology: Topology) -> Cast:
        assert topology is Topology.MASTER
        return CAST

    @contextmanager
    def open(self, cast: Cast, *, seed: int, sink: Sink, operator: Operator) -> Iterator[Testbed]:
        assert cast == CAST
        self.seeds.append(seed)
        with self.record_both_ends("open"):
            yield TESTBED

    def persistent_shells(self, *, sink: Sink) -> AbstractContextManager[Mapping[str, Shell | FieldkitError]]:
        raise AssertionError

    def run(self, plans: list[Plan], out: Path) -> list[Outcome | None]:
        return opening.run(plans, self, CAST, out, sink=self.events.append, operator=UnusedOperator(), stop=Stop())


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Recorder]:
    def make(**failing: BaseException) -> Recorder:
        recording = Recorder(failing)

        def connect(cast: Cast, shells: Shells, sink: Sink) -> None:
            assert (cast, shells) == (CAST, TESTBED.shells)
            recording.note("meet")

        def lock(shells: Shells, holder: Holder, *, sink: Sink) -> AbstractContextManager[None]:
            assert shells == TESTBED.shells
            recording.holder = holder
            return recording.record_both_ends("hold")

        def run_trial(plan: Plan, testbed: Testbed, out: Path, sink: Sink, stop: Stop) -> Outcome:
            assert testbed is TESTBED
            recording.note(f"run_{plan.distance}")
            return Outcome(out / plan.trial, (), 2, 0)

        def resume_trial(folder: Path, testbed: Testbed, sink: Sink, stop: Stop, *, failed: bool) -> Outcome:
            assert testbed is TESTBED
            recording.note("resume")
            return Outcome(folder, (), 2, 0)

        monkeypatch.setattr(preflight, "connect_all", connect)
        monkeypatch.setattr(locks, "locked_exclusively", lock)
        monkeypatch.setattr(runner, "run_trial", run_trial)
        monkeypatch.setattr(resumption, "resume_trial", resume_trial)
        return recording

    return make


def plans() -> list[Plan]:
    first = plain_plan()
    return [first.model_copy(update={"distance": distance}) for distance in ("10ft", "20ft", "30ft")]


def notes(recorder: Recorder) -> list[str]:
    return [event.text for event in recorder.events if isinstance(event, Note)]


def test_trials_run_one_after_the_other_on_robots_opened_once(
    recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recording, out = recorder(), tmp_path / "trials"
    outcomes = recording.run(plans(), out)
    events = ["open", "meet", "hold", "run_10ft", "run_20ft", "run_30ft"]
    assert recording.done == [*events, "hold ends", "open ends"]
    assert [outcome and outcome.valid for outcome in outcomes] == [2, 2, 2]
    assert recording.holder == Holder(plans()[0].session, runtime.user_at_host(), plans()[0].trial)
    assert out.is_dir()
    assert notes(recording) == []
    assert recording.seeds == [7]


@pytest.mark.parametrize(
    ("failing", "error", "done"),
    [
        ("open", LinkError("x"), ["open"]),
        ("meet", RobotError("x"), ["open", "meet", "open ends"]),
        ("hold", RobotError("x"), ["open", "meet", "hold", "open ends"]),
    ],
)
def test_robots_are_released_if_one_cannot_be_reached_or_locked(
    recorder: Callable[..., Recorder], tmp_path: Path, failing: str, error: FieldkitError, done: list[str]
) -> None:
    recording = recorder(**{failing: error})
    with pytest.raises(type(error)):
        recording.run(plans(), tmp_path)
    assert recording.done == done
    assert notes(recording) == []


@pytest.mark.parametrize("error", [RobotError("x"), KeyboardInterrupt()])
@pytest.mark.parametrize(
    ("failing", "expected_notes"),
    [("run_10ft", ["not started: 20ft, 30ft"]), ("run_20ft", ["not started: 30ft"]), ("run_30ft", [])],
)
def test_a_stopped_trial_unlocks_the_robots_and_reports_trials_not_started(
    recorder: Callable[..., Recorder], tmp_path: Path, error: BaseException, failing: str, expected_notes: list[str]
) -> None:
    recording = recorder(**{failing: error})
    with pytest.raises(type(error)):
        recording.run(plans(), tmp_path)
    assert recording.done[-3:] == [failing, "hold ends", "open ends"]
    assert notes(recording) == expected_notes


def test_nothing_is_opened_for_a_folder_that_cannot_be_written(
    recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    recording = recorder()
    with pytest.raises(ConfigurationError):
        recording.run(plans(), tmp_path / "file")
    assert recording.done == []


def resume(recording: Recorder, folder: Path, backend: str = "field") -> Outcome | None:
    return resumption.resume(
        folder, backend, recording, failed=False, sink=recording.events.append, operator=UnusedOperator(), stop=Stop()
    )


def test_a_trial_is_resumed_through_the_same_steps(recorder: Callable[..., Recorder], tmp_path: Path) -> None:
    recording, plan = recorder(), plain_plan()
    folder = store.create(tmp_path, plan)
    assert resume(recording, folder) == Outcome(folder, (), 2, 0)
    assert recording.done == ["open", "meet", "hold", "resume", "hold ends", "open ends"]
    assert recording.holder == Holder(plan.session, runtime.user_at_host(), plan.trial)


def test_a_resumed_trial_draws_other_random_numbers_for_each_attempt(
    recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recording = recorder()
    folder = store.create(tmp_path, plain_plan())
    for attempt in (1, 2, 3):
        resume(recording, folder)
        for status in (Status.RUNNING, Status.VOID):
            journal.append(folder, JournalEntry(attempt, Protocol.TCP, 1, attempt, status))
    assert recording.seeds[0] == 7, "before the first attempt, the seed of the trial"
    assert len(set(recording.seeds)) == 3
    assert {seeds.place_seed(seed) for seed in recording.seeds} == {7}, "the shadowing of the place stays the same"


def test_a_trial_of_another_backend_is_rejected_before_robots_are_opened(
    recorder: Callable[..., Recorder], tmp_path: Path
) -> None:
    recording, folder = recorder(), store.create(tmp_path, plain_plan())
    with pytest.raises(ConfigurationError):
        resume(recording, folder, "emulated")
    assert recording.done == []
