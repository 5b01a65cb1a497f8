"""The tables of the paper, and the agreement with them."""

import math
from dataclasses import replace
from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.executors import Workers
from fieldkit.core.model import Scenario as Sight
from fieldkit.core.model import Topology
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.studies.intervals import IntervalEstimate
from sim_backends.cosim.studies.paper_setups import (
    UNDER_WAY,
    FlowSample,
    flow_samples,
    master_based,
    masterless,
    mesh,
    only_flow,
)
from sim_backends.cosim.studies.paper_tables import DISTANCES_M, TABLES, Agreement, Printed, compare, paper_table

NAN = math.nan


@pytest.mark.parametrize(
    ("printed_value", "estimate", "expected"),
    [
        # The mean rounds to the printed number, with any interval.
        (Printed("0.4"), IntervalEstimate(0.36, 0.355, 0.365), Agreement.AGREES),
        (Printed("0.4"), IntervalEstimate(0.36, NAN, NAN), Agreement.AGREES),
        # The interval contains the printed number, although the mean rounds to another one.
        (Printed("0.4"), IntervalEstimate(0.9, 0.44, 1.36), Agreement.AGREES),
        (Printed("0.4"), IntervalEstimate(0.9, 0.46, 1.34), Agreement.ABOVE),
        (Printed("0.4"), IntervalEstimate(0.3, 0.25, 0.34), Agreement.BELOW),
        (Printed("0.40"), IntervalEstimate(0.36, 0.355, 0.365), Agreement.BELOW),
        # An interval within the numbers that round to the printed one, and one around them.
        (Printed("10", step="10"), IntervalEstimate(7.0, 6.9, 7.1), Agreement.AGREES),
        (Printed("10"), IntervalEstimate(7.0, 6.9, 7.1), Agreement.BELOW),
        (Printed("10"), IntervalEstimate(30.0, -20.0, 80.0), Agreement.AGREES),
        # In percent, and in milliseconds.
        (Printed("10", per_si=100, step="10"), IntervalEstimate(0.16, 0.151, 0.169), Agreement.ABOVE),
        (Printed("5.377", per_si=1000), IntervalEstimate(0.0053774, NAN, NAN), Agreement.AGREES),
        (Printed("5.377", per_si=1000), IntervalEstimate(0.0053776, NAN, NAN), Agreement.ABOVE),
        (Printed("-12", per_si=100), IntervalEstimate(-0.20, -0.25, -0.15), Agreement.BELOW),
        (Printed("0.4"), IntervalEstimate(NAN, NAN, NAN), Agreement.NO_VALUE),
    ],
)
def test_agreements_equal_those_determined_by_hand(
    printed_value: Printed, estimate: IntervalEstimate, expected: Agreement
) -> None:
    assert compare(printed_value, estimate) is expected


@given(
    st.decimals(-1000, 1000, places=6),
    st.integers(0, 4),
    st.sampled_from([1, 100, 1000]),
)
def test_a_rounded_number_agrees_with_its_original(value: Decimal, places: int, per_si: int) -> None:
    text = str(value.quantize(Decimal(1).scaleb(-places), ROUND_HALF_UP))
    estimate = float(value / per_si)
    assert compare(Printed(text, per_si), IntervalEstimate(estimate, NAN, NAN)) is Agreement.AGREES


@given(
    st.decimals(-1000, 1000, places=3),
    st.sampled_from(["0.1", "1", "10"]),
    st.floats(0.5001, 100),
    st.booleans(),
)
def test_a_number_more_than_half_a_step_away_disagrees(
    number: Decimal, step: str, deviation: float, is_above: bool
) -> None:
    printed_value = Printed(str(number), step=step)
    estimate = printed_value.value + deviation * float(step) * (1 if is_above else -1)
    expected = Agreement.ABOVE if is_above else Agreement.BELOW
    assert compare(printed_value, IntervalEstimate(estimate, NAN, NAN)) is expected
    bounds = printed_value.value, estimate
    assert compare(printed_value, IntervalEstimate(estimate, min(bounds), max(bounds))) is Agreement.AGREES


SHORT = {"duration": "1200ms"}


def test_every_row_has_its_distance_and_line() -> None:
    for table, agents in (("1", ("husky-1", "husky-2")), ("2", ("husky-1", "iris")), ("3", ("husky-1", "husky-2"))):
        study = paper_table(table, {})
        assert len(study.setups) == len(study.sources) == (20 if table == "3" else 10)
        for source in study.sources:
            setup = study.setups[source.setup]
            scenario = setup.scenario
            assert scenario.line == source.labels["line"]
            assert [scenario.agents[name].along for name in agents] == [0, source.labels["distance_m"]]
            assert setup.policy == ("sliding_window" if table == "3" else "velocity_aware")
            assert scenario.topology is (Topology.MASTER if table == "3" else Topology.MASTERLESS)
            (traffic,) = scenario.traffic
            assert {traffic.source, *traffic.to} == set(agents)
            assert traffic.protocol == {"tcp": "ros1", "udp": "ros1-udp"}.get(str(source.labels["protocol"]), "topic")


