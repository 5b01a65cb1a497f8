"""Discovery of publish-subscribe: participants by SPDP, their endpoints by SEDP (DDSI-RTPS 2.5, clause 8.5).

Nothing but peers is needed. A participant announces itself by multicast; who hears of it for the first time answers
by unicast, and tells it over reliable built-in topics what it publishes and subscribes to. CycloneDDS packs what
these topics have to say to a participant into one message; here they are one flow, with heartbeats and
acknowledgements for all of them in each message. Whoever is not heard of for a lease is forgotten with all its
endpoints, and may be found again. Times are those of CycloneDDS
(`ddsi_spdp_schedule.c`, `ddsi_discovery_spdp.c`), and so are sizes, which were measured on version 11.0.1 from PyPI.
Its participants answer at once whom they hear of first, and three times more, a second apart; nothing keeps them from
talking together (`SPDPResponseMaxDelay` is 0 ms). What n of them tell each other grows with n^2.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from sim_backends.network.timer import WireTimer
from sim_backends.network.topics.flow import TRANSPORT, TopicSession
from sim_backends.network.topics.qos import MS, SECOND, Qos, RtpsTiming, TopicFlow
from sim_backends.network.topics.rtps import IP_AND_UDP_BYTES, RTPS_HEADER_BYTES, Heartbeat, Sample
from sim_backends.network.wire import IpPacket, Wire

SPDP_BYTES: Final = 436
"""Of an announcement, from the header of IP on: INFO_DST, INFO_TS, and DATA of 360."""
_BUILTIN_TOPICS: Final = 5
"""Whose heartbeats and acknowledgements a message holds: endpoints of two kinds, liveliness, and look-up of types."""
_LIVELINESS_BYTES: Final = 28
_WRITER_BYTES: Final = 200
_READER_BYTES: Final = 212
"""What SEDP tells of a writer and of a reader, without the names of topic and type."""
_DIRECTED: Final = 4
_LEASE: Final = "the subscriber's lease ran out"


@dataclass(frozen=True)
class DiscoveryTiming:
    """Times of the discovery.

    Attributes:
        lease_ns: For how long a participant that is not heard of is believed to be there.
        second_ns: From a participant's first announcement to its second.
        period_ns: From then on; CycloneDDS takes 2 s off the lease.
        directed_ns: Between the four answers to an announcement of somebody new.
        starts_ns: When participants start, by name; others start at 0.
    """

    lease_ns: int = 10 * SECOND
    second_ns: int = 100 * MS
    period_ns: int = 8 * SECOND
    directed_ns: int = SECOND
    starts_ns: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Announcement:
    """SPDP's message.

    Attributes:
        directed: Whether it answers one of another, and wants no answer.
    """

    directed: bool


@dataclass(frozen=True, slots=True)
class SharedHeartbeats:
    """Heartbeats for several participants at once, by multicast.

    Attributes:
        by_peer: For whom, and what it is told; in reality a built-in writer tells all of them the same.
    """

    by_peer: Mapping[str, Heartbeat]


@dataclass(slots=True)
class _Remote:
    """What a participant knows of another.

    Attributes:
        lease: Rings when it may have run out.
        heard_ns: When it was heard of last.
        alive: Whether it is believed to be there.
    """

    lease: WireTimer
    heard_ns: int = 0
    alive: bool = False


class TopicDiscovery:
    """Matches the writers and readers of flows as their participants find each other.

    Args:
        wire: What messages go over.
        flows: All flows, by name.
        sessions: Theirs, by the same names; those of the discovery's own topics are added.
        timing: Of the protocol.
        times: Of the discovery.
    """

    def __init__(
        self,
        wire: Wire,
        flows: Mapping[str, TopicFlow],
        sessions: dict[str, TopicSession],
        timing: RtpsTiming,
        times: DiscoveryTiming,
    ) -> None:
        self._wire = wire
        self._flows = dict(sorted(flows.items()))
        self._sessions = sessions
        self._user_sessions = dict(sessions)
        self._timing = timing
        self._times = times
        self._remotes: dict[tuple[str, str], _Remote] = {}
        self._announced: dict[tuple[str, str], int] = {}
        self._gathered: dict[str, dict[str, Heartbeat]] = {}
        self._shared: dict[str, int] = {}
        self._participants = sorted({end for flow in flows.values() for end in (flow.publisher, flow.subscriber)})
        for participant in self._participants:
            starts_ns = max(times.starts_ns.get(participant, 0), wire.now_ns)
            wire.at(starts_ns, participant, partial(self._start, participant))

    def heard(self, host: str, peer: str) -> None:
        """Take it that a message from `peer` arrived at `host`, which renews its lease."""
        remote = self._remotes.get((host, peer))
        if remote is not None and remote.alive:
            remote.heard_ns = self._wire.now_ns

    def receive(self, host: str, peer: str, message: Announcement | SharedHeartbeats) -> None:
        """Take a message of `peer` that arrived at `host`."""
        if isinstance(message, Announcement):
            self._take_announcement(host, peer, directed=message.directed)
        elif (heartbeat := message.by_peer.get(host)) is not None:
            self._between(peer, host).reader.take(heartbeat)

    def _take_announcement(self, host: str, peer: str, *, directed: bool) -> None:
        if self._wire.now_ns < self._times.starts_ns.get(host, 0) or host not in self._participants:
            return
        remote = self._remotes.get((host, peer))
        if remote is None:
            remote = self._remotes[host, peer] = _Remote(
                WireTimer(self._wire, host, partial(self._check_lease, host, peer))
            )
        if remote.alive:
            return
        remote.alive = True
        remote.heard_ns = self._wire.now_ns
        remote.lease.bring_forward(self._wire.now_ns + self._times.lease_ns)
        if not directed:
            self._answer(host, peer, _DIRECTED)
        self._meet(host, peer)

    def _start(self, participant: str) -> None:
        now_ns, times = self._wire.now_ns, self._times
        self._announce(participant)
        self._wire.at(now_ns + times.second_ns, participant, partial(self._announce, participant))
        self._wire.at(now_ns + times.second_ns + times.period_ns, participant, partial(self._repeat, participant))

    def _repeat(self, participant: str) -> None:
        """Announce and assert liveliness, again and again."""
        self._announce(participant)
        for peer in self._participants:
            if (remote := self._remotes.get((participant, peer))) is not None and remote.alive:
                writer = self._between(participant, peer).writer
                writer.write(Sample(_LIVELINESS_BYTES, writer.last + 1))
        self._wire.at(self._wire.now_ns + self._times.period_ns, participant, partial(self._repeat, participant))

    def _announce(self, participant: str, peer: str = "") -> None:
        """Announce a participant to everybody, or to one."""
        number = self._announced[participant, peer] = self._announced.get((participant, peer), -1) + 1
        key = f"spdp {participant} {peer}", number
        body = Announcement(directed=bool(peer))
        self._wire.transmit(IpPacket(participant, peer or None, TRANSPORT, SPDP_BYTES, key, body))

    def _answer(self, host: str, peer: str, times: int) -> None:
        if times and self._remotes[host, peer].alive:
            self._announce(host, peer)
            again_ns = self._wire.now_ns + self._times.directed_ns
            self._wire.at(again_ns, host, partial(self._answer, host, peer, times - 1))

    def _meet(self, host: str, peer: str) -> None:
        """Begin to tell `peer` of the endpoints of `host`, and to listen to its own."""
        self._between(host, peer).writer.match()
        self._between(peer, host).reader.match()
        self._tell(host, peer)

    def _between(self, host: str, peer: str) -> TopicSession:
        """Return the session by which `host` tells `peer` about itself."""
        name = f"rtps {host} {peer}"
        if name not in self._sessions:
            session = self._sessions[name] = TopicSession(
                self._wire,
                name,
                TopicFlow(host, peer, Qos(history="keep_all")),
                self._timing,
                deliver=partial(self._told, peer, host),
                drop=_forget,
                topics=_BUILTIN_TOPICS,
            )
            session.writer.begun = partial(self._tell, host, peer)
            session.writer.share = partial(self._gather, host, peer)
        return self._sessions[name]

    def _gather(self, host: str, peer: str, heartbeat: Heartbeat) -> None:
        """Send heartbeats of the same time together."""
        gathered = self._gathered.setdefault(host, {})
        if not gathered:
            self._wire.at(self._wire.now_ns, host, partial(self._share, host))
        gathered[peer] = heartbeat

    def _share(self, host: str) -> None:
        heartbeats = self._gathered.pop(host)
        number = self._shared[host] = self._shared.get(host, -1) + 1
        size_bytes = IP_AND_UDP_BYTES + RTPS_HEADER_BYTES
        size_bytes += _BUILTIN_TOPICS * max(one.size_bytes for one in heartbeats.values())
        key = f"rtps {host} heartbeats", number
        self._wire.transmit(IpPacket(host, None, TRANSPORT, size_bytes, key, SharedHeartbeats(heartbeats)))

    def _tell(self, host: str, peer: str) -> None:
        """Offer what `host` publishes and subscribes to `peer`, unless any of that is on offer already."""
        writer = self._between(host, peer).writer
        if any(sample.tells for sample in writer.unacknowledged):
            return
        for name, flow in self._flows.items():
            for agent, publishes in ((flow.publisher, True), (flow.subscriber, False)):
                if agent == host:
                    size_bytes = _endpoint_bytes(flow, writer=publishes)
                    writer.offer(Sample(size_bytes, writer.last + 1, tells=name))

    def _told(self, host: str, peer: str, sample: Sample) -> None:
        """Match an endpoint of `host` with one of `peer` that it has now been told of."""
        flow = self._flows.get(sample.tells)
        if flow is None or not self._remotes[host, peer].alive:
            return
        session = self._user_sessions[sample.tells]
        if (flow.publisher, flow.subscriber) == (peer, host) and not session.reader.matched:
            session.reader.match()
        elif (flow.publisher, flow.subscriber) == (host, peer) and not session.writer.matched:
            session.writer.match()

    def _check_lease(self, host: str, peer: str) -> None:
        remote = self._remotes[host, peer]
        ends_ns = remote.heard_ns + self._times.lease_ns
        if self._wire.now_ns < ends_ns:
            remote.lease.bring_forward(ends_ns)
            return
        remote.alive = False
        self._between(host, peer).writer.unmatch(_LEASE)
        self._between(peer, host).unmatch_reader()
        for name, flow in self._flows.items():
            if (flow.publisher, flow.subscriber) == (host, peer):
                self._user_sessions[name].writer.unmatch(_LEASE)
            elif (flow.subscriber, flow.publisher) == (host, peer):
                self._user_sessions[name].unmatch_reader()


def _forget(sample: Sample, reason: str) -> None:
    """Take it that a sample of the discovery was lost, which no account is kept of."""


def _endpoint_bytes(flow: TopicFlow, *, writer: bool) -> int:
    """Return the size of what SEDP tells of an endpoint; names end with a zero and fill whole words of 4 bytes."""
    names = sum(-(-(len(name.encode()) + 1) // 4) * 4 for name in (flow.topic, flow.type_name))
    return names + (_WRITER_BYTES if writer else _READER_BYTES)
