"""Small radio networks for tests: stationary or moving agents, and packets that are sent at given times."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from fieldkit.core.model import Vector
from sim_backends.network.disturbances import Disturbance
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.network.radio import UDP_ONLY, RadioNetwork, TransportFactory
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State

MS = 1_000_000
IN_THE_OPEN = RadioOptions(fading=False, mode="g6")
"""Deterministic except for contention and bit errors; nearby stations have no bit errors."""
ANTENNA = Antenna("802.11g", 15.0, -85.0)
"""An antenna with a range of about 70 m for a path loss exponent of 3."""


@dataclass
class Outcome:
    """The arrival time or drop reason of packets, by their identity."""

    arrived: dict[tuple[str, int], int] = field(default_factory=dict)
    dropped: dict[tuple[str, int], str] = field(default_factory=dict)


def wifi(names: Sequence[str], options: RadioOptions = IN_THE_OPEN, *, seed: int = 1) -> WifiInWorld[Fragment]:
    """Wi-Fi stations on open ground."""
    return WifiInWorld(seed, options, dict.fromkeys(names, ANTENNA), None)


def fixed(seed: int = 1, **options: str | int) -> UniformLinks[Fragment]:
    """Links that do not depend on positions; by default with an unlimited rate and no delay."""
    return UniformLinks(seed, RadioOptions.model_validate({"delay": "0ms", "rate": "unlimited"} | options))


def standing(places_m: Mapping[str, Vector]) -> dict[str, State]:
    """The states of stationary agents at the given positions."""
    return {name: State(position_m) for name, position_m in places_m.items()}


def packets(
    sends: Sequence[tuple[int, str, str, int]], *, protocol: str = "udp", flow: str | None = None
) -> list[Packet]:
    """Packets from tuples of time, source, destination and size; without `flow`, each pair has a separate flow."""
    result: list[Packet] = []
    numbers: dict[str, int] = {}
    for packet_id, (at_ns, source, destination, size_bytes) in enumerate(sends, start=1):
        name = flow or f"{source} to {destination}"
        number = numbers.get(name, 0)
        numbers[name] = number + 1
        result.append(Packet(packet_id, source, destination, size_bytes, (name, number), at_ns, at_ns, protocol))
    return result


def network(
    radio: WifiInWorld[Fragment] | UniformLinks[Fragment],
    names: Sequence[str],
    *,
    transports: Mapping[str, TransportFactory] = UDP_ONLY,
    disturbances: Sequence[Disturbance] = (),
    relay: str | None = None,
) -> RadioNetwork:
    """A radio network."""
    return RadioNetwork(radio, names, transports=transports, disturbances=disturbances, relay=relay)


def carry(
    net: RadioNetwork,
    states: Mapping[str, State],
    sent: Sequence[Packet],
    *,
    to_ns: int = 1000 * 10**9,
) -> Outcome:
    """Send packets over a network; return their outcome."""
    arrivals, drops = net.advance(to_ns, sent, states)
    return outcome(sent, arrivals, drops)


def outcome(sent: Sequence[Packet], arrivals: Sequence[Arrival], drops: Sequence[Drop]) -> Outcome:
    """The outcome of sent packets; each must arrive or be dropped at most once."""
    by_id = {packet.packet_id: packet for packet in sent}
    packet_ids = [event.packet_id for event in arrivals] + [event.packet_id for event in drops]
    assert len(packet_ids) == len(set(packet_ids)), "a packet arrived or was dropped twice"
    for arrival in arrivals:
        assert arrival.receiver == by_id[arrival.packet_id].destination
    assert [event.at_ns for event in arrivals] == sorted(event.at_ns for event in arrivals)
    return Outcome(
        {by_id[event.packet_id].identity: event.at_ns for event in arrivals},
        {by_id[event.packet_id].identity: event.reason for event in drops},
    )
