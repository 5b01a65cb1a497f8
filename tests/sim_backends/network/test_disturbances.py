"""Node loss, cut links and jammers, to the nanosecond, compared with results computed by hand."""

import math
from dataclasses import replace

import pytest
import scipy

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss, active, changes_ns
from sim_backends.network.packets import Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.radio.core.links import OUT_OF_RANGE, RADIO_OFF, RETRIES_EXHAUSTED
from sim_backends.radio.mac.frames import HEADER_BYTES
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.modes import CHANNEL_6_HZ, DIFS_NS, ENERGY_DETECTION_DBM, G_MODES, SLOT_NS
from sim_backends.world.materials import SPEED_OF_LIGHT_M_S
from tests.helpers.radio_networks import (
    ANTENNA,
    IN_THE_OPEN,
    MS,
    Outcome,
    carry,
    fixed,
    network,
    packets,
    standing,
    wifi,
)

AT_ORIGIN = standing(dict.fromkeys("abc", (0.0, 0.0, 1.0)))
G6 = G_MODES[0]
FRAME_NS = G6.airtime_ns(1000 + 28 + HEADER_BYTES)


def run_each_ms(sent_packets: list[Packet], *disturbances: Disturbance) -> Outcome:
    return carry(network(fixed(delay="5ms"), "abc", disturbances=disturbances), AT_ORIGIN, sent_packets)


EACH_MS = packets([(number * MS, "a", "b", 100) for number in range(40)])


def test_a_node_that_is_off_receives_nothing_from_start_to_end() -> None:
    """A packet that arrives at 10 ms is delivered before the loss starts; one at 20 ms is lost before it ends."""
    result = run_each_ms(EACH_MS, NodeLoss("b", 10 * MS, 20 * MS))
    assert result.dropped == {
        ("a to b", number): RADIO_OFF if number < 10 else OUT_OF_RANGE for number in range(6, 20)
    }
    assert set(result.arrived) == {("a to b", number) for number in (*range(6), *range(20, 40))}


def test_a_node_that_is_off_sends_nothing_and_packets_in_flight_arrive() -> None:
    result = run_each_ms(EACH_MS, NodeLoss("a", 10 * MS, 20 * MS), NodeLoss("c", 0))
    assert result.dropped == {("a to b", number): RADIO_OFF for number in range(10, 20)}


def test_a_cut_link_carries_nothing_in_either_direction_and_other_links_continue() -> None:
    messages = [
        (number * MS, *endpoints, 100) for number in range(40) for endpoints in (("a", "b"), ("b", "a"), ("a", "c"))
    ]
    result = run_each_ms(packets(messages), LinkCut("b", "a", 10 * MS, 20 * MS))
    assert result.dropped == {
        (flow, number): OUT_OF_RANGE for flow in ("a to b", "b to a") for number in range(10, 20)
    }


def test_a_partly_received_datagram_is_lost_if_its_host_is_switched_off() -> None:
    # Four fragments of 1 ms each; the host is off briefly between the second and the third.
    net = network(fixed(rate="12Mbit/s"), "ab", disturbances=[NodeLoss("b", 2 * MS + 1, 2 * MS + 2)])
    result = carry(net, AT_ORIGIN, packets([(0, "a", "b", 5000), (50 * MS, "a", "b", 5000)]))
    assert result.dropped == {("a to b", 0): RADIO_OFF}
    assert set(result.arrived) == {("a to b", 1)}


