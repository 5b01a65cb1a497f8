"""Publish-subscribe as DDS does it by RTPS, without any master."""

from collections.abc import Mapping
from typing import Final

from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.network.packets import Packet
from sim_backends.network.topics.discovery import DiscoveryTiming, TopicDiscovery
from sim_backends.network.topics.flow import NOT_MATCHED, TopicSession
from sim_backends.network.topics.qos import RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import RtpsMessage, Sample
from sim_backends.network.wire import IpPacket, Wire

_DISCOVERY: Final = DiscoveryTiming()


class Topics:
    """The transport of packets that go by topics: each flow has a writer and a reader of its own.

    A subscriber gets what is published to it by unicast, as CycloneDDS sends where multicast is kept to discovery
    (`AllowMulticast: spdp`), which is the advice for Wi-Fi: multicast has no link-layer acknowledgement there. A
    program does not stand still while its writer is blocked: what it publishes meanwhile waits its turn. A subscriber
    takes samples at once, so that its own history is never full.

    Left out: durability other than volatile, HEARTBEAT_FRAG, which is advice only, and the topics that ROS 2 adds to
    every node.

    Args:
        wire: What messages go over.
        flows: Every flow of the scenario that goes by topics, by its name.
        discovery: When participants announce themselves; None matches all endpoints from the beginning, without any
            traffic.
        timing: Of the protocol; None is CycloneDDS's.
    """

    def __init__(
        self,
        wire: Wire,
        flows: Mapping[str, TopicFlow],
        *,
        discovery: DiscoveryTiming | None = _DISCOVERY,
        timing: RtpsTiming | None = None,
    ) -> None:
        self._wire = wire
        self._flows = flows
        timing = timing or RtpsTiming()
        self._sessions = {
            name: TopicSession(wire, name, flow, timing, deliver=self._deliver, drop=self._drop)
            for name, flow in sorted(flows.items())
        }
        self._discovery = TopicDiscovery(wire, flows, self._sessions, timing, discovery) if discovery else None
        if self._discovery is None:
            for session in self._sessions.values():
                session.writer.match(answered=True)
                session.reader.match(begin=False)

    @property
    def matched(self) -> bool:
        """Whether the writer and the reader of every flow have found each other."""
        sessions = [self._sessions[name] for name in self._flows]
        return all(session.writer.matched and session.reader.matched for session in sessions)

    def send(self, packet: Packet) -> None:
        """See `Transport.send`.

        Raises:
            ConfigurationError: The packet is of no flow that is known.
        """
        name, number = packet.identity
        if name not in self._flows:
            raise ConfigurationError(
                f"{packet.source} publishes in a flow {name!r} that no topic is known for",
                remedy=did_you_mean(name, self._flows, "flows: " + ", ".join(self._flows)),
            )
        writer = self._sessions[name].writer
        if writer.matched:
            writer.write(Sample(packet.size_bytes, number, packet.packet_id))
        else:
            self._wire.drop(packet.packet_id, NOT_MATCHED)

    def receive(self, host: str, packet: IpPacket) -> None:
        """See `Transport.receive`."""
        if self._discovery is not None:
            self._discovery.heard(host, packet.source)
        if isinstance(packet.body, RtpsMessage):
            self._sessions[packet.body.flow].receive(host, packet.body)
        elif self._discovery is not None:
            self._discovery.receive(host, packet.source, packet.body)

    def lost(self, packet: IpPacket, reason: str) -> None:
        """See `Transport.lost`."""
        if isinstance(packet.body, RtpsMessage):
            self._sessions[packet.body.flow].lost(packet.body, reason)

    def _deliver(self, sample: Sample) -> None:
        self._wire.deliver(sample.packet_id)

    def _drop(self, sample: Sample, reason: str) -> None:
        self._wire.drop(sample.packet_id, reason)
