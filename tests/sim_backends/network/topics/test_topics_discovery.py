"""Discovery without a master: matching times compared with CycloneDDS, and samples lost before matching."""

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_backends.network.packets import Packet
from sim_backends.network.topics.discovery import SPDP_BYTES, Announcement, DiscoveryTiming, SharedHeartbeats
from sim_backends.network.topics.flow import TopicSession
from sim_backends.network.topics.qos import MS, SECOND, Qos, TopicFlow
from sim_backends.network.topics.rtps_transport import Topics
from sim_backends.network.wire import IpPacket
from sim_backends.radio.core.random_streams import PacketDraws
from tests.helpers.scripted_wire import Script, ScriptedWire

DELAY_NS = MS // 10


def two_participants(
    script: Script | None = None, *, discovery: DiscoveryTiming | None = None, qos: Qos | None = None
) -> ScriptedWire:
    """Return a wire on which a publishes to b after they have discovered each other."""
    wire = ScriptedWire(DELAY_NS, script=script, hosts=("a", "b"))
    flows = {"scan": TopicFlow("a", "b", qos or Qos())}
    wire.transports["topic"] = Topics(wire, flows, discovery=discovery or DiscoveryTiming())
    return wire


def publish(wire: ScriptedWire, times_ns: Sequence[int]) -> None:
    for number, at_ns in enumerate(times_ns):
        wire.send_at(at_ns, Packet(number, "a", "b", 100, ("scan", number), at_ns, at_ns, "topic"))


def session(wire: ScriptedWire) -> TopicSession:
    topics = wire.transports["topic"]
    assert isinstance(topics, Topics)
    return topics._sessions["scan"]


def run_until_matched(wire: ScriptedWire) -> None:
    topic_session = session(wire)
    while not (topic_session.writer.is_matched and topic_session.reader.is_matched):
        wire.run(wire.next_event_ns())
        assert wire.now_ns < 1000 * SECOND


def lose_during(*spans_ns: tuple[int, int], sources: str = "ab") -> tuple[Script, list[ScriptedWire]]:
    """Return a script that loses packets of these hosts in these spans of time, and a list for its wire."""
    wires: list[ScriptedWire] = []

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        now_ns = wires[0].now_ns
        return () if packet.source in sources and any(begin <= now_ns < end for begin, end in spans_ns) else (0,)

    return script, wires


def test_announcements_follow_the_schedule() -> None:
    """Announcements are multicast at 0, 0.1, 8.1 and 16.1 s; each participant responds to the other four times."""
    wire = two_participants()
    wire.run(20 * SECOND)
    announcements = [
        (transmission.at_ns, transmission.packet.destination)
        for transmission in wire.transmitted
        if isinstance(transmission.packet.body, Announcement)
    ]
    assert [at_ns for at_ns, destination in announcements if destination is None] == sorted(
        2 * [0, 100 * MS, 8_100 * MS, 16_100 * MS]
    )
    assert Counter(destination for _, destination in announcements) == {None: 8, "a": 4, "b": 4}
    assert {
        transmission.packet.size_bytes
        for transmission in wire.transmitted
        if isinstance(transmission.packet.body, Announcement)
    } == {SPDP_BYTES}


def test_participants_match_within_milliseconds() -> None:
    """Matching needs an announcement, a heartbeat 1 ms later, a request, and the endpoint; each has the delay."""
    wire = two_participants()
    run_until_matched(wire)
    assert wire.now_ns == MS + 4 * DELAY_NS


def test_samples_published_before_matching_are_dropped() -> None:
    wire = two_participants()
    publish(wire, [0, MS, 2 * MS])
    wire.run(SECOND)
    assert wire.dropped == dict.fromkeys((0, 1), "not matched yet")
    assert list(wire.delivered) == [2]


def test_best_effort_samples_to_an_unmatched_reader_are_dropped() -> None:
    wire = ScriptedWire(DELAY_NS)
    topics = wire.transports["topic"] = Topics(
        wire, {"scan": TopicFlow("a", "b", Qos("best_effort"))}, discovery=None
    )
    topics._sessions["scan"].unmatch_reader()
    publish(wire, [0])
    wire.run()
    assert wire.dropped == {0: "not matched yet"}


