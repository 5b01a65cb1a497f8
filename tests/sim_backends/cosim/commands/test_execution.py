"""Runs of many seeds, and how they end."""

import os

import pytest

from fieldkit.core.events import Event
from sim_backends.cosim.commands import execution
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario


def ignore(_: Event) -> None:
    """Ignore an event."""


def test_ctrl_c_ends_all_seeds_on_a_single_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a single processor, the runs are in the process that receives the signal."""
    started: list[int | None] = []

    def interrupted(*arguments: object, seed: int, **options: object) -> object:
        simulation = build(*arguments, seed=seed, **options)  # type: ignore[arg-type]
        started.append(seed)
        if seed == 2:

            def run(**_: object) -> object:
                simulation.coordinator.advance(20_000_000)
                raise KeyboardInterrupt

            monkeypatch.setattr(simulation, "run", run)
        return simulation

    monkeypatch.setattr(execution, "build", interrupted)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    scenario = load_scenario("baylands", {"duration": "50ms"})
    results, ended = execution.simulate_all(scenario, "scheduled", [1, 2, 3], None, sink=ignore)
    assert (started, ended) == ([1, 2], True)
    assert [(result.seed, result.is_interrupted) for result in results] == [(1, False), (2, True)]
    assert results[1].simulated_s == 0.02
