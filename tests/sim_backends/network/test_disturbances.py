"""Node loss, cut links and jammers, to the nanosecond, against what can be worked out on paper."""

import math
from dataclasses import replace

import pytest
from scipy.stats import binomtest

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss, active, changes_ns
from sim_backends.network.packets import Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.radio.frames import HEADER_BYTES
from sim_backends.radio.losses import OUT_OF_RANGE, RADIO_OFF, RETRIES_EXHAUSTED
from sim_backends.radio.modes import DIFS_NS, ENERGY_DETECTION_DBM, G_MODES, SLOT_NS
from sim_backends.radio.packet_error import packet_error
from sim_backends.radio.world_channel import CHANNEL_6_HZ
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

HERE = standing(dict.fromkeys("abc", (0.0, 0.0, 1.0)))
G6 = G_MODES[0]
FRAME_NS = G6.airtime_ns(1000 + 28 + HEADER_BYTES)


def each_ms(sent: list[Packet], *disturbances: Disturbance) -> Outcome:
    return carry(network(fixed(delay="5ms"), "abc", disturbances=disturbances), HERE, sent)


EACH_MS = packets([(number * MS, "a", "b", 100) for number in range(40)])


def test_who_is_lost_gets_nothing_from_the_begin_to_the_end() -> None:
    """What arrives at 10 ms itself still does, before the loss begins; at 20 ms it ends too late for what arrives."""
    found = each_ms(EACH_MS, NodeLoss("b", 10 * MS, 20 * MS))
    assert found.dropped == {
        ("a to b", number): RADIO_OFF if number < 10 else OUT_OF_RANGE for number in range(6, 20)
    }
    assert set(found.arrived) == {("a to b", number) for number in (*range(6), *range(20, 40))}


def test_who_is_lost_sends_nothing_and_what_it_sent_before_arrives() -> None:
    found = each_ms(EACH_MS, NodeLoss("a", 10 * MS, 20 * MS), NodeLoss("c", 0))
    assert found.dropped == {("a to b", number): RADIO_OFF for number in range(10, 20)}


def test_a_cut_link_carries_nothing_either_way_and_others_go_on() -> None:
    sends = [(number * MS, *ends, 100) for number in range(40) for ends in (("a", "b"), ("b", "a"), ("a", "c"))]
    found = each_ms(packets(sends), LinkCut("b", "a", 10 * MS, 20 * MS))
    assert found.dropped == {
        (flow, number): OUT_OF_RANGE for flow in ("a to b", "b to a") for number in range(10, 20)
    }


def test_a_datagram_of_which_a_part_was_there_is_lost_with_its_host() -> None:
    # Four fragments of 1 ms each; the host is away for a moment between the second and the third.
    net = network(fixed(rate="12Mbit/s"), "ab", disturbances=[NodeLoss("b", 2 * MS + 1, 2 * MS + 2)])
    found = carry(net, HERE, packets([(0, "a", "b", 5000), (50 * MS, "a", "b", 5000)]))
    assert found.dropped == {("a to b", 0): RADIO_OFF}
    assert set(found.arrived) == {("a to b", 1)}


