"""The order of a campaign compared with brute force: complete, in blocks, within the walking limit, and random."""

from collections import Counter
from collections.abc import Iterator
from itertools import groupby, permutations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.campaign import order
from fieldkit.campaign.order import PlannedTrial
from fieldkit.core.model import Distance, Scenario, Topology


def trial(feet: int, scenario: Scenario, topology: Topology, procedure: str = "") -> PlannedTrial:
    return PlannedTrial(procedure or str(scenario), scenario, topology, Distance(0.3048 * feet, f"{feet}ft"))


trials = st.sets(
    st.builds(
        trial,
        st.sampled_from([5, 10, 30, 55]),
        st.sampled_from(Scenario),
        st.sampled_from(Topology),
        st.sampled_from(["", "heavy"]),
    ),
    min_size=1,
    max_size=20,
)
seeds = st.integers(min_value=0, max_value=2**40)


@given(trials, seeds, st.floats(min_value=1.0, max_value=6.0))
def test_every_trial_occurs_once_in_blocks_within_the_walking_limit(
    planned: set[PlannedTrial], seed: int, factor: float
) -> None:
    limit_m = factor * order.walk_m(order.shortest(sorted(planned, key=str)))
    shuffled = order.shuffle(list(planned), seed=seed, limit_m=limit_m)
    assert Counter(shuffled) == Counter(planned)
    assert order.walk_m(shuffled) <= limit_m + 1e-5
    for depth in (1, 2, 3):
        blocks = [
            block
            for block, _ in groupby(
                (planned_trial.topology, planned_trial.scenario, planned_trial.distance)[:depth]
                for planned_trial in shuffled
            )
        ]
        assert len(blocks) == len(set(blocks)), "each block is contiguous"


@given(trials, seeds)
def test_equal_seeds_give_equal_orders_for_any_input_order(planned: set[PlannedTrial], seed: int) -> None:
    sorted_trials = sorted(planned, key=str)
    orders = {
        order.shuffle(input_order, seed=seed, limit_m=1e9)
        for input_order in (sorted_trials, tuple(reversed(sorted_trials)))
    }
    assert len(orders) == 1


def has_contiguous_blocks(planned_order: tuple[PlannedTrial, ...]) -> bool:
    runs = [[key for key, _ in groupby(map(name, planned_order))] for name in (lambda t: t.topology, scenario_of)]
    return all(len(run) == len(set(run)) for run in runs)


def scenario_of(planned_trial: PlannedTrial) -> tuple[Topology, Scenario]:
    return planned_trial.topology, planned_trial.scenario


@settings(max_examples=40)
@given(
    st.sets(
        st.builds(trial, st.sampled_from([5, 10, 30, 55]), st.sampled_from(Scenario), st.just(Topology.MASTER)),
        min_size=1,
        max_size=6,
    )
)
def test_no_order_in_blocks_is_shorter_than_the_shortest(planned: set[PlannedTrial]) -> None:
    block_orders = (trial_order for trial_order in permutations(planned) if has_contiguous_blocks(trial_order))
    assert order.walk_m(order.shortest(list(planned))) == pytest.approx(min(map(order.walk_m, block_orders)))


def test_the_walk_counts_every_carried_robot() -> None:
    los, master, masterless = Scenario.LOS, Topology.MASTER, Topology.MASTERLESS
    outward_and_back = [trial(10, los, master), trial(30, los, master), trial(20, los, master)]
    assert order.walk_m(outward_and_back) == pytest.approx(2 * (10 + 20 + 10) * 0.3048), "two stations are carried"
    assert order.walk_m([trial(10, los, masterless), trial(30, los, masterless)]) == pytest.approx(30 * 0.3048)
    assert order.walk_m([trial(30, los, master), trial(30, los, masterless)]) == pytest.approx((60 + 30) * 0.3048)
    assert order.walk_m([trial(9, los, master, procedure) for procedure in ("a", "b")]) == pytest.approx(
        18 * 0.3048
    ), "the stations are carried one way"


def first_trials(factor: float) -> Iterator[PlannedTrial]:
    planned = [
        trial(feet, scenario, topology) for feet in (10, 20, 30, 40) for scenario in Scenario for topology in Topology
    ]
    limit_m = factor * order.walk_m(order.shortest(planned))
    return (order.shuffle(planned, seed=seed, limit_m=limit_m)[0] for seed in range(320))


def test_without_a_limit_each_of_16_trials_is_first_equally_often() -> None:
    counts = Counter(first_trials(100.0))
    assert len(counts) == 16
    # The expected count is 20; a binomial count of 320 with p = 1/16 is outside 5..40 in 1 of 10,000 cases.
    assert all(5 <= count <= 40 for count in counts.values()), counts


def test_each_trial_is_first_for_some_seed_within_the_default_limit() -> None:
    distinct_first_trials: set[PlannedTrial] = set()
    assert any(
        len(distinct_first_trials := {*distinct_first_trials, first}) == 16
        for first in first_trials(order.DEFAULT_WALK)
    )


def test_the_shortest_walk_allows_only_sweeps() -> None:
    planned = [trial(feet, Scenario.LOS, Topology.MASTERLESS) for feet in (10, 20, 30, 40)]
    shuffled = order.shuffle(planned, seed=3, limit_m=order.walk_m(order.shortest(planned)))
    assert shuffled == order.shortest(planned)
