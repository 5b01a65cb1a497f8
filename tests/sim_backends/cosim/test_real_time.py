"""Runs in real time: their duration, their lateness, and the refusal of a run that cannot keep up."""

import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.real_time import Pace, RealTimeError, WindowLateness
from tests.helpers.runs import rows, run_here

SHORT = {"duration": "400ms", "policy.name": "sliding_window", "policy.window": "20ms"}


@given(st.lists(st.integers(-(10**10), 10**10), min_size=1))
def test_the_histogram_counts_every_window_below_its_limit(lateness_values_ns: list[int]) -> None:
    lateness = WindowLateness()
    for lateness_ns in lateness_values_ns:
        lateness.add(lateness_ns)
    assert lateness.windows.total() == len(lateness_values_ns)
    assert lateness.largest_ns == max(0, *lateness_values_ns)
    assert lateness.windows[0] == sum(lateness_ns <= 0 for lateness_ns in lateness_values_ns)
    for limit_ns in lateness.windows:
        assert str(limit_ns).rstrip("0") in {"", "1", "2", "5"}
        window_count = sum(count for bound_ns, count in lateness.windows.items() if bound_ns <= limit_ns)
        assert window_count == sum(lateness_ns <= limit_ns for lateness_ns in lateness_values_ns)


def test_a_run_takes_as_long_as_its_factor_states_and_has_the_events_of_a_fast_run() -> None:
    scenario = load_scenario("field_30ft", SHORT)
    unpaced_run = build(scenario).run()
    lateness, simulation, start_s = WindowLateness(), build(scenario), time.monotonic()
    Pace(2.0, late_bound_s=60).run(simulation, lateness)
    assert time.monotonic() - start_s >= 0.2 - 0.001
    assert simulation.coordinator.run.digest == unpaced_run.digest
    assert lateness.windows.total() == len(unpaced_run.windows_ns) == 20


def test_a_stall_is_counted_and_the_run_catches_up() -> None:
    stall = {"kind": "stalled-federate", "federate": "network", "from": "200ms", "stall": "150ms"}
    simulation = build(load_scenario("field_30ft", {**SHORT, "faults": [stall]}))
    lateness, start_s = WindowLateness(), time.monotonic()
    Pace(1.0, late_bound_s=60).run(simulation, lateness)
    assert lateness.largest_ns >= 100_000_000
    assert time.monotonic() - start_s >= 0.4 - 0.001


def test_a_run_that_cannot_keep_up_is_stopped_with_the_amount() -> None:
    simulation = build(load_scenario("field_30ft", SHORT))
    with pytest.raises(RealTimeError, match=r"ends at 0\.\d+ s was \d+\.\d{3} s late, and the bound is 1e-06 s"):
        Pace(1e6, late_bound_s=1e-6).run(simulation, WindowLateness())


def test_the_command_marks_the_results_of_a_late_run_as_failed_and_shows_the_histogram(tmp_path: Path) -> None:
    words = ("cosim", "run", "field_30ft", "--duration", "400ms", "--window", "20ms", "--policy", "sliding_window")
    late_run = run_here(tmp_path, *words, "--realtime", "1000000", "--late-bound", "1us", "--out", "late")
    assert late_run.code == 4
    assert "slower than --realtime 1e+06: the window that ends at 0." in late_run.err
    assert "late up to (ms)" in late_run.out
    assert "scan-udp" not in late_run.out
    assert {row["status"] for row in rows(tmp_path / "late")} <= {"failed"}

    paced_run = run_here(tmp_path, *words, "--realtime", "2", "--late-bound", "60s")
    assert paced_run.code == 0, paced_run.err
    assert "late up to (ms)" in paced_run.out
    assert "0.4 s simulated, paced by --realtime; without its waits, " in paced_run.out

    for options, message in (
        (("--realtime", "-1"), "--realtime: '-1' is not a number above 0"),
        (("--late-bound", "1s"), "--late-bound needs --realtime"),
    ):
        refused_run = run_here(tmp_path, *words, *options)
        assert refused_run.code == 2
        assert message in refused_run.err
