"""Radio networks in small for tests: agents that stand or move, and packets that are sent at given times."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from fieldkit.core.model import Vector
from sim_backends.network.disturbances import Disturbance
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.network.radio import UDP_ONLY, RadioNetwork, TransportFactory
from sim_backends.radio.fixed_links import UniformLinks
from sim_backends.radio.model import WifiInWorld
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.world_channel import Antenna
from sim_backends.world.motion import State

MS = 1_000_000
IN_THE_OPEN = RadioOptions(fading=False, mode="g6")
"""Free of chance but for contention and bit errors, which near stations do not have."""
ANTENNA = Antenna("802.11g", 15.0, -85.0)
"""Heard as far as about 70 m, where the exponent is 3."""


@dataclass
class Outcome:
    """What became of packets, by their identity."""

    arrived: dict[tuple[str, int], int] = field(default_factory=dict)
    dropped: dict[tuple[str, int], str] = field(default_factory=dict)


def wifi(names: Sequence[str], options: RadioOptions = IN_THE_OPEN, *, seed: int = 1) -> WifiInWorld[Fragment]:
    """Return Wi-Fi stations on open ground."""
    return WifiInWorld(seed, options, dict.fromkeys(names, ANTENNA), None)


def fixed(seed: int = 1, **options: str | int) -> UniformLinks[Fragment]:
    """Return links that do the same wherever stations stand, unlimited and without delay but for what is said."""
    return UniformLinks(seed, RadioOptions.model_validate({"delay": "0ms", "rate": "unlimited"} | options))


def standing(places_m: Mapping[str, Vector]) -> dict[str, State]:
    """Return the states of agents that stand at places."""
    return {name: State(place_m) for name, place_m in places_m.items()}


def packets(
    sends: Sequence[tuple[int, str, str, int]], *, protocol: str = "udp", flow: str | None = None
) -> list[Packet]:
    """Return packets of time, source, destination and size, in order, each pair with a flow of its own."""
    made: list[Packet] = []
    numbers: dict[str, int] = {}
    for packet_id, (at_ns, source, destination, size_bytes) in enumerate(sends, start=1):
        name = flow or f"{source} to {destination}"
        number = numbers.get(name, 0)
        numbers[name] = number + 1
        made.append(Packet(packet_id, source, destination, size_bytes, (name, number), at_ns, at_ns, protocol))
    return made


def network(
    radio: WifiInWorld[Fragment] | UniformLinks[Fragment],
    names: Sequence[str],
    *,
    transports: Mapping[str, TransportFactory] = UDP_ONLY,
    disturbances: Sequence[Disturbance] = (),
    relay: str | None = None,
) -> RadioNetwork:
    """Return a radio network."""
    return RadioNetwork(radio, names, transports=transports, disturbances=disturbances, relay=relay)


def carry(
    net: RadioNetwork,
    states: Mapping[str, State],
    sent: Sequence[Packet],
    *,
    to_ns: int = 1000 * 10**9,
) -> Outcome:
    """Return what becomes of packets, none of which may end twice."""
    arrivals, drops = net.advance(to_ns, sent, states)
    return outcome(sent, arrivals, drops)


def outcome(sent: Sequence[Packet], arrivals: Sequence[Arrival], drops: Sequence[Drop]) -> Outcome:
    """Return arrivals and drops by identity."""
    by_id = {packet.packet_id: packet for packet in sent}
    ended = [one.packet_id for one in arrivals] + [one.packet_id for one in drops]
    assert len(ended) == len(set(ended)), "a packet ended twice"
    for arrival in arrivals:
        assert arrival.receiver == by_id[arrival.packet_id].destination
    assert [one.at_ns for one in arrivals] == sorted(one.at_ns for one in arrivals)
    return Outcome(
        {by_id[one.packet_id].identity: one.at_ns for one in arrivals},
        {by_id[one.packet_id].identity: one.reason for one in drops},
    )