def test_without_discovery_only_samples_are_sent() -> None:
    wire = ScriptedWire(DELAY_NS, hosts=("a", "b"))
    wire.transports["topic"] = Topics(wire, {"scan": TopicFlow("a", "b")}, discovery=None)
    assert wire.next_event_ns() is None
    publish(wire, [0])
    wire.run()
    assert (len(wire.transmitted), wire.delivered) == (2, {0: DELAY_NS})


def test_a_participant_is_removed_after_its_lease_and_discovered_again() -> None:
    script, wires = lose_during((20 * SECOND, 60 * SECOND))
    wire = two_participants(script)
    wires.append(wire)
    publish(wire, [at_ns * SECOND for at_ns in (10, 25, 50, 75)])
    run_until_matched(wire)
    wire.run(50 * SECOND - 1)
    assert not session(wire).writer.is_matched
    assert not session(wire).reader.is_matched
    # The last packet received from b was the announcement at 16.1 s, so the second sample is given up at 26.1 s.
    assert wire.dropped == {1: "the lease of the subscriber expired"}
    wire.run(80 * SECOND)
    assert wire.dropped == {1: "the lease of the subscriber expired", 2: "not matched yet"}
    assert list(wire.delivered) == [0, 3]


@pytest.mark.parametrize("sources", ["a", "b"])
def test_a_participant_removed_on_one_side_only_is_discovered_again(sources: str) -> None:
    """The other side still receives everything and has no new endpoints, so the data must be requested."""
    script, wires = lose_during((20 * SECOND, 60 * SECOND), sources=sources)
    wire = two_participants(script)
    wires.append(wire)
    publish(wire, [*(number * SECOND for number in range(1, 100))])
    wire.run(60 * SECOND)
    topic_session = session(wire)
    unmatched_end, matched_end = (
        (topic_session.reader, topic_session.writer)
        if sources == "a"
        else (topic_session.writer, topic_session.reader)
    )
    assert (unmatched_end.is_matched, matched_end.is_matched) == (False, True)
    wire.run(120 * SECOND)
    assert topic_session.writer.is_matched
    assert topic_session.reader.is_matched
    assert wire.delivered.keys() >= set(range(70, 99))
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(99))


def lose_with_probability(probability: float, seed: int) -> Script:
    draws = PacketDraws(seed, "link")
    return lambda packet, *_: (0,) if draws.draw(packet.identity) >= probability else ()


def matching_time_s(loss: float, period_ns: int, seed: int) -> float:
    """Return the time from the start of b, between announcements of a, until both endpoints are matched."""
    starts_ns = 5 * SECOND + seed * 41 * MS
    discovery = DiscoveryTiming(period_ns=period_ns, starts_ns={"b": starts_ns})
    wire = two_participants(lose_with_probability(loss, seed), discovery=discovery)
    run_until_matched(wire)
    return (wire.now_ns - starts_ns) / 1e9


