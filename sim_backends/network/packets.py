"""Packets of a co-simulation and their results; times are integer nanoseconds of simulated time.

Classes with an object per packet are tuples, which are faster to create than frozen dataclasses.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

from sim_backends.radio.core.random_streams import PacketIdentity


@dataclass(frozen=True, slots=True)
class Datagram:
    """A message that a program passes to its agent's network.

    Attributes:
        destination: Name of the receiving agent.
        size_bytes: Size of the message, without the headers that its transport adds.
        flow: Stream of packets to which it belongs; names are unique in a scenario.
        number: Number of the packet in its flow; flow and number identify the packet when runs are compared.
        payload: Content for the receiver's program; the network does not inspect it.
        protocol: Name of the transport that carries it.
    """

    destination: str
    size_bytes: int
    flow: str
    number: int
    payload: Any = None
    protocol: str = "udp"


class Packet(NamedTuple):
    """A packet in the network.

    Attributes:
        packet_id: Number of the packet in the run.
        source: Name of the sender.
        destination: Name of the receiver.
        size_bytes: Its size, without the headers that its transport adds.
        identity: Flow and number, from which random numbers are derived.
        sent_ns: Time at which its program sent it.
        enters_ns: Time at which the network receives it; later than `sent_ns` if the sync policy delays it.
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


class Arrival(NamedTuple):
    """A packet that arrived.

    Attributes:
        packet_id: Its number.
        receiver: Name of the receiver.
        at_ns: Arrival time in the network.
    """

    packet_id: int
    receiver: str
    at_ns: int


class Drop(NamedTuple):
    """A packet that will never arrive.

    Attributes:
        packet_id: Its number.
        reason: The reason, in a few words.
    """

    packet_id: int
    reason: str


class ReceivedDatagram(NamedTuple):
    """A datagram as it is passed to the receiver's program.

    Attributes:
        source: Name of the sender.
        payload: Its content.
        sent_ns: Time at which its program sent it.
        arrived_ns: Arrival time; the sync policy assigns it.
    """

    source: str
    payload: Any
    sent_ns: int
    arrived_ns: int