def test_the_queue_of_a_wifi_station_that_is_switched_off_is_lost() -> None:
    sent_packets = packets([(0, "a", "b", 1000)] * 10)
    net = network(wifi("ab"), "ab", disturbances=[NodeLoss("a", 5 * MS, 6 * MS)])
    states = standing({"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0)})
    result = carry(net, states, sent_packets)
    # Each packet takes 1.46 ms, an ACK, and a backoff of at most 135 us.
    assert sorted(number for _, number in result.arrived) == [0, 1, 2]
    assert result.dropped == {("a to b", number): RADIO_OFF for number in range(3, 10)}


def test_a_frame_to_a_node_that_is_switched_off_during_it_is_retried_until_the_limit() -> None:
    net = network(wifi("ab"), "ab", disturbances=[NodeLoss("b", FRAME_NS // 2)])
    states = standing({"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0)})
    result = carry(net, states, packets([(0, "a", "b", 1000), (MS * 100, "a", "b", 1000)]))
    assert result.dropped == {("a to b", 0): RETRIES_EXHAUSTED, ("a to b", 1): OUT_OF_RANGE}


def path_loss_db(metres: float) -> float:
    """Return the log-distance loss with exponent 3, from free space at 1 m."""
    return 20 * math.log10(4 * math.pi * CHANNEL_6_HZ / SPEED_OF_LIGHT_M_S) + 30 * math.log10(metres)


def run_jammed(sent_packets: list[Packet], *jammers: Jammer) -> Outcome:
    """Send packets from a station at 0 m to one at 20 m."""
    net = network(wifi("ab", seed=2), "ab", disturbances=jammers)
    return carry(net, standing({"a": (0.0, 0.0, 1.0), "b": (20.0, 0.0, 1.0)}), sent_packets)


def count_first_attempts(result: Outcome) -> int:
    """Return the number of packets, sent every 100 ms, that took no longer than one attempt."""
    return sum(at_ns - number * 100 * MS < 3 * MS for (_, number), at_ns in result.arrived.items())


def test_the_noise_of_a_jammer_follows_from_the_path_loss() -> None:
    """Each of seven attempts is lost with the packet error p of the SNR, so p^7 of the packets are lost."""
    ratio_db, n, size_bytes = 3.98, 150, 1400
    signal_dbm = ANTENNA.tx_power_dbm - path_loss_db(20)
    noise_mw = 10 ** ((signal_dbm - ratio_db) / 10) - 10 ** (IN_THE_OPEN.noise_floor_dbm / 10)
    jammer = Jammer(10 * math.log10(noise_mw) + path_loss_db(100), 0, position_m=(120.0, 0.0, 1.0))
    sent_packets = packets([(number * 100 * MS, "a", "b", size_bytes) for number in range(n)])
    # Below 4 dB no preamble is detected; above, bits have the error rate of their SNR.
    assert run_jammed(sent_packets, jammer).dropped == {packet.identity: RETRIES_EXHAUSTED for packet in sent_packets}
    weaker_jammer = Jammer(jammer.power_dbm - 0.1, 0, position_m=(120.0, 0.0, 1.0))
    result = run_jammed(sent_packets, weaker_jammer)
    attempt_error = packet_error(G6, ratio_db + 0.1, size_bytes + 28 + HEADER_BYTES)
    assert 0.05 < attempt_error < 0.7
    interval = scipy.stats.binomtest(len(result.dropped), n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= attempt_error**7 <= interval.high
    interval = scipy.stats.binomtest(count_first_attempts(result), n).proportion_ci(
        confidence_level=0.99, method="wilson"
    )
    assert interval.low <= 1 - attempt_error <= interval.high
    # If the noise ends in the middle of each frame, half of the bits have the SNR without noise.
    half_ns = G6.airtime_ns(size_bytes + 28 + HEADER_BYTES) // 2
    half_frame_jammers = [
        replace(weaker_jammer, begin_ns=packet.sent_ns - MS, end_ns=packet.sent_ns + half_ns)
        for packet in sent_packets[1:]
    ]
    interval = scipy.stats.binomtest(
        count_first_attempts(run_jammed(sent_packets[1:], *half_frame_jammers)), n - 1
    ).proportion_ci(0.99, method="wilson")
    assert interval.low <= (1 - attempt_error) ** 0.5 <= interval.high


@pytest.mark.parametrize(
    ("begin_ns", "end_ns", "is_corrupted"),
    [
        (0, 20_000, True),
        (FRAME_NS // 2, FRAME_NS // 2 + 8_000, True),
        (FRAME_NS - 12_000, FRAME_NS, True),
        (FRAME_NS + 10, FRAME_NS + 1000, False),
    ],
)
def test_noise_corrupts_only_overlapping_frames(begin_ns: int, end_ns: int, is_corrupted: bool) -> None:
    """The noise is far stronger at the receiver than the frame, but too weak to prevent the sender from sending."""
    power_at_receiver_dbm = ANTENNA.tx_power_dbm - path_loss_db(20) + 20
    jammer = Jammer(power_at_receiver_dbm + path_loss_db(2), begin_ns, end_ns, position_m=(22.0, 0.0, 1.0))
    assert jammer.power_dbm - path_loss_db(22) < ENERGY_DETECTION_DBM
    (at_ns,) = run_jammed(packets([(0, "a", "b", 1000)]), jammer).arrived.values()
    propagation_ns = round(20 / SPEED_OF_LIGHT_M_S * 1e9)
    assert (at_ns > FRAME_NS + propagation_ns) is is_corrupted


@pytest.mark.parametrize(("excess_db", "is_delayed"), [(0.1, True), (-0.1, False)])
def test_energy_above_the_threshold_prevents_sending_until_it_ends(excess_db: float, is_delayed: bool) -> None:
    """The jammer is near the sender and far from the receiver, which receives the frame much more strongly."""
    end_ns = 33_333_333
    jammer = Jammer(ENERGY_DETECTION_DBM + excess_db + path_loss_db(1), 0, end_ns, position_m=(-1.0, 0.0, 1.0))
    (at_ns,) = run_jammed(packets([(5 * MS, "a", "b", 1000)]), jammer).arrived.values()
    frame_ns = FRAME_NS + round(20 / SPEED_OF_LIGHT_M_S * 1e9)
    if is_delayed:
        assert end_ns + DIFS_NS <= at_ns - frame_ns <= end_ns + DIFS_NS + 15 * SLOT_NS
    else:
        assert at_ns == 5 * MS + frame_ns


def count_arrivals(net: RadioNetwork, distance_m: float, sent_packets: list[Packet], to_ns: int) -> int:
    """Return the number of arrivals until `to_ns` if the jammer is at this distance from the sender."""
    states = standing({"a": (0.0, 0.0, 1.0), "b": (20.0, 0.0, 1.0), "j": (-distance_m, 0.0, 1.0)})
    return len(net.advance(to_ns, sent_packets, states)[0])


def test_a_carried_jammer_has_the_position_of_its_agent() -> None:
    power_dbm = ENERGY_DETECTION_DBM + path_loss_db(10)
    net = RadioNetwork(wifi("ab"), "ab", disturbances=[Jammer(power_dbm, MS, agent="j")])
    sent_packets = packets([(number * 100 * MS + 2 * MS, "a", "b", 1000) for number in range(3)])
    assert count_arrivals(net, 10.1, sent_packets[:1], 100 * MS) == 1
    assert count_arrivals(net, 9.9, sent_packets[1:2], 200 * MS) == 0
    assert count_arrivals(net, 10.1, sent_packets[2:], 300 * MS) == 2


def test_fixed_links_reject_a_jammer() -> None:
    net = network(fixed(), "ab", disturbances=[Jammer(20.0, 0, position_m=(0.0, 0.0, 0.0))])
    with pytest.raises(ConfigurationError, match="do not support jammers") as error_info:
        carry(net, AT_ORIGIN, [])
    assert error_info.value.remedy


def test_a_jammer_has_either_a_position_or_an_agent() -> None:
    for place_m, agent in ((None, ""), ((0.0, 0.0, 0.0), "a")):
        with pytest.raises(ValueError, match="either a position or an agent"):
            Jammer(20.0, 0, 1, place_m, agent)


def test_active_disturbances_have_started_and_not_ended() -> None:
    node_loss, link_cut = NodeLoss("a", 5, 10), LinkCut("a", "b", 10)
    assert [active([node_loss, link_cut], now_ns) for now_ns in (4, 5, 9, 10, 99)] == [
        [],
        [node_loss],
        [node_loss],
        [link_cut],
        [link_cut],
    ]
    assert changes_ns([node_loss, link_cut]) == [5, 10]
