"""Results of flows compared with a run computed by hand, and their jitter with that of the harness."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fieldkit.measure.transfers.delay import jitter_s
from sim_backends.cosim.commands.results import flow_results
from sim_backends.cosim.run_record import Fate, Run
from sim_backends.network.packets import Packet
from sim_backends.world.motion import State

MS = 1_000_000


def fate(number: int, delay_ms: float | None, *, is_decided: bool = True, policy_delay_ms: float = 2.0) -> Fate:
    """Return the fate of one packet of a flow with a packet every 10 ms.

    The sender starts 4 m away and drives east at 3 m/s. The policy delays the packet by `policy_delay_ms` before it
    enters the network, and by 5 ms after its arrival.
    """
    sent_ns = number * 10 * MS
    enters_ns = sent_ns + round(policy_delay_ms * MS)
    packet = Packet(number, "a", "b", 100, ("flow", number), sent_ns, enters_ns, "udp")
    end_states = State((4.0 + 0.03 * number, 0.0, 0.0), (3.0, 0.0, 0.0)), State((0.0, 0.0, 0.0), (0.0, 4.0, 0.0))
    if delay_ms is None:
        return Fate(packet, end_states, end_states, reason="lost" if is_decided else "")
    arrived_ns = enters_ns + round(delay_ms * MS)
    return Fate(packet, end_states, end_states, arrived_ns, arrived_ns + 5 * MS)


def run_with(*fates: Fate) -> Run:
    return Run(fates={fate.packet.identity: fate for fate in fates})


def test_the_result_of_a_flow_follows_from_its_packets() -> None:
    (flow,) = flow_results(
        run_with(fate(0, 1.0), fate(1, 3.0), fate(2, None), fate(3, 2.0), fate(4, None, is_decided=False))
    )
    assert (flow.sent_packets, flow.arrived_packets, flow.packets_under_way, flow.sent_bytes, flow.arrived_bytes) == (
        4,
        3,
        1,
        400,
        300,
    )
    assert flow.loss == pytest.approx(0.25)
    delay_s = flow.delay_s
    assert (delay_s.minimum, delay_s.median, delay_s.mean, delay_s.maximum) == pytest.approx(
        (0.001, 0.002, 0.002, 0.003)
    )
    assert flow.added_s == pytest.approx(0.007), "2 ms before the network, 5 ms after it"
    assert flow.first_to_last_s == pytest.approx(0.031)
    assert flow.distances_m == pytest.approx((4.0, 4.0, 4.06, 4.12))
    assert (flow.sender_m_s, flow.relative_m_s) == pytest.approx((3.0, 5.0))


def test_jitter_equals_that_of_the_harness_in_the_order_of_arrival() -> None:
    delays_ms = [1.0, 14.0, 2.0, 1.5, 30.0, 0.5]
    (flow,) = flow_results(run_with(*(fate(number, delay_ms) for number, delay_ms in enumerate(delays_ms))))
    arrival_order = np.argsort([10 * number + delay_ms for number, delay_ms in enumerate(delays_ms)])
    assert flow.jitter_s == pytest.approx(jitter_s(np.rint(np.array(delays_ms)[arrival_order] * MS).astype(np.int64)))


def test_values_without_arrivals_are_nan() -> None:
    end_states = fate(0, None).true_states
    under_way = Fate(Packet(9, "a", "b", 1, ("waiting", 0), 0, 0, "tcp"), end_states, end_states)
    lost_flow, waiting_flow = flow_results(run_with(fate(0, None), under_way))
    assert (lost_flow.loss, lost_flow.arrived_bytes) == (1.0, 0)
    assert math.isnan(waiting_flow.loss)
    for flow in (lost_flow, waiting_flow):
        assert all(
            math.isnan(value) for value in (flow.delay_s.mean, flow.jitter_s, flow.added_s, flow.first_to_last_s)
        )


def test_a_round_trip_excludes_the_delays_of_the_policy_and_counts_only_decided_packets() -> None:
    """One request and one reply are lost, and one reply is under way; the policy's 2 ms and 5 ms do not count."""

    def as_reply(request: Fate) -> Fate:
        packet = request.packet
        identity = ("flow/reply", packet.identity[1])
        return replace(request, packet=packet._replace(source="b", destination="a", identity=identity))

    requests = [fate(0, 1.0), fate(1, 2.0), fate(2, None), fate(3, 1.0), fate(4, 1.0)]
    replies = [fate(0, 3.0), fate(1, 5.0), fate(3, None), fate(4, None, is_decided=False)]
    flow, reply_flow = flow_results(run_with(*requests, *map(as_reply, replies)))
    trips = flow.round_trips
    assert trips is not None
    assert (trips.request_count, trips.reply_count) == (4, 2)
    spread_s = trips.network_s
    assert (spread_s.minimum, spread_s.mean, spread_s.maximum) == pytest.approx((0.004, 0.0055, 0.007))
    assert trips.jitter_s == pytest.approx(0.003)
    assert reply_flow.round_trips is None


def test_flows_are_sorted_by_name_and_immutable() -> None:
    assert [flow.name for flow in flow_results(Run())] == []
    with pytest.raises(AttributeError):
        flow_results(run_with(fate(0, 1.0)))[0].sent_packets = 3  # type: ignore[misc]
