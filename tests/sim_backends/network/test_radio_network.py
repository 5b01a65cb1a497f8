"""The radio network: exact order of events, stations that are placed only at events, and one result per packet."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.policies.window_policies import EventDriven, Scheduled, SlidingWindow, VariableStepped
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.run_record import Run
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.network.udp import Udp
from sim_backends.network.wire import IpPacket, Wire
from sim_backends.physics.paths import Paths
from sim_backends.radio.models.radio_model import RadioModel
from sim_backends.radio.phy.modes import G_MODES
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State, WayPoints
from tests.helpers.nightly import examples
from tests.helpers.radio_networks import MS, carry, fixed, network, outcome, packets, standing, wifi

NAMES = "abcd"
FADING = RadioOptions(shadowing_db=3.0)


class EagerNetwork(RadioNetwork):
    """Places stations at every window, even without events."""

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        self._states = states
        self._place(self.now_ns)
        return super().advance(to_ns, packets, states)


def passing_robots(
    kind: type[RadioNetwork], policy: SyncPolicy, seed: int, disturbances: Sequence[Disturbance]
) -> Coordinator:
    """Let four robots pass each other at the limit of their range; each sends to the next."""
    paths = {
        "a": [(0.0, 0.0, 1.0), (0.0, 60.0, 1.0)],
        "b": [(50.0, 30.0, 1.0), (50.0, -30.0, 1.0)],
        "c": [(20.0, 0.0, 1.0)],
        "d": [(80.0, 0.0, 1.0), (-20.0, 5.0, 1.0)],
    }
    physics = Paths([WayPoints(name, path, 5.0 + number) for number, (name, path) in enumerate(paths.items())])
    pairs = [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a")]
    programs = {
        sender: Periodic(
            sender, receiver, period_ns=7_300_001, size_bytes=800 + 700 * number, first_ns=number * 1_700_000
        )
        for number, (sender, receiver) in enumerate(pairs)
    }
    net = kind(wifi(NAMES, FADING, seed=seed), NAMES, disturbances=disturbances)
    return Coordinator(Agents(physics, programs), net, policy, pairs)


def run_passing_robots(
    kind: type[RadioNetwork], policy: SyncPolicy, seed: int, disturbances: Sequence[Disturbance]
) -> Run:
    return passing_robots(kind, policy, seed, disturbances).advance(250 * MS)


JAMMERS = [Jammer(5.0, 50 * MS, 80 * MS, agent="c"), Jammer(10.0, 60 * MS, 200 * MS, (40.0, 0.0, 1.0))]


@settings(max_examples=6)
@given(
    st.integers(0, 2**32),
    st.sampled_from([EventDriven, VariableStepped, lambda: Scheduled(0.0011), lambda: SlidingWindow(0.01)]),
    st.sampled_from([[], JAMMERS, [NodeLoss("c", 100 * MS, 150 * MS), LinkCut("a", "b", 60 * MS, None)]]),
)
def test_placing_stations_only_at_events_does_not_change_results(
    seed: int, policy: type[SyncPolicy], disturbances: list[Disturbance]
) -> None:
    lazy_run, eager_run = (
        run_passing_robots(RadioNetwork, policy(), seed, disturbances),
        run_passing_robots(EagerNetwork, policy(), seed, disturbances),
    )
    assert lazy_run.digest == eager_run.digest
    assert any(fate.arrived_ns is not None for fate in lazy_run.fates.values())


@settings(max_examples=4)
@given(st.integers(0, 2**32), st.sampled_from([[], JAMMERS]))
def test_exact_policies_agree_on_every_packet(seed: int, disturbances: list[Disturbance]) -> None:
    first, second = (
        run_passing_robots(RadioNetwork, policy, seed, disturbances) for policy in (EventDriven(), VariableStepped())
    )
    assert {identity: (fate.arrived_ns, fate.reason) for identity, fate in first.fates.items()} == {
        identity: (fate.arrived_ns, fate.reason) for identity, fate in second.fates.items()
    }


def test_a_fork_during_frames_continues_like_its_original() -> None:
    original = passing_robots(RadioNetwork, EventDriven(), 1, JAMMERS)
    original.advance(70 * MS + 123_456)
    fork = original.fork()
    assert fork.advance(150 * MS).digest == original.advance(150 * MS).digest
    assert fork.run.fates.keys() == original.run.fates.keys()


def test_events_in_a_fork_are_not_logged() -> None:
    log_times_ns: list[int] = []

    class Logged(RadioNetwork):
        def __init__(
            self, radio: RadioModel[Fragment], names: Sequence[str], *, disturbances: Sequence[Disturbance]
        ) -> None:
            super().__init__(radio, names, disturbances=disturbances)
            self.log_ip(lambda at_ns, _name, _fragment: log_times_ns.append(at_ns))

    original = passing_robots(Logged, EventDriven(), 1, [])
    original.advance(70 * MS)
    count_before = len(log_times_ns)
    original.fork().advance(150 * MS)
    assert len(log_times_ns) == count_before
    original.advance(150 * MS)
    assert len(log_times_ns) > count_before > 0


PLACES = st.tuples(st.floats(0, 120), st.floats(0, 120), st.just(1.0))
SENDS = st.lists(
    st.tuples(
        st.integers(0, 30 * MS), st.sampled_from(NAMES), st.sampled_from(NAMES), st.sampled_from([0, 900, 1500, 7000])
    ),
    max_size=40,
).map(sorted)
TIMES = st.integers(0, 40 * MS)
ENDS = st.none() | st.integers(40 * MS, 60 * MS)
DISTURBANCES = st.lists(
    st.one_of(
        st.builds(NodeLoss, st.sampled_from(NAMES), TIMES, ENDS),
        st.builds(LinkCut, st.just("a"), st.sampled_from("bcd"), TIMES, ENDS),
        st.builds(Jammer, st.floats(-10, 20), TIMES, st.integers(40 * MS, 60 * MS), agent=st.sampled_from(NAMES)),
    ),
    max_size=4,
)
FIXED = st.fixed_dictionaries(
    {
        "loss": st.sampled_from(["0%", "20%"]),
        "delay": st.sampled_from(["0ms", "1ms"]),
        "rate": st.sampled_from(["unlimited", "10Mbit/s"]),
        "jitter": st.sampled_from(["0ms", "1ms"]),
        "queue_packets": st.integers(0, 5),
    }
)
WIFI = st.fixed_dictionaries({"queue_packets": st.integers(0, 10)})


@settings(max_examples=examples(60))
@given(
    WIFI | FIXED,
    st.integers(0, 100),
    st.fixed_dictionaries(dict.fromkeys(NAMES, PLACES)),
    SENDS,
    st.tuples(DISTURBANCES, st.sampled_from([None, "c"])),
)
def test_every_packet_has_one_result_independent_of_windows(
    options: dict[str, str | int],
    seed: int,
    places_m: dict[str, tuple[float, float, float]],
    sends: list[tuple[int, str, str, int]],
    setting: tuple[list[Disturbance], str | None],
) -> None:
    disturbances, relay = setting
    if "loss" in options:
        disturbances = [disturbance for disturbance in disturbances if not isinstance(disturbance, Jammer)]
    sent_packets, states = packets(sends), standing(places_m)

    def create_network() -> RadioNetwork:
        wireless = wifi(NAMES, RadioOptions.model_validate(options), seed=seed)
        radio = fixed(seed, **options) if "loss" in options else wireless
        return network(radio, NAMES, disturbances=disturbances, relay=relay)

    net = create_network()
    expected = carry(net, states, sent_packets)
    assert len(expected.arrived) + len(expected.dropped) == len(sent_packets)
    assert net.next_event_ns() is None, "nothing is in flight"
    # The results are the same in windows of 5 ms, and from event to event.
    for next_end in (lambda now_ns, _: now_ns + 5 * MS, lambda _, next_ns: next_ns):
        net, remaining, now_ns = create_network(), list(sent_packets), 0
        arrivals: list[Arrival] = []
        drops: list[Drop] = []
        while (next_ns := net.next_event_ns()) is not None or remaining:
            end_times_ns = [
                end_ns for end_ns in (next_ns, remaining[0].enters_ns if remaining else None) if end_ns is not None
            ]
            to_ns = next_end(now_ns, min(end_times_ns))
            entering = [packet for packet in remaining if packet.enters_ns <= to_ns]
            del remaining[: len(entering)]
            window_arrivals, window_drops = net.advance(to_ns, entering, states)
            assert all(now_ns <= arrival.at_ns <= to_ns for arrival in window_arrivals)
            arrivals += window_arrivals
            drops += window_drops
            now_ns = to_ns
        assert outcome(sent_packets, arrivals, drops) == expected


class BroadcastTransport:
    """Sends every packet as a broadcast, and records its receivers."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self.received: list[tuple[int, str, int]] = []

    def send(self, packet: Packet) -> None:
        self._wire.transmit(
            IpPacket(packet.source, None, "shout", packet.size_bytes, packet.identity, packet.packet_id)
        )

    def receive(self, host: str, packet: IpPacket) -> None:
        self.received.append((self._wire.now_ns, host, packet.body))

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        raise AssertionError("record_loss must not be called for broadcasts")