def test_a_queue_is_lost_with_its_station_on_wifi() -> None:
    sent = packets([(0, "a", "b", 1000)] * 10)
    net = network(wifi("ab"), "ab", disturbances=[NodeLoss("a", 5 * MS, 6 * MS)])
    states = standing({"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0)})
    found = carry(net, states, sent)
    # Each takes 1.46 ms, an ACK, and a backoff of at most 135 us.
    assert sorted(number for _, number in found.arrived) == [0, 1, 2]
    assert found.dropped == {("a to b", number): RADIO_OFF for number in range(3, 10)}


def test_a_frame_to_who_was_lost_meanwhile_is_tried_until_retries_run_out() -> None:
    net = network(wifi("ab"), "ab", disturbances=[NodeLoss("b", FRAME_NS // 2)])
    states = standing({"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0)})
    found = carry(net, states, packets([(0, "a", "b", 1000), (MS * 100, "a", "b", 1000)]))
    assert found.dropped == {("a to b", 0): RETRIES_EXHAUSTED, ("a to b", 1): OUT_OF_RANGE}


def loss_db(metres: float) -> float:
    """Log distance with exponent 3, from free space at 1 m."""
    return 20 * math.log10(4 * math.pi * CHANNEL_6_HZ / SPEED_OF_LIGHT_M_S) + 30 * math.log10(metres)


def jammed(sent: list[Packet], *jammers: Jammer) -> Outcome:
    """The sender is at 0 m, the receiver at 20 m."""
    net = network(wifi("ab", seed=2), "ab", disturbances=jammers)
    return carry(net, standing({"a": (0.0, 0.0, 1.0), "b": (20.0, 0.0, 1.0)}), sent)


def first_tries(found: Outcome) -> int:
    """Return how many of packets sent every 100 ms took no longer than one attempt does."""
    return sum(at_ns - number * 100 * MS < 3 * MS for (_, number), at_ns in found.arrived.items())


def test_a_jammer_is_noise_by_the_path_loss_to_the_receiver() -> None:
    """Of seven attempts at a frame each is lost with the packet error of the ratio: p^7 are lost in the end."""
    ratio_db, n, size_bytes = 3.98, 300, 1400
    signal_dbm = ANTENNA.tx_power_dbm - loss_db(20)
    noise_mw = 10 ** ((signal_dbm - ratio_db) / 10) - 10 ** (IN_THE_OPEN.noise_floor_dbm / 10)
    jammer = Jammer(10 * math.log10(noise_mw) + loss_db(100), 0, place_m=(120.0, 0.0, 1.0))
    sent = packets([(number * 100 * MS, "a", "b", size_bytes) for number in range(n)])
    # Below 4 dB no preamble is found; above, bits fail by their own ratio.
    assert jammed(sent, jammer).dropped == {packet.identity: RETRIES_EXHAUSTED for packet in sent}
    weaker = Jammer(jammer.power_dbm - 0.1, 0, place_m=(120.0, 0.0, 1.0))
    found = jammed(sent, weaker)
    error = packet_error(G6, ratio_db + 0.1, size_bytes + 28 + HEADER_BYTES)
    assert 0.05 < error < 0.7
    interval = binomtest(len(found.dropped), n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= error**7 <= interval.high
    interval = binomtest(first_tries(found), n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 1 - error <= interval.high
    # Where it ends in the middle of each frame, half of the bits are as good as without it.
    half_ns = G6.airtime_ns(size_bytes + 28 + HEADER_BYTES) // 2
    halves = [replace(weaker, begin_ns=packet.sent_ns - MS, end_ns=packet.sent_ns + half_ns) for packet in sent[1:]]
    interval = binomtest(first_tries(jammed(sent[1:], *halves)), n - 1).proportion_ci(0.99, method="wilson")
    assert interval.low <= (1 - error) ** 0.5 <= interval.high


@pytest.mark.parametrize(
    ("begin_ns", "end_ns", "spoilt"),
    [
        (0, 20_000, True),
        (FRAME_NS // 2, FRAME_NS // 2 + 8_000, True),
        (FRAME_NS - 12_000, FRAME_NS, True),
        (FRAME_NS + 10, FRAME_NS + 1000, False),
    ],
)
def test_noise_spoils_the_frame_that_it_meets_and_no_other(begin_ns: int, end_ns: int, spoilt: bool) -> None:
    """Far stronger at the receiver than the frame is, too weak to keep the sender from sending."""
    at_receiver_dbm = ANTENNA.tx_power_dbm - loss_db(20) + 20
    jammer = Jammer(at_receiver_dbm + loss_db(2), begin_ns, end_ns, place_m=(22.0, 0.0, 1.0))
    assert jammer.power_dbm - loss_db(22) < ENERGY_DETECTION_DBM
    (at_ns,) = jammed(packets([(0, "a", "b", 1000)]), jammer).arrived.values()
    wave_ns = round(20 / SPEED_OF_LIGHT_M_S * 1e9)
    assert (at_ns > FRAME_NS + wave_ns) is spoilt


@pytest.mark.parametrize(("excess_db", "waits"), [(0.1, True), (-0.1, False)])
def test_energy_above_the_threshold_keeps_a_station_silent_until_it_ends(excess_db: float, waits: bool) -> None:
    """The jammer is near the sender and far from the receiver, which hears both, the frame much better."""
    end_ns = 33_333_333
    jammer = Jammer(ENERGY_DETECTION_DBM + excess_db + loss_db(1), 0, end_ns, place_m=(-1.0, 0.0, 1.0))
    (at_ns,) = jammed(packets([(5 * MS, "a", "b", 1000)]), jammer).arrived.values()
    frame_ns = FRAME_NS + round(20 / SPEED_OF_LIGHT_M_S * 1e9)
    if waits:
        assert end_ns + DIFS_NS <= at_ns - frame_ns <= end_ns + DIFS_NS + 15 * SLOT_NS
    else:
        assert at_ns == 5 * MS + frame_ns


def carried(net: RadioNetwork, near_m: float, sent: list[Packet], to_ns: int) -> int:
    """Let the agent that carries the jammer be so far from the sender, until then; return how many arrive."""
    states = standing({"a": (0.0, 0.0, 1.0), "b": (20.0, 0.0, 1.0), "j": (-near_m, 0.0, 1.0)})
    return len(net.advance(to_ns, sent, states)[0])


def test_a_jammer_that_an_agent_carries_is_where_the_agent_is() -> None:
    power_dbm = ENERGY_DETECTION_DBM + loss_db(10)
    net = RadioNetwork(wifi("ab"), "ab", disturbances=[Jammer(power_dbm, MS, agent="j")])
    sent = packets([(number * 100 * MS + 2 * MS, "a", "b", 1000) for number in range(3)])
    assert carried(net, 10.1, sent[:1], 100 * MS) == 1
    assert carried(net, 9.9, sent[1:2], 200 * MS) == 0
    assert carried(net, 10.1, sent[2:], 300 * MS) == 2


def test_fixed_links_refuse_a_jammer() -> None:
    net = network(fixed(), "ab", disturbances=[Jammer(20.0, 0, place_m=(0.0, 0.0, 0.0))])
    with pytest.raises(ConfigurationError, match="hear no jammer") as error:
        carry(net, HERE, [])
    assert error.value.remedy


def test_a_jammer_is_at_a_place_or_with_an_agent() -> None:
    for place_m, agent in ((None, ""), ((0.0, 0.0, 0.0), "a")):
        with pytest.raises(ValueError, match="either a place or an agent"):
            Jammer(20.0, 0, 1, place_m, agent)


def test_what_is_active_has_begun_and_not_ended() -> None:
    one, other = NodeLoss("a", 5, 10), LinkCut("a", "b", 10)
    assert [active([one, other], now_ns) for now_ns in (4, 5, 9, 10, 99)] == [[], [one], [one], [other], [other]]
    assert changes_ns([one, other]) == [5, 10]