@pytest.mark.parametrize(
    ("loss", "period_ns", "median_s", "measurements"),
    [
        (0.2, 8 * SECOND, 0.45, 10),
        (0.5, 8 * SECOND, 8.0, 6),
        (0.2, SECOND // 2, 0.17, 10),
        (0.5, SECOND // 2, 1.1, 6),
    ],
)
def test_the_duration_of_discovery_is_near_that_of_cyclonedds(
    loss: float, period_ns: int, median_s: float, measurements: int
) -> None:
    """The median measured with real programs must be within the 99 % range of medians of as many simulated runs."""
    simulated_s = [matching_time_s(loss, period_ns, seed) for seed in range(60)]
    generator = np.random.Generator(np.random.PCG64(1))
    medians_s = np.median(generator.choice(simulated_s, size=(2000, measurements)), axis=1)
    low_s, high_s = np.quantile(medians_s, [0.005, 0.995])
    # The real programs take some 30 ms more, even without loss.
    assert low_s <= median_s <= high_s + 0.03, f"the simulated median is {statistics.median(simulated_s):.2f} s"


@given(st.lists(st.booleans(), max_size=80), st.integers(0, 20 * SECOND))
def test_participants_match_after_any_losses(losses: Sequence[bool], starts_ns: int) -> None:
    remaining = iter(losses)
    wire = two_participants(
        lambda *_: () if next(remaining, False) else (0,), discovery=DiscoveryTiming(starts_ns={"b": starts_ns})
    )
    run_until_matched(wire)
    matched_ns = wire.now_ns
    # Longer than a lease, so that all scripted losses have occurred.
    publish(wire, [matched_ns + number * SECOND for number in range(60)])
    wire.run(matched_ns + 100 * SECOND)
    assert wire.delivered.keys() >= set(range(40, 60))
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(60))


def test_heartbeats_for_several_participants_share_a_message() -> None:
    """The first heartbeat after an announcement is separate; later ones without a response are multicast."""
    hosts = ("a", "b", "c")
    wire = ScriptedWire(DELAY_NS, hosts=hosts, script=lambda packet, *_: (0,) if packet.destination is None else ())
    flows = {source + peer: TopicFlow(source, peer) for source in hosts for peer in hosts if source != peer}
    wire.transports["topic"] = Topics(wire, flows)
    wire.run(450 * MS)
    shared_heartbeats = [
        (
            transmission.at_ns,
            transmission.packet.source,
            set(transmission.packet.body.by_peer),
            transmission.packet.size_bytes,
        )
        for transmission in wire.transmitted
        if isinstance(transmission.packet.body, SharedHeartbeats)
    ]
    # A message has the headers of IP, UDP and RTPS, and one heartbeat for each of five built-in topics.
    assert sorted(shared_heartbeats) == [
        (at_ns * MS, host, {*hosts} - {host}, 28 + 20 + 5 * 32) for at_ns in (200, 300, 400) for host in hosts
    ]
    separate_heartbeats = [
        transmission for transmission in wire.transmitted if transmission.packet.identity[0].endswith(" heartbeat")
    ]
    assert {
        (transmission.at_ns, transmission.packet.source, transmission.packet.destination)
        for transmission in separate_heartbeats
    } == {(DELAY_NS + MS, source, peer) for source in hosts for peer in hosts if source != peer}


SPANS = st.lists(
    st.tuples(st.integers(0, 90), st.integers(1, 60), st.sampled_from(["a", "b", "ab"])), min_size=1, max_size=5
)


@settings(max_examples=20)
@given(SPANS)
def test_participants_match_again_after_any_outages(spans: Sequence[tuple[int, int, str]]) -> None:
    """Outages in one or both directions, shorter or longer than a lease, separate or overlapping."""
    wires: list[ScriptedWire] = []

    def script(packet: IpPacket, receiver: str, number: int) -> Sequence[int]:
        now_s = wires[0].now_ns / SECOND
        is_outage = any(
            begin <= now_s < begin + length and packet.source in sources for begin, length, sources in spans
        )
        return () if is_outage else (0,)

    wire = two_participants(script)
    wires.append(wire)
    publish(wire, [number * SECOND for number in range(200)])
    wire.run(260 * SECOND)
    # After the last outage, at most a lease, a period until the next announcement, and a retry are needed.
    assert wire.delivered.keys() >= set(range(180, 200))
    assert sorted([*wire.delivered, *wire.dropped]) == list(range(200))
    assert list(wire.delivered) == sorted(wire.delivered)


def test_many_participants_all_match() -> None:
    hosts = [f"robot{number}" for number in range(6)]
    flows: Mapping[str, TopicFlow] = {
        f"{source} {peer}": TopicFlow(source, peer) for source in hosts for peer in hosts if source != peer
    }
    wire = ScriptedWire(DELAY_NS, hosts=hosts, script=lose_with_probability(0.1, 1))
    topics = wire.transports["topic"] = Topics(wire, flows)
    wire.run(30 * SECOND)
    assert all(
        topics._sessions[name].writer.is_matched and topics._sessions[name].reader.is_matched for name in flows
    )
