"""Estimates of durations: without finished repeats, from a good and a dead link; else from the finished repeats."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Protocol, Status, Topology
from fieldkit.core.units import TimeEstimate, parse_distance
from fieldkit.trial import estimates
from fieldkit.trial.estimates import FinishedRepeat, estimate_repeats, estimate_trial
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from tests.helpers.casts import los_plan
from tests.trial.test_trial_crash import plan as ping_plan

LOS = los_plan()
TCP, UDP = Protocol.TCP, Protocol.UDP


def los_at(distance: str, topology: Topology = LOS.topology) -> Plan:
    parsed = parse_distance(distance)
    return LOS.model_copy(update={"distance_m": parsed.metres, "distance": distance, "topology": topology})


def test_the_first_estimate_ranges_from_a_good_link_to_a_dead_link() -> None:
    estimate = estimate_repeats(LOS, TCP, 20, [])
    assert estimate.likely_s == pytest.approx(20 * LOS.procedure.expected_s(TCP))
    assert estimate.most_s == pytest.approx(estimate.likely_s + 20 * 120.0), "a transfer waits for its limit of 120 s"
    assert estimate_trial(LOS, []).likely_s == pytest.approx(
        LOS.repeats * sum(LOS.procedure.expected_s(protocol) for protocol in LOS.protocols)
    )
    assert ", up to 4" in str(estimate)


def test_finished_repeats_of_the_same_trial_are_preferred() -> None:
    condition, other_distance = los_at("30ft"), los_at("10ft")
    finished = [
        FinishedRepeat(condition, TCP, 130.0),
        FinishedRepeat(condition, TCP, 150.0),
        FinishedRepeat(other_distance, TCP, 9.0),
        FinishedRepeat(condition, UDP, 8.0),
    ]
    assert estimate_repeats(condition, TCP, 3, finished) == TimeEstimate(3 * 140.0, 3 * 150.0)
    assert estimate_repeats(condition, UDP, 3, finished) == TimeEstimate(24.0, 24.0), (
        "each protocol is estimated from its own repeats"
    )


def test_notes_name_batteries_that_last_for_less_than_the_trial() -> None:
    short = LOS.model_copy(update={"repeats": 1})
    assert not list(estimates.battery_notes([short]))
    (note,) = estimates.battery_notes([LOS.model_copy(update={"repeats": 20})])
    assert note.startswith(
        "duckiedrone-1 runs for about 7 min on one charge (battery_min of its profile), the trial "
    )


def test_a_larger_distance_than_all_finished_ones_may_have_a_dead_link() -> None:
    finished = [FinishedRepeat(los_at("10m"), TCP, 9.0), FinishedRepeat(los_at("20m"), TCP, 12.0)]
    farther = estimate_repeats(los_at("30m"), TCP, 1, finished)
    assert farther.likely_s == 12.0, "as long as at the largest distance with finished repeats"
    assert farther.most_s == estimates.dead_link_s(LOS.procedure, TCP)
    assert estimate_repeats(los_at("15m"), TCP, 1, finished) == TimeEstimate(10.5, 12.0), (
        "between two distances with finished repeats: at most as long as these"
    )
    assert estimate_repeats(los_at("5m"), TCP, 1, finished) == TimeEstimate(9.0, 12.0)


def test_another_topology_is_used_if_the_same_has_no_repeats() -> None:
    other = next(topology for topology in Topology if topology is not LOS.topology)
    finished = [FinishedRepeat(los_at("10m", other), TCP, 50.0)]
    assert estimate_repeats(los_at("10m"), TCP, 2, finished) == TimeEstimate(100.0, 100.0)
    assert estimate_repeats(
        los_at("10m"), TCP, 2, [*finished, FinishedRepeat(los_at("10m"), TCP, 7.0)]
    ) == TimeEstimate(14.0, 14.0)


def test_finished_repeats_with_a_dead_link_are_used() -> None:
    """A campaign that was estimated at 4 min took 19 min; trials with dead links must improve the next estimates."""
    near_plan, far_plan = los_at("10m"), los_at("90m")
    before = estimate_trial(far_plan, [FinishedRepeat(near_plan, protocol, 8.0) for protocol in LOS.protocols])
    dead_s = sum(estimates.dead_link_s(LOS.procedure, protocol) for protocol in LOS.protocols) * LOS.repeats
    assert before.most_s == pytest.approx(dead_s)
    after = estimate_trial(
        los_at("80m"),
        [
            FinishedRepeat(near_plan, TCP, 8.0),
            FinishedRepeat(far_plan, TCP, 128.0),
            FinishedRepeat(near_plan, UDP, 8.0),
        ],
    )
    assert after.likely_s >= LOS.repeats * (8.0 + 128.0) / 2


def entry(second: float, number: int, attempt: int, status: Status, *, excused: bool = False) -> JournalEntry:
    return JournalEntry(round(second * 1e9), TCP, number, attempt, status, excused=excused)


def test_a_repeat_takes_as_long_as_all_of_its_attempts() -> None:
    entries = [
        entry(0, 1, 0, Status.PLANNED),
        entry(10, 1, 1, Status.RUNNING),
        entry(30, 1, 1, Status.MEASURED),
        entry(40, 1, 1, Status.VOID),
        entry(50, 1, 2, Status.RUNNING),
        entry(55, 1, 2, Status.VALID),
        entry(60, 2, 1, Status.RUNNING),
        entry(90_000, 2, 1, Status.VOID, excused=True),
        entry(90_010, 2, 2, Status.RUNNING),
        entry(90_020, 2, 2, Status.FAILED),
        entry(90_030, 3, 1, Status.RUNNING),
    ]
    plan = ping_plan()
    assert estimates.finished_repeats(plan, entries) == [
        FinishedRepeat(plan, TCP, 35.0),
        FinishedRepeat(plan, TCP, 10.0),
    ]


TIMES = st.lists(
    st.tuples(st.sampled_from(["5m", "10m", "20m", "40m"]), st.sampled_from([TCP, UDP]), st.floats(0.1, 1e4)),
    max_size=8,
)


@given(finished=TIMES, distance=st.sampled_from(["5m", "10m", "30m", "50m"]), count=st.integers(0, 50))
def test_the_largest_duration_is_never_below_the_expected_duration(
    finished: list[tuple[str, Protocol, float]], distance: str, count: int
) -> None:
    estimate = estimate_repeats(
        los_at(distance),
        TCP,
        count,
        [
            FinishedRepeat(los_at(trial_distance), trial_protocol, duration_s)
            for trial_distance, trial_protocol, duration_s in finished
        ],
    )
    assert 0 <= estimate.likely_s <= estimate.most_s * (1 + 1e-9)
