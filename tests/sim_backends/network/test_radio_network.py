"""The radio network: exact order of time, stations placed lazily, every packet with one end."""

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
from sim_backends.radio.model import RadioModel
from sim_backends.radio.modes import G_MODES
from sim_backends.radio.options import RadioOptions
from sim_backends.world.motion import State, WayPoints
from tests.helpers.radio_networks import MS, carry, fixed, network, outcome, packets, standing, wifi

NAMES = "abcd"
FADING = RadioOptions(shadowing_db=3.0)


class Eager(RadioNetwork):
    """Places stations at every window, whether anything happens or not."""

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        self._known = states
        self._place(self.now_ns)
        return super().advance(to_ns, packets, states)


def driving(
    kind: type[RadioNetwork], policy: SyncPolicy, seed: int, disturbances: Sequence[Disturbance]
) -> Coordinator:
    """Let four robots drive past each other at the border of their range, each sending to the next."""
    ways = {
        "a": [(0.0, 0.0, 1.0), (0.0, 60.0, 1.0)],
        "b": [(50.0, 30.0, 1.0), (50.0, -30.0, 1.0)],
        "c": [(20.0, 0.0, 1.0)],
        "d": [(80.0, 0.0, 1.0), (-20.0, 5.0, 1.0)],
    }
    physics = Paths([WayPoints(name, way, 5.0 + number) for number, (name, way) in enumerate(ways.items())])
    pairs = [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a")]
    programs = {
        one: Periodic(one, other, period_ns=7_300_001, size_bytes=800 + 700 * number, first_ns=number * 1_700_000)
        for number, (one, other) in enumerate(pairs)
    }
    net = kind(wifi(NAMES, FADING, seed=seed), NAMES, disturbances=disturbances)
    return Coordinator(Agents(physics, programs), net, policy, pairs)


def driven(kind: type[RadioNetwork], policy: SyncPolicy, seed: int, disturbances: Sequence[Disturbance]) -> Run:
    return driving(kind, policy, seed, disturbances).advance(250 * MS)


JAM = [Jammer(5.0, 50 * MS, 80 * MS, agent="c"), Jammer(10.0, 60 * MS, 200 * MS, (40.0, 0.0, 1.0))]


@settings(max_examples=6)
@given(
    st.integers(0, 2**32),
    st.sampled_from([EventDriven, VariableStepped, lambda: Scheduled(0.0011), lambda: SlidingWindow(0.01)]),
    st.sampled_from([[], JAM, [NodeLoss("c", 100 * MS, 150 * MS), LinkCut("a", "b", 60 * MS, None)]]),
)
def test_placing_stations_only_when_something_happens_changes_nothing(
    seed: int, policy: type[SyncPolicy], disturbances: list[Disturbance]
) -> None:
    lazy, eager = driven(RadioNetwork, policy(), seed, disturbances), driven(Eager, policy(), seed, disturbances)
    assert lazy.digest == eager.digest
    assert any(fate.arrived_ns is not None for fate in lazy.fates.values())


@settings(max_examples=4)
@given(st.integers(0, 2**32), st.sampled_from([[], JAM]))
def test_exact_policies_agree_on_every_packet(seed: int, disturbances: list[Disturbance]) -> None:
    one, other = (driven(RadioNetwork, policy, seed, disturbances) for policy in (EventDriven(), VariableStepped()))
    assert {identity: (fate.arrived_ns, fate.reason) for identity, fate in one.fates.items()} == {
        identity: (fate.arrived_ns, fate.reason) for identity, fate in other.fates.items()
    }


def test_a_fork_in_the_midst_of_frames_goes_on_as_its_origin_does() -> None:
    origin = driving(RadioNetwork, EventDriven(), 1, JAM)
    origin.advance(70 * MS + 123_456)
    fork = origin.fork()
    assert fork.advance(150 * MS).digest == origin.advance(150 * MS).digest
    assert fork.run.fates.keys() == origin.run.fates.keys()


def test_what_happens_in_a_fork_is_in_no_log() -> None:
    logged: list[int] = []

    class Logged(RadioNetwork):
        def __init__(
            self, radio: RadioModel[Fragment], names: Sequence[str], *, disturbances: Sequence[Disturbance]
        ) -> None:
            super().__init__(radio, names, disturbances=disturbances)
            self.log_ip(lambda at_ns, _name, _fragment: logged.append(at_ns))

    origin = driving(Logged, EventDriven(), 1, [])
    origin.advance(70 * MS)
    before = len(logged)
    origin.fork().advance(150 * MS)
    assert len(logged) == before
    origin.advance(150 * MS)
    assert len(logged) > before > 0


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


@settings(max_examples=60)
@given(
    WIFI | FIXED,
    st.integers(0, 100),
    st.fixed_dictionaries(dict.fromkeys(NAMES, PLACES)),
    SENDS,
    st.tuples(DISTURBANCES, st.sampled_from([None, "c"])),
)
def test_every_packet_ends_once_and_no_window_changes_how(
    options: dict[str, str | int],
    seed: int,
    places_m: dict[str, tuple[float, float, float]],
    sends: list[tuple[int, str, str, int]],
    setting: tuple[list[Disturbance], str | None],
) -> None:
    disturbances, relay = setting
    if "loss" in options:
        disturbances = [one for one in disturbances if not isinstance(one, Jammer)]
    sent, states = packets(sends), standing(places_m)

    def made() -> RadioNetwork:
        wireless = wifi(NAMES, RadioOptions.model_validate(options), seed=seed)
        radio = fixed(seed, **options) if "loss" in options else wireless
        return network(radio, NAMES, disturbances=disturbances, relay=relay)

    net = made()
    whole = carry(net, states, sent)
    assert len(whole.arrived) + len(whole.dropped) == len(sent)
    assert net.next_event_ns() is None, "nothing is under way"
    # The same in windows of 5 ms, and from event to event, where nothing comes between two events.
    for next_end in (lambda now_ns, _: now_ns + 5 * MS, lambda _, next_ns: next_ns):
        net, waiting, now_ns = made(), list(sent), 0
        arrivals: list[Arrival] = []
        drops: list[Drop] = []
        while (next_ns := net.next_event_ns()) is not None or waiting:
            ends = [one for one in (next_ns, waiting[0].enters_ns if waiting else None) if one is not None]
            to_ns = next_end(now_ns, min(ends))
            entering = [one for one in waiting if one.enters_ns <= to_ns]
            del waiting[: len(entering)]
            arrived, dropped = net.advance(to_ns, entering, states)
            assert all(now_ns <= one.at_ns <= to_ns for one in arrived)
            arrivals += arrived
            drops += dropped
            now_ns = to_ns
        assert outcome(sent, arrivals, drops) == whole


class Shouts:
    """Sends every packet to everyone, and notes who got it."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self.heard: list[tuple[int, str, int]] = []

    def send(self, packet: Packet) -> None:
        self._wire.transmit(
            IpPacket(packet.source, None, "shout", packet.size_bytes, packet.identity, packet.packet_id)
        )

    def receive(self, host: str, packet: IpPacket) -> None:
        self.heard.append((self._wire.now_ns, host, packet.body))

    def lost(self, packet: IpPacket, reason: str) -> None:
        raise AssertionError("of a broadcast each host may miss its own")


def shouted(places_m: dict[str, tuple[float, float, float]], sent: Sequence[Packet]) -> list[tuple[int, str, int]]:
    made: list[Shouts] = []

    def make(wire: Wire) -> Shouts:
        made.append(Shouts(wire))
        return made[0]

    net = network(wifi(list(places_m)), list(places_m), transports={"shout": make})
    net.advance(10**9, sent, standing(places_m))
    return made[0].heard


def test_a_broadcast_reaches_everyone_in_range_whole() -> None:
    places_m = {"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0), "c": (0.0, 20.0, 1.0), "d": (200.0, 0.0, 1.0)}
    heard = shouted(places_m, packets([(0, "a", "b", 4000)], protocol="shout"))
    assert [(host, number) for _, host, number in heard] == [("b", 1), ("c", 1)]


@pytest.mark.parametrize("apart_ns", [5_000, 300_000, 1_000_000, 1_410_000, 1_430_000, 3_000_000])
@pytest.mark.parametrize("hidden", [True, False])
def test_two_stations_collide_where_they_overlap_and_cannot_hear_each_other(hidden: bool, apart_ns: int) -> None:
    """A frame of 1000 bytes at 6 Mbit/s; the listener is as near to both, so that neither is understood."""
    aside_m = 60.0 if hidden else 10.0
    places_m = {"a": (-aside_m, 0.0, 1.0), "b": (0.0, 0.0, 1.0), "c": (aside_m, 0.0, 1.0)}
    sent = packets([(0, "a", "b", 1000), (apart_ns, "c", "b", 1000)], protocol="shout")
    heard = {number for _, host, number in shouted(places_m, sent) if host == "b"}
    # 20 us of preamble, 6 us of extension, symbols of 4 us of 24 bits each.
    airtime_ns = 26_000 + 4_000 * -(-(22 + 8 * 1036) // 24)
    assert airtime_ns == G_MODES[0].airtime_ns(1036)
    assert heard == (set() if hidden and apart_ns < airtime_ns else {1, 2})


def test_what_happens_at_one_nanosecond_happens_in_the_stated_order() -> None:
    """The radio's events, then disturbances, then timers as they were set, then packets as they are given."""
    order: list[str] = []

    class Noting(Udp):
        def __init__(self, wire: Wire) -> None:
            super().__init__(wire)
            self._to = wire

        def send(self, packet: Packet) -> None:
            order.append(f"sends {packet.identity[1]} at {self._to.now_ns}")
            super().send(packet)
            if packet.identity[1] == 0:
                for name in ("one", "two"):
                    self._to.at(5 * MS, "b", partial(order.append, f"timer {name}"))

        def receive(self, host: str, packet: IpPacket) -> None:
            order.append(f"gets {packet.identity[1]}")

        def lost(self, packet: IpPacket, reason: str) -> None:
            order.append(f"loses {packet.identity[1]}: {reason}")

    net = network(
        fixed(delay="5ms"),
        "ab",
        transports={"udp": Noting},
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


class Answers(Udp):
    """Sends every packet to and fro three times before it counts as delivered."""

    def __init__(self, wire: Wire) -> None:
        super().__init__(wire)
        self._to = wire

    def receive(self, host: str, packet: IpPacket) -> None:
        flow, number = packet.identity
        if number == 3:
            self._to.deliver(packet.body)
        else:
            self._to.transmit(replace(packet, source=host, destination=packet.source, identity=(flow, number + 1)))


@pytest.mark.parametrize("delay_ms", [0, 2])
def test_an_answer_without_delay_arrives_in_the_same_nanosecond(delay_ms: int) -> None:
    net = network(fixed(delay=f"{delay_ms}ms"), "ab", transports={"udp": Answers})
    sent = packets([(MS, "a", "b", 10)])
    assert outcome(sent, *net.advance(10 * MS, sent, standing(dict.fromkeys("ab", (0, 0, 0))))).arrived == {
        ("a to b", 0): MS + 4 * delay_ms * MS
    }


def test_a_timer_in_the_past_is_refused() -> None:
    net = network(fixed(), "ab")
    net.advance(5, [], standing(dict.fromkeys("ab", (0, 0, 0))))
    with pytest.raises(ValueError, match="for 4 ns was set at 5 ns"):
        net.at(4, "a", lambda: None)


def test_the_log_of_ip_has_every_fragment_at_both_ends() -> None:
    log: list[tuple[int, str, int, int]] = []
    net = network(fixed(delay="5ms"), "ab")
    net.log_ip(lambda at_ns, host, one: log.append((at_ns, host, one.index, one.size_bytes)))
    carry(net, standing(dict.fromkeys("ab", (0, 0, 0))), packets([(MS, "a", "b", 1500)]))
    assert log == [(MS, "a", 0, 1500), (MS, "a", 1, 48), (6 * MS, "b", 0, 1500), (6 * MS, "b", 1, 48)]


@pytest.mark.parametrize(
    ("relay", "disturbance", "name"),
    [("x", None, "x"), (None, NodeLoss("y", 0), "y"), (None, LinkCut("a", "z", 0), "z")],
)
def test_a_station_that_is_not_there_is_refused(
    relay: str | None, disturbance: Disturbance | None, name: str
) -> None:
    with pytest.raises(ConfigurationError, match=f"no station '{name}'"):
        network(wifi("ab"), "ab", relay=relay, disturbances=[disturbance] if disturbance else [])
