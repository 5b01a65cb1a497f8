"""The agents of a co-simulation with real programs: their packets are read from devices, in real time."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, Protocol

from typing_extensions import override

from sim_backends.cosim.agents import Agents, SentDatagram
from sim_backends.federates.protocols import PhysicsFederate
from sim_backends.network.bare_ip import BROADCAST, UNICAST, broadcast_flow
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.world.motion import State

_KEPT_PACKETS: Final = 5000
"""Number of recent packets whose contents are kept for the recording of radio frames (`air.pcap`); more than the send
queues of three radios can hold."""


class RealPacket(NamedTuple):
    """A packet that a robot's kernel has sent.

    Attributes:
        at_ns: Simulated time at which it was read from its device.
        source: Name of the robot.
        destination: Name of the receiver; None for a broadcast.
        content: The packet as it was read from its device.
        size_bytes: Its size on the air, without MAC header.
        waited_ns: Longest time that it may have waited to be read.
    """

    at_ns: int
    source: str
    destination: str | None
    content: bytes
    size_bytes: int
    waited_ns: int


class Devices(Protocol):
    """The devices of all robots, in simulated time."""

    def wait(self, until_ns: int) -> None:
        """Wait until this time; meanwhile read packets and answer the lab's requests on the control socket."""
        ...

    def wait_for_packet(self, until_ns: int) -> None:
        """Wait until a packet has been read, at most until this time; meanwhile answer no requests of the lab."""
        ...

    def first_ns(self) -> int | None:
        """Return the time of the first packet that `pop_packets` has not returned yet, or None."""
        ...

    def pop_packets(self, last_ns: int) -> list[RealPacket]:
        """Remove and return the packets that were read up to a time, in order of time."""
        ...

    def receivers(self, source: str) -> Sequence[str]:
        """Return the stations that a broadcast of a robot addresses."""
        ...


class RealAgents(Agents):
    """Robots with real programs. A synchronization window lasts until the wall clock reaches its end.

    The next event of a program is unknown until it happens. Policies that need its time wait for the event for at
    most one physics step. If there is no event, they get the time of that step.

    Args:
        physics: Moves the robots, and receives the commands of their programs.
        devices: Their devices.

    Attributes:
        delivered_packets: The payloads of the packets that arrived since the list was cleared, in order.
    """

    def __init__(self, physics: PhysicsFederate, devices: Devices) -> None:
        super().__init__(physics, {})
        self.delivered_packets: list[RealPacket] = []
        self._devices = devices
        # End of the last window.
        self._reached_ns = 0
        # Number of the last packet of each flow.
        self._numbers: dict[str, int] = {}
        self._contents: dict[PacketIdentity, bytes] = {}

    @override
    def next_wake_ns(self) -> int:
        step_ns = self.physics.step_ns
        limit_ns = (self._reached_ns // step_ns + 1) * step_ns
        self._devices.wait_for_packet(limit_ns)
        first_ns = self._devices.first_ns()
        return limit_ns if first_ns is None else max(first_ns, self._reached_ns)

    @override
    def next_send_ns(self) -> int:
        return self._reached_ns

    @override
    def deliver(self, receiver: str, received_datagram: ReceivedDatagram) -> None:
        self.delivered_packets.append(received_datagram.payload)

    @property
    @override
    def has_undelivered(self) -> bool:
        return False

    @override
    def advance(self, now_ns: int, last_ns: int, end_ns: int) -> tuple[list[SentDatagram], Mapping[str, State]]:
        self._devices.wait(end_ns)
        packets = self._devices.pop_packets(last_ns)
        states = self.states(end_ns)
        self._reached_ns = end_ns
        return ([sent for packet in packets for sent in self._datagrams(packet, states)] if packets else []), states

    def content(self, identity: PacketIdentity) -> bytes:
        """Return the content of the packet with this identity (flow and number); empty if it is no longer kept."""
        return self._contents.get(identity, b"")

    def _store_content(self, identity: PacketIdentity, content: bytes) -> None:
        contents = self._contents
        contents[identity] = content
        if len(contents) > _KEPT_PACKETS:
            del contents[next(iter(contents))]

    def _datagrams(self, packet: RealPacket, states: Mapping[str, State]) -> list[SentDatagram]:
        """Return the datagram of a packet, or one per receiver of a broadcast."""
        source = packet.source
        if packet.destination is not None:
            flow = f"{source} > {packet.destination}"
            number = self._numbers[flow] = self._numbers.get(flow, -1) + 1
            self._store_content((flow, number), packet.content)
            datagram = Datagram(packet.destination, packet.size_bytes, flow, number, packet, UNICAST)
            return [SentDatagram(packet.at_ns, source, datagram, states)]
        flow = broadcast_flow(source)
        number = self._numbers[flow] = self._numbers.get(flow, -1) + 1
        self._store_content((flow, number), packet.content)
        return [
            SentDatagram(
                packet.at_ns,
                source,
                Datagram(name, packet.size_bytes, f"{flow}: {name}", number, packet, BROADCAST),
                states,
            )
            for name in self._devices.receivers(source)
        ]
