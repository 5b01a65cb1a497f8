"""Packets of a co-simulation and what becomes of them; times are integer nanoseconds of simulated time."""

from dataclasses import dataclass
from typing import Any

from sim_backends.radio.random_streams import PacketIdentity


@dataclass(frozen=True, slots=True)
class Datagram:
    """What a program hands to its agent's network.

    Attributes:
        destination: Name of the agent that it is for.
        size_bytes: Size of the packet.
        flow: Stream of packets that it belongs to; names are unique in a scenario.
        number: Which it is of its flow: with the flow its identity, by which runs are compared.
        payload: What the receiver's program gets; the network never sees it.
        protocol: Name of the transport that carries it.
    """

    destination: str
    size_bytes: int
    flow: str
    number: int
    payload: Any = None
    protocol: str = "udp"


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet as the network sees it.

    Attributes:
        packet_id: Counts the packets of a run.
        source: Who sends it.
        destination: Who shall get it.
        size_bytes: Its size.
        identity: Flow and number, by which random draws are keyed.
        sent_ns: When its program sent it.
        enters_ns: When the network gets it: later than `sent_ns` where a policy keeps it until then.
        protocol: Name of the transport that carries it.
    """

    packet_id: int
    source: str
    destination: str
    size_bytes: int
    identity: PacketIdentity
    sent_ns: int
    enters_ns: int
    protocol: str = "udp"


@dataclass(frozen=True, slots=True)
class Arrival:
    """A packet that arrived.

    Attributes:
        packet_id: Which.
        receiver: At whom.
        at_ns: When, by the network's clock.
    """

    packet_id: int
    receiver: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class Drop:
    """A packet that never arrives.

    Attributes:
        packet_id: Which.
        reason: Why, in a few words.
    """

    packet_id: int
    reason: str


@dataclass(frozen=True, slots=True)
class Received:
    """A datagram as its receiver's program gets it.

    Attributes:
        source: Who sent it.
        payload: What it says.
        sent_ns: When its program sent it.
        arrived_ns: When it arrived, by the time that the policy gives it.
    """

    source: str
    payload: Any
    sent_ns: int
    arrived_ns: int