def broadcast(
    places_m: dict[str, tuple[float, float, float]], sent_packets: Sequence[Packet]
) -> list[tuple[int, str, int]]:
    transports: list[BroadcastTransport] = []

    def make(wire: Wire) -> BroadcastTransport:
        transports.append(BroadcastTransport(wire))
        return transports[0]

    net = network(wifi(list(places_m)), list(places_m), transports={"shout": make})
    net.advance(10**9, sent_packets, standing(places_m))
    return transports[0].received


def test_a_fragmented_broadcast_reaches_all_stations_in_range() -> None:
    places_m = {"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0), "c": (0.0, 20.0, 1.0), "d": (200.0, 0.0, 1.0)}
    arrivals = broadcast(places_m, packets([(0, "a", "b", 4000)], protocol="shout"))
    assert [(host, number) for _, host, number in arrivals] == [("b", 1), ("c", 1)]


@pytest.mark.parametrize("interval_ns", [5_000, 300_000, 1_000_000, 1_410_000, 1_430_000, 3_000_000])
@pytest.mark.parametrize("are_hidden", [True, False])
def test_overlapping_frames_of_hidden_stations_collide(are_hidden: bool, interval_ns: int) -> None:
    """A frame of 1000 bytes at 6 Mbit/s; both senders are equally far from the receiver, so both frames are lost."""
    distance_m = 60.0 if are_hidden else 10.0
    places_m = {"a": (-distance_m, 0.0, 1.0), "b": (0.0, 0.0, 1.0), "c": (distance_m, 0.0, 1.0)}
    sent_packets = packets([(0, "a", "b", 1000), (interval_ns, "c", "b", 1000)], protocol="shout")
    received_numbers = {number for _, host, number in broadcast(places_m, sent_packets) if host == "b"}
    # Preamble of 20 us, extension of 6 us, symbols of 4 us with 24 bits each.
    airtime_ns = 26_000 + 4_000 * -(-(22 + 8 * 1036) // 24)
    assert airtime_ns == G_MODES[0].airtime_ns(1036)
    assert received_numbers == (set() if are_hidden and interval_ns < airtime_ns else {1, 2})


def test_simultaneous_events_run_in_the_documented_order() -> None:
    """Events of the radio, disturbances, timers in the order of setting, packets in the given order."""
    order: list[str] = []

    class LoggingUdp(Udp):
        def __init__(self, wire: Wire) -> None:
            super().__init__(wire)
            self._own_wire = wire

        def send(self, packet: Packet) -> None:
            order.append(f"sends {packet.identity[1]} at {self._own_wire.now_ns}")
            super().send(packet)
            if packet.identity[1] == 0:
                for name in ("one", "two"):
                    self._own_wire.at(5 * MS, "b", partial(order.append, f"timer {name}"))

        def receive(self, host: str, packet: IpPacket) -> None:
            order.append(f"gets {packet.identity[1]}")

        def record_loss(self, packet: IpPacket, reason: str) -> None:
            order.append(f"loses {packet.identity[1]}: {reason}")

    net = network(
        fixed(delay="5ms"),
        "ab",
        transports={"udp": LoggingUdp},
        disturbances=[NodeLoss("a", 5 * MS)],
    )
    net.advance(
        9 * MS, packets([(0, "a", "b", 10), (5 * MS, "a", "b", 10)]), standing(dict.fromkeys("ab", (0, 0, 0)))
    )
    assert order == [
        "sends 0 at 0",
        "gets 0",
        "timer one",
        "timer two",
        f"sends 1 at {5 * MS}",
        "loses 1: radio off",
    ]


class EchoingUdp(Udp):
    """Returns every packet three times before it counts as delivered."""

    def __init__(self, wire: Wire) -> None:
        super().__init__(wire)
        self._own_wire = wire

    def receive(self, host: str, packet: IpPacket) -> None:
        flow, number = packet.identity
        if number == 3:
            self._own_wire.deliver(packet.body)
        else:
            self._own_wire.transmit(
                replace(packet, source=host, destination=packet.source, identity=(flow, number + 1))
            )


@pytest.mark.parametrize("delay_ms", [0, 2])
def test_replies_without_delay_arrive_in_the_same_nanosecond(delay_ms: int) -> None:
    net = network(fixed(delay=f"{delay_ms}ms"), "ab", transports={"udp": EchoingUdp})
    sent_packets = packets([(MS, "a", "b", 10)])
    assert outcome(
        sent_packets, *net.advance(10 * MS, sent_packets, standing(dict.fromkeys("ab", (0, 0, 0))))
    ).arrived == {("a to b", 0): MS + 4 * delay_ms * MS}


def test_a_timer_in_the_past_is_rejected() -> None:
    net = network(fixed(), "ab")
    net.advance(5, [], standing(dict.fromkeys("ab", (0, 0, 0))))
    with pytest.raises(ValueError, match="for 4 ns, which is before the current time, 5 ns"):
        net.at(4, "a", lambda: None)


def test_the_ip_log_contains_every_fragment_at_both_ends() -> None:
    log: list[tuple[int, str, int, int]] = []
    net = network(fixed(delay="5ms"), "ab")
    net.log_ip(lambda at_ns, host, fragment: log.append((at_ns, host, fragment.index, fragment.size_bytes)))
    carry(net, standing(dict.fromkeys("ab", (0, 0, 0))), packets([(MS, "a", "b", 1500)]))
    assert log == [(MS, "a", 0, 1500), (MS, "a", 1, 48), (6 * MS, "b", 0, 1500), (6 * MS, "b", 1, 48)]


@pytest.mark.parametrize(
    ("relay", "disturbance", "name"),
    [("x", None, "x"), (None, NodeLoss("y", 0), "y"), (None, LinkCut("a", "z", 0), "z")],
)
def test_an_unknown_station_is_rejected(relay: str | None, disturbance: Disturbance | None, name: str) -> None:
    with pytest.raises(ConfigurationError, match=f"no station '{name}'"):
        network(wifi("ab"), "ab", relay=relay, disturbances=[disturbance] if disturbance else [])
