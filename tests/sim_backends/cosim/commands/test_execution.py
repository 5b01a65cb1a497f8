"""Runs with several seeds, and their interruption by SIGINT."""

import os
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from fieldkit.core import executors
from fieldkit.core.events import Event
from fieldkit.core.executors import Workers
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.commands import execution
from sim_backends.cosim.commands.execution import interrupt_between_windows
from sim_backends.cosim.real_time import Pace
from sim_backends.cosim.run_record import EventDigest, Window
from sim_backends.world.motion import State
from tests.helpers.runs import run_here

INTERRUPTED_WINDOW = 7


class WindowCounter:
    """An observer that counts windows, and can interrupt the process during one of them."""

    def __init__(self, *, interrupts: bool) -> None:
        self.windows = 0
        self._interrupts = interrupts

    def begin(self, states: Mapping[str, State]) -> None:
        pass

    def window(self, window: Window) -> None:
        if self._interrupts and self.windows == INTERRUPTED_WINDOW:
            os.kill(os.getpid(), signal.SIGINT)
        self.windows += 1


@pytest.mark.parametrize("interrupts", [True, False], ids=["while it is recorded", "while it is hashed"])
def test_an_interrupted_window_is_either_both_hashed_and_recorded_or_neither(
    monkeypatch: pytest.MonkeyPatch, *, interrupts: bool
) -> None:
    observer = WindowCounter(interrupts=interrupts)
    simulation = build(load_scenario("field_30ft"), recorder=observer)
    coordinator = simulation.coordinator
    if not interrupts:
        add_window = EventDigest.add_window

        def add_window_then_interrupt(digest: EventDigest, *arguments: object) -> None:
            add_window(digest, *arguments)  # type: ignore[arg-type]
            os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(EventDigest, "add_window", add_window_then_interrupt)
    with pytest.raises(KeyboardInterrupt), interrupt_between_windows(coordinator):
        simulation.run()
    digest = coordinator._digest
    assert observer.windows == digest._windows + len(digest.quiet_ends_ns) == len(coordinator.run.windows_ns) > 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def ignore(_: Event) -> None:
    """Ignore an event."""


def test_ctrl_c_ends_all_seeds_on_a_single_processor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """On a single processor, the runs take place in the process that receives the signal."""
    started_seeds: list[int | None] = []

    def build_interrupted(*arguments: object, seed: int, **options: object) -> object:
        simulation = build(*arguments, seed=seed, **options)  # type: ignore[arg-type]
        started_seeds.append(seed)
        if seed == 2:

            def run(**_: object) -> object:
                simulation.coordinator.advance(20_000_000)
                raise KeyboardInterrupt

            monkeypatch.setattr(simulation, "run", run)
        return simulation

    monkeypatch.setattr(execution, "build", build_interrupted)
    monkeypatch.setattr(executors, "usable_processors", lambda: 1)
    scenario = load_scenario("baylands", {"duration": "50ms"})
    results, is_interrupted = execution.simulate_all(scenario, "scheduled", [1, 2, 3], None, sink=ignore)
    assert (started_seeds, is_interrupted) == ([1, 2], True)
    assert [(result.seed, result.is_interrupted) for result in results] == [(1, False), (2, True)]
    assert results[1].simulated_s == 0.02
    words = ("--policy", "scheduled", "--duration", "50ms", "--seeds", "3")
    interrupted_run = run_here(tmp_path, "cosim", "run", "baylands", *words)
    assert interrupted_run.code == 130
    assert "interrupted: the runs of 1 of 3 seeds had finished" in interrupted_run.err


def test_the_output_is_the_same_for_any_number_of_workers(tmp_path: Path) -> None:
    outputs = []
    for jobs in ("1", "2"):
        words = (
            "--seeds",
            "3",
            "--jobs",
            jobs,
            "--duration",
            "600ms",
            "--format",
            "csv",
            "--out",
            f"jobs-{jobs}/runs",
        )
        run = run_here(tmp_path, "cosim", "run", "field_30ft", *words)
        assert run.code == 0, run.err
        folder = tmp_path / f"jobs-{jobs}"
        tables = {path.relative_to(folder): path.read_bytes() for path in folder.rglob("trial.csv")}
        assert len(tables) == 3
        outputs.append((run.out, tables))
    assert outputs[0] == outputs[1]


def test_the_option_sets_the_number_of_workers_and_a_paced_run_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen_workers = []

    def record_workers(*_: object, workers: Workers) -> Iterator[object]:
        chosen_workers.append(workers)
        yield from ()

    monkeypatch.setattr(execution, "as_completed_tasks", record_workers)
    scenario = load_scenario("field_30ft")
    execution.simulate_all(scenario, "scheduled", [1, 2], None, sink=ignore, workers=Workers(2))
    execution.simulate_all(scenario, "scheduled", [1, 2], None, sink=ignore, pace=Pace(1), workers=Workers(2))
    assert chosen_workers == [Workers(2), Workers(1)]
