"""Detection of periods that are commensurate with windows, compared with counted phases of packets."""

from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.scenario.phases import MAX_PHASES, commensurate_events, incommensurate_window_s
from sim_backends.cosim.scenario.schema import CosimScenario

AGENTS = {
    "ann": {"robot": "husky", "at_m": [20, 12], "radio": {}},
    "bob": {"robot": "husky", "at_m": [24, 12], "radio": {}},
}


def pair(rate: str = "50Hz") -> CosimScenario:
    traffic = [{"kind": "stream", "from": "ann", "to": "bob", "rate": rate}]
    return load_scenario("convoy", {"agents": AGENTS, "traffic": traffic, "duration": "10s"})


@settings(max_examples=25)
@given(period_ms=st.integers(5, 200), window_ms=st.integers(1, 100))
def test_events_are_commensurate_if_few_phases_are_counted(period_ms: int, window_ms: int) -> None:
    """With whole milliseconds, the number of phases is the denominator of period over window in lowest terms."""
    phases = Fraction(period_ms, window_ms).denominator
    commensurate = commensurate_events(pair(rate=f"{1000 / period_ms:.20f}Hz"), [window_ms / 1000])
    event_count = 10_000 // period_ms
    counted_phases = len({number * period_ms % window_ms for number in range(event_count)})
    assert counted_phases == min(phases, event_count)
    if phases <= MAX_PHASES:
        assert [event.phases for event in commensurate] == [phases]
    for event in commensurate:
        # If there are more phases than reported, every further phase is close to a reported one: after `event.phases`
        # events, the phase is nearly the same again.
        phases_ms = [number * period_ms % window_ms for number in range(0, event_count, event.phases)]
        assert all(min(ms, window_ms - ms) < window_ms / event.phases for ms in phases_ms)


@pytest.mark.parametrize(
    ("rate", "window_s", "phases"),
    [("50Hz", 0.01, [1]), ("50Hz", 0.04, [2]), ("47Hz", 0.01, []), ("50Hz", 0.011, []), ("50.001Hz", 0.01, [1])],
)
def test_nearly_commensurate_events_are_reported_unless_they_drift_over_all_phases(
    rate: str, window_s: float, phases: list[int]
) -> None:
    assert [event.phases for event in commensurate_events(pair(rate=rate), [window_s])] == phases


def test_the_proposed_window_is_not_commensurate() -> None:
    scenario = pair()
    proposed_s = incommensurate_window_s(scenario, 0.01)
    assert proposed_s == pytest.approx(0.011)
    assert not commensurate_events(scenario, [proposed_s or 0.0])
    assert incommensurate_window_s(scenario, 0.001) is None, "whole steps of 1 ms are commensurate with 20 ms"


@pytest.mark.parametrize("kind", [{"kind": "file", "size_bytes": 100}, {}, {"kind": "ping"}, {"kind": "bag"}])
def test_every_flow_begins_at_a_random_phase(kind: dict[str, object]) -> None:
    keys = {"kind": "stream", "rate": "2Hz"} | kind
    if kind:
        del keys["rate"]
    traffic = [{"from": "ann", "to": "bob", "start": "100ms", **keys}]
    scenario = load_scenario("convoy", {"agents": AGENTS, "traffic": traffic, "duration": "2s"})
    first_wakes_ns = set()
    for seed in range(8):
        wakes_ns = build(scenario, seed=seed).agents.programs["ann"].next_wake_ns()
        assert wakes_ns is not None
        first_wakes_ns.add(wakes_ns)
    assert len(first_wakes_ns) == 8
    assert min(first_wakes_ns) >= 100_000_000
    assert len({at_ns % 10_000_000 // 1_000_000 for at_ns in first_wakes_ns}) > 3, "phases of a window of 10 ms"