def test_windows_change_by_the_amounts_that_the_paper_states() -> None:
    """By 0.1 ms between ground robots and by 0.3 ms for the drone, when they have reached their speeds."""
    for flying, window_ms in ((False, 1.1), (True, 1.3)):
        run = build(
            masterless(Sight.LOS, 40, {"duration": "2s"}, flying=flying).scenario, policy="velocity_aware"
        ).run()
        assert np.diff(run.windows_ns)[-100:-1].mean() / 1e6 == pytest.approx(window_ms, abs=0.01)


def test_samples_count_the_packets_of_a_run() -> None:
    setup = masterless(Sight.LOS, 20, SHORT)
    flow = only_flow(setup)
    run = build(setup.scenario, policy=setup.policy, seed=2).run()
    fates = [fate for (name, _), fate in run.fates.items() if name == flow]
    delays_s = [(fate.counted_ns - fate.packet.sent_ns) / 1e9 for fate in fates if fate.counted_ns is not None]
    samples = flow_samples({"here": setup}, [7, 2], workers=Workers(1))
    sample = samples["here"][1][flow]
    assert (sample.sent_packets, sample.arrived_packets) == (len(fates), len(delays_s))
    assert sample.sent_packets > 30
    assert sample.delay_sum_s == pytest.approx(sum(delays_s))
    assert sample.arrived_packets + sum(sample.reasons.values()) == sample.sent_packets
    assert samples["here"][0] != samples["here"][1], "the seeds differ"


def test_out_of_range_no_packet_arrives_and_there_is_no_delay() -> None:
    setups = {"far": master_based(Sight.NLOS, 100, "ros1", SHORT)}
    (samples_by_flow,) = flow_samples(setups, [1], workers=Workers(1))["far"]
    (sample,) = samples_by_flow.values()
    assert sample.arrived_packets == 0
    assert sample.loss == 1
    assert math.isnan(sample.delay_sum_s)
    assert math.isnan(sample.delay_mean_s)
    assert sum(sample.reasons.values()) == sample.sent_packets > 30


def test_the_delays_of_pings_are_round_trips() -> None:
    setups = {"mesh": mesh({"radio": {"rate": "1Mbit/s"}}, {"duration": "2s"})}
    (samples_by_flow,) = flow_samples(setups, [1], workers=Workers(1))["mesh"]
    sample = samples_by_flow["before/node-10"]
    assert sample.arrived_packets == sample.sent_packets == 15, "ten per second from 0.5 s on"
    # Payload, headers of UDP and IP at 1 Mbit/s, and 0.2 ms in addition, in both directions.
    assert sample.delay_mean_s == pytest.approx(2 * (8 * (56 + 8 + 20) / 1e6 + 0.0002))


def test_a_row_has_the_mean_over_seeds_and_the_printed_number() -> None:
    study = paper_table("1", SHORT)
    flow = only_flow(study.setups["los 40 m topic"])
    partial_sample = FlowSample(500, 490, 0.1, {"pushed out": 6, UNDER_WAY: 4})
    empty_sample = FlowSample(500, 0, math.nan, {"not matched yet": 500})
    seeds = [partial_sample, replace(partial_sample, delay_sum_s=0.3), empty_sample]
    samples = {name: [{only_flow(setup): sample} for sample in seeds] for name, setup in study.setups.items()}
    row = study.rows(samples)[1]
    assert row.labels == {"line": "los", "distance_m": 40, "protocol": "topic"}
    assert row.delay.seeds == 2
    assert row.delay.measured.value == pytest.approx(0.2), "of the seeds with arrivals"
    # Student's t with one degree of freedom is 12.706, and the standard error is 0.1 s; a delay is at least 0.
    assert row.delay.measured.low == 0
    assert row.delay.measured.high == pytest.approx(0.2 + 12.706 * 0.1, rel=1e-4)
    assert row.delay.agreement is Agreement.AGREES
    assert not row.delay.agrees_by_mean
    assert row.delay.difference == pytest.approx(0.1)
    assert row.loss.measured.value == pytest.approx((0.02 + 0.02 + 1) / 3)
    assert row.loss.measured.high == 1, "Student's interval would end at 1.75"
    assert row.reason == "not matched yet"
    assert flow == study.sources[1].flow


@pytest.mark.parametrize("table", TABLES)
def test_changes_apply_to_every_row(table: str) -> None:
    setups = paper_table(table, {"radio.exponent": 2.5, "duration": "3s"}).setups
    assert {(setup.scenario.radio.exponent, setup.scenario.duration) for setup in setups.values()} == {(2.5, 3.0)}


def test_changes_have_priority_over_the_values_of_a_row() -> None:
    scenario = masterless(Sight.LOS, 20, {"agents.husky-2.along": "33m"}).scenario
    assert scenario.agents["husky-2"].along == 33


def test_all_tables_have_the_same_distances() -> None:
    assert DISTANCES_M == (20, 40, 60, 80, 100)
