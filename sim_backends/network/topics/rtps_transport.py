"""Publish-subscribe as in DDS, by RTPS and without a master."""

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
    """The transport of packets on topics: each flow has its own writer and reader.

    A subscriber receives data by unicast, as in CycloneDDS if multicast is restricted to discovery (`AllowMulticast:
    spdp`); this is recommended for Wi-Fi, where multicast has no link-layer acknowledgement. A program continues
    while its writer is blocked: its samples are queued. A subscriber reads samples immediately, so that its
    history is never full.

    Not modelled: durability other than volatile, HEARTBEAT_FRAG, which is optional, and the topics that ROS 2 adds to
    every node.

    Args:
        wire: The network below.
        flows: All flows of the scenario that use topics, by name.
        discovery: Times of the discovery; None matches all endpoints from the start, without any traffic.
        timing: Times of the protocol; None for the times of CycloneDDS.
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
                session.writer.match(has_responded=True)
                session.reader.match(request_heartbeat=False)

    @property
    def is_matched(self) -> bool:
        """True if the writer and the reader of every flow are matched."""
        sessions = [self._sessions[name] for name in self._flows]
        return all(session.writer.is_matched and session.reader.is_matched for session in sessions)

    def send(self, packet: Packet) -> None:
        """Implement `Transport.send`.

        Raises:
            ConfigurationError: The packet belongs to an unknown flow.
        """
        name, number = packet.identity
        if name not in self._flows:
            raise ConfigurationError(
                f"{packet.source} publishes in the flow {name!r}, which has no topic",
                remedy=did_you_mean(name, self._flows, "flows: " + ", ".join(self._flows)),
            )
        writer = self._sessions[name].writer
        if writer.is_matched:
            writer.write(Sample(packet.size_bytes, number, packet.packet_id))
        else:
            self._wire.drop(packet.packet_id, NOT_MATCHED)

    def receive(self, host: str, packet: IpPacket) -> None:
        """Implement `Transport.receive`."""
        if self._discovery is not None:
            self._discovery.renew_lease(host, packet.source)
        if isinstance(packet.body, RtpsMessage):
            self._sessions[packet.body.flow].receive(host, packet.body)
        elif self._discovery is not None:
            self._discovery.receive(host, packet.source, packet.body)

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Implement `Transport.record_loss`."""
        if isinstance(packet.body, RtpsMessage):
            self._sessions[packet.body.flow].record_loss(packet.body, reason)

    def _deliver(self, sample: Sample) -> None:
        self._wire.deliver(sample.packet_id)

    def _drop(self, sample: Sample, reason: str) -> None:
        self._wire.drop(sample.packet_id, reason)
