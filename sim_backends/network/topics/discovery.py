"""Discovery in publish-subscribe, as in DDSI-RTPS 2.5, clause 8.5.

Each agent has one participant. Participants discover each other by SPDP (Simple Participant Discovery Protocol), and
then their writers and readers (endpoints) by SEDP (Simple Endpoint Discovery Protocol).

No master is needed. A participant announces itself by multicast. A participant that receives an announcement for the
first time responds by unicast, and sends its publications and subscriptions over reliable built-in topics. CycloneDDS
packs the data of these topics for one participant into one message. Here the topics are one flow, and each of its
messages has the heartbeats and acknowledgements of all topics. If nothing is received from a participant for the
duration of a lease, it is removed with all its endpoints, and may be discovered again. Times are taken from
CycloneDDS (`ddsi_spdp_schedule.c`, `ddsi_discovery_spdp.c`); sizes were measured on version 11.0.1 from PyPI. Its
participants respond to a new participant immediately and three more times at intervals of a second; no random delay
separates the responses of different participants (`SPDPResponseMaxDelay` is 0 ms). The traffic of n participants
grows with n^2.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from sim_backends.network.topics.flow import TRANSPORT, TopicSession
from sim_backends.network.topics.qos import MS, SECOND, Qos, RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import IP_AND_UDP_BYTES, RTPS_HEADER_BYTES, Heartbeat, Sample
from sim_backends.network.wire import IpPacket, Wire, WireTimer

SPDP_BYTES: Final = 436
"""Size of an announcement with the IP header: INFO_DST, INFO_TS, and DATA of 360 bytes."""
_BUILTIN_TOPICS: Final = 5
"""Number of built-in topics with heartbeats and acknowledgements in a message: publications, subscriptions,
liveliness, and the requests and replies of type lookup.
"""
_LIVELINESS_BYTES: Final = 28
"""Size of the data by which a participant asserts its liveliness."""
_WRITER_BYTES: Final = 200
_READER_BYTES: Final = 212
"""Sizes of the SEDP data of a writer and of a reader, without the names of topic and type."""
_DIRECTED_RESPONSES: Final = 4
"""Number of responses to the announcement of a new participant."""
_LEASE_EXPIRED: Final = "the lease of the subscriber expired"


@dataclass(frozen=True)
class DiscoveryTiming:
    """Times of the discovery.

    Attributes:
        lease_ns: Time without messages after which a participant is removed.
        second_announcement_ns: Time from a participant's first announcement to its second.
        period_ns: Interval of later announcements; in CycloneDDS the lease minus 2 s.
        directed_ns: Interval of the four responses to the announcement of a new participant.
        starts_ns: Start times of participants, by name; others start at 0.
    """

    lease_ns: int = 10 * SECOND
    second_announcement_ns: int = 100 * MS
    period_ns: int = 8 * SECOND
    directed_ns: int = SECOND
    starts_ns: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Announcement:
    """An SPDP message.

    Attributes:
        is_directed: True if it responds to an announcement and needs no response.
    """

    is_directed: bool


@dataclass(frozen=True, slots=True)
class SharedHeartbeats:
    """Heartbeats for several participants in one multicast message.

    Attributes:
        by_peer: Heartbeat for each peer; in reality a built-in writer sends the same heartbeat to all of them.
    """

    by_peer: Mapping[str, Heartbeat]


@dataclass(slots=True)
class _RemoteParticipant:
    """The state of a remote participant at one participant.

    Attributes:
        lease_timer: Fires when the lease may have expired.
        last_renewal_ns: Time of the last message from it.
        is_alive: True from its announcement until its lease expires.
    """

    lease_timer: WireTimer
    last_renewal_ns: int = 0
    is_alive: bool = False


class TopicDiscovery:
    """Matches the writers and readers of flows when their participants discover each other.

    Args:
        wire: The network below.
        flows: All flows, by name.
        sessions: Their sessions, by the same names; sessions of the discovery's built-in topics are added.
        timing: Times of the protocol.
        discovery_timing: Times of the discovery.
    """

    def __init__(
        self,
        wire: Wire,
        flows: Mapping[str, TopicFlow],
        sessions: dict[str, TopicSession],
        timing: RtpsTiming,
        discovery_timing: DiscoveryTiming,
    ) -> None:
        self._wire = wire
        self._flows = dict(sorted(flows.items()))
        self._sessions = sessions
        self._user_sessions = dict(sessions)
        self._timing = timing
        self._discovery_timing = discovery_timing
        # State of a remote participant, by the participant that has discovered it, and its own name.
        self._remote_participants: dict[tuple[str, str], _RemoteParticipant] = {}
        self._announcement_counts: dict[tuple[str, str], int] = {}
        # Heartbeats that a participant sends in one message now, by its name and the peer.
        self._collected_heartbeats: dict[str, dict[str, Heartbeat]] = {}
        self._shared_counts: dict[str, int] = {}  # messages with shared heartbeats
        self._participants = sorted({end for flow in flows.values() for end in (flow.publisher, flow.subscriber)})
        for participant in self._participants:
            starts_ns = max(discovery_timing.starts_ns.get(participant, 0), wire.now_ns)
            wire.at(starts_ns, participant, partial(self._start, participant))

    def renew_lease(self, host: str, peer: str) -> None:
        """Record that a message from `peer` arrived at `host`; it renews the lease of the peer."""
        remote_participant = self._remote_participants.get((host, peer))
        if remote_participant is not None and remote_participant.is_alive:
            remote_participant.last_renewal_ns = self._wire.now_ns

    def receive(self, host: str, peer: str, message: Announcement | SharedHeartbeats) -> None:
        """Process a message of `peer` that arrived at `host`."""
        if isinstance(message, Announcement):
            self._on_announcement(host, peer, is_directed=message.is_directed)
        elif (heartbeat := message.by_peer.get(host)) is not None:
            self._sedp_session(peer, host).reader.on_message(heartbeat)

    def _on_announcement(self, host: str, peer: str, *, is_directed: bool) -> None:
        """Process an announcement of `peer` at `host`; discover the peer if it is new or its lease had expired."""
        if self._wire.now_ns < self._discovery_timing.starts_ns.get(host, 0) or host not in self._participants:
            return
        remote_participant = self._remote_participants.get((host, peer))
        if remote_participant is None:
            remote_participant = self._remote_participants[host, peer] = _RemoteParticipant(
                WireTimer(self._wire, host, partial(self._check_lease, host, peer))
            )
        if remote_participant.is_alive:
            return
        remote_participant.is_alive = True
        remote_participant.last_renewal_ns = self._wire.now_ns
        remote_participant.lease_timer.bring_forward(self._wire.now_ns + self._discovery_timing.lease_ns)
        if not is_directed:
            self._respond(host, peer, _DIRECTED_RESPONSES)
        self._start_sedp(host, peer)

    def _start(self, participant: str) -> None:
        """Announce a participant when it starts, and schedule its later announcements."""
        now_ns, timing = self._wire.now_ns, self._discovery_timing
        self._announce(participant)
        self._wire.at(now_ns + timing.second_announcement_ns, participant, partial(self._announce, participant))
        self._wire.at(
            now_ns + timing.second_announcement_ns + timing.period_ns, participant, partial(self._repeat, participant)
        )

    def _repeat(self, participant: str) -> None:
        """Announce a participant and assert its liveliness periodically."""
        self._announce(participant)
        for peer in self._participants:
            if (
                remote_participant := self._remote_participants.get((participant, peer))
            ) is not None and remote_participant.is_alive:
                writer = self._sedp_session(participant, peer).writer
                writer.write(Sample(_LIVELINESS_BYTES, writer.last + 1))
        self._wire.at(
            self._wire.now_ns + self._discovery_timing.period_ns, participant, partial(self._repeat, participant)
        )

    def _announce(self, participant: str, peer: str = "") -> None:
        """Announce a participant to all participants, or to one peer."""
        number = self._announcement_counts[participant, peer] = (
            self._announcement_counts.get((participant, peer), -1) + 1
        )
        key = f"spdp {participant} {peer}", number
        body = Announcement(is_directed=bool(peer))
        self._wire.transmit(IpPacket(participant, peer or None, TRANSPORT, SPDP_BYTES, key, body))

    def _respond(self, host: str, peer: str, count: int) -> None:
        """Send a response to the announcement of a new participant, and schedule the remaining ones."""
        if count and self._remote_participants[host, peer].is_alive:
            self._announce(host, peer)
            next_ns = self._wire.now_ns + self._discovery_timing.directed_ns
            self._wire.at(next_ns, host, partial(self._respond, host, peer, count - 1))

    def _start_sedp(self, host: str, peer: str) -> None:
        """Start to send the endpoints of `host` to `peer`, and to receive the peer's endpoints."""
        self._sedp_session(host, peer).writer.match()
        self._sedp_session(peer, host).reader.match()
        self._offer_endpoints(host, peer)

    def _sedp_session(self, host: str, peer: str) -> TopicSession:
        """Return the session in which `host` sends its endpoints to `peer`."""
        name = f"rtps {host} {peer}"
        if name not in self._sessions:
            session = self._sessions[name] = TopicSession(
                self._wire,
                name,
                TopicFlow(host, peer, Qos(history="keep_all")),
                self._timing,
                deliver=partial(self._on_endpoint, peer, host),
                drop=_ignore_loss,
                topics=_BUILTIN_TOPICS,
            )
            session.writer.on_reader_start = partial(self._offer_endpoints, host, peer)
            session.writer.share_heartbeat = partial(self._collect_heartbeat, host, peer)
        return self._sessions[name]

    def _collect_heartbeat(self, host: str, peer: str, heartbeat: Heartbeat) -> None:
        """Collect heartbeats of the same time, to send them in one message."""
        heartbeats = self._collected_heartbeats.setdefault(host, {})
        if not heartbeats:
            self._wire.at(self._wire.now_ns, host, partial(self._send_shared_heartbeats, host))
        heartbeats[peer] = heartbeat

    def _send_shared_heartbeats(self, host: str) -> None:
        heartbeats = self._collected_heartbeats.pop(host)
        number = self._shared_counts[host] = self._shared_counts.get(host, -1) + 1
        size_bytes = IP_AND_UDP_BYTES + RTPS_HEADER_BYTES
        size_bytes += _BUILTIN_TOPICS * max(heartbeat.size_bytes for heartbeat in heartbeats.values())
        key = f"rtps {host} heartbeats", number
        self._wire.transmit(IpPacket(host, None, TRANSPORT, size_bytes, key, SharedHeartbeats(heartbeats)))

    def _offer_endpoints(self, host: str, peer: str) -> None:
        """Add the endpoints of `host` to the writer for `peer`, unless added endpoints are still unacknowledged."""
        writer = self._sedp_session(host, peer).writer
        if any(sample.endpoint_flow for sample in writer.unacknowledged):
            return
        for name, flow in self._flows.items():
            for agent, is_publisher in ((flow.publisher, True), (flow.subscriber, False)):
                if agent == host:
                    size_bytes = _endpoint_bytes(flow, is_writer=is_publisher)
                    writer.add_historical(Sample(size_bytes, writer.last + 1, endpoint_flow=name))

    def _on_endpoint(self, host: str, peer: str, sample: Sample) -> None:
        """Match an endpoint of `host` with the endpoint of `peer` whose data `host` has received."""
        flow = self._flows.get(sample.endpoint_flow)
        if flow is None or not self._remote_participants[host, peer].is_alive:
            return
        session = self._user_sessions[sample.endpoint_flow]
        if (flow.publisher, flow.subscriber) == (peer, host) and not session.reader.is_matched:
            session.reader.match()
        elif (flow.publisher, flow.subscriber) == (host, peer) and not session.writer.is_matched:
            session.writer.match()

    def _check_lease(self, host: str, peer: str) -> None:
        remote_participant = self._remote_participants[host, peer]
        expires_ns = remote_participant.last_renewal_ns + self._discovery_timing.lease_ns
        if self._wire.now_ns < expires_ns:
            remote_participant.lease_timer.bring_forward(expires_ns)
            return
        remote_participant.is_alive = False
        self._sedp_session(host, peer).writer.remove_reader(_LEASE_EXPIRED)
        self._sedp_session(peer, host).unmatch_reader()
        for name, flow in self._flows.items():
            if (flow.publisher, flow.subscriber) == (host, peer):
                self._user_sessions[name].writer.remove_reader(_LEASE_EXPIRED)
            elif (flow.subscriber, flow.publisher) == (host, peer):
                self._user_sessions[name].unmatch_reader()


def _ignore_loss(sample: Sample, reason: str) -> None:
    """Ignore the loss of a sample of the discovery; no statistics include it."""


def _endpoint_bytes(flow: TopicFlow, *, is_writer: bool) -> int:
    """Return the SEDP size of an endpoint; names end with a zero byte and are padded to multiples of 4 bytes."""
    names = sum(-(-(len(name.encode()) + 1) // 4) * 4 for name in (flow.topic, flow.type_name))
    return names + (_WRITER_BYTES if is_writer else _READER_BYTES)
