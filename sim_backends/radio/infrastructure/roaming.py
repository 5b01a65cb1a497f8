"""Association of robots with access points between which they roam: beacons, scans, association and its loss.

All access points and robots share one channel here; a robot that scans neither sends nor receives packets. Probe
frames are omitted. A scan finds each access point that is linked with the robot when the scan ends. Beacons are sent
on the air as broadcasts; the frames of an association have retries. `benchmarks.roaming_vs_kernel` compares the times
with those of Linux 6.1.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from sim_backends.radio.infrastructure.background_scan import BackgroundScan, prefers_other
from sim_backends.radio.infrastructure.managed_delivery import ManagedDelivery, ManagementFrame
from sim_backends.radio.infrastructure_options import RoamingOptions
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.mac.power_save import BEACON_INTERVAL_NS
from sim_backends.radio.phy.transmissions import decibel

BEACON: Final = "beacon"
_NULL: Final = "null"

_BEACON_BYTES: Final = 192
"""Size with FCS of a beacon of hostapd with 802.11n and WPA2. This and the following sizes were recorded."""


class _Step(NamedTuple):
    """A frame of an association.

    Attributes:
        kind: Its kind.
        size_bytes: Its size with MAC header and FCS.
        is_from_robot: True if the robot sends it.
        timeout_ns: Time after which it is sent again if it was not received: for responses and requests
            `IEEE80211_AUTH_TIMEOUT_SHORT` (`IEEE80211_AUTH_TIMEOUT_SAE` in SAE) and `IEEE80211_ASSOC_TIMEOUT_SHORT`
            of mlme.c, for others the timeouts of hostapd's wpa_auth.c.
    """

    kind: str
    size_bytes: int
    is_from_robot: bool
    timeout_ns: int = 100_000_000


_AUTHENTICATION: Final = "authentication"
_REQUEST: Final = "reassociation request"
_OPEN: Final = (_Step(_AUTHENTICATION, 34, True), _Step(_AUTHENTICATION, 34, False))
_SAE: Final = tuple(
    _Step(_AUTHENTICATION, size, is_robot, 2_000_000_000) for size in (132, 68) for is_robot in (True, False)
)
_REASSOCIATION: Final = (_Step(_REQUEST, 159, True), _Step("reassociation response", 143, False))


def _handshake(*sizes_bytes: int) -> tuple[_Step, ...]:
    """Return the EAPOL-Key frames; hostapd waits for the second one longer, because the first was acknowledged."""
    first, second, third, fourth = sizes_bytes
    return (
        _Step("EAPOL-Key 1", first, False),
        _Step("EAPOL-Key 2", second, True, 1_000_000_000),
        _Step("EAPOL-Key 3", third, False),
        _Step("EAPOL-Key 4", fourth, True),
    )


_HANDSHAKE: Final = _handshake(137, 159, 193, 137)
_SAE_HANDSHAKE: Final = _handshake(159, 165, 225, 137)
_MAX_TRIES: Final = 3
"""Number of attempts at each frame: `IEEE80211_AUTH_MAX_TRIES` and `IEEE80211_ASSOC_MAX_TRIES` of mlme.c."""

BEACON_LOSS_NS: Final = 7 * BEACON_INTERVAL_NS
MONITOR_NS: Final = 1_000_000_000
"""Time without beacons after which a station tests its link, and the interval at which it examines this time: mlme.c
has one timer for this time, and `round_jiffies_up` rounds it up to a whole second."""
_NULL_BYTES: Final = 30
_NULL_FRAMES: Final = 2
"""Size with FCS of the null frame of such a test, and the number of null frames without an ACK after which the link
is lost: mlme.c, `max_nullfunc_tries`."""
_RECONNECT_NS: Final = 100_000_000
"""Time from the loss of a link until the next scan: events.c of wpa_supplicant."""

_SELECTION_NS: Final = 10_000_000
"""Time from the end of a scan until a robot leaves its access point: wpa_supplicant reads the results, and waiting
packets are delivered. It is an assumption; on an emulated processor it was 31 ms."""

_RESCAN_NS: Final = 5_000_000_000
"""Interval of scans without an association: the default of wpa_supplicant."""


@dataclass(slots=True)
class _Association:
    """A robot's association.

    Attributes:
        index: Index of the robot.
        access_point: The access point with which the robot is associated or is being associated, or None.
        scan: Schedule of its scans; None without an association.
        beacon_ns: Time of the last beacon, or of a later association, return to the channel, or ACK of a null frame.
        left_ns: Time at which the current scan has left the channel.
        null_frames: Number of null frames since the last beacon.
        is_busy: True during a scan or an association.
        exchange: Number of the current step of an association; events of other steps are ignored.
        step: Index of the frame that is sent next.
        tries: Number of attempts at that step.
        levels_dbm: Signals that the last scan found, by access point.
    """

    index: int
    access_point: int | None = None
    scan: BackgroundScan | None = None
    beacon_ns: int = 0
    left_ns: int = 0
    null_frames: int = 0
    is_busy: bool = False
    exchange: int = 0
    step: int = 0
    tries: int = 0
    levels_dbm: dict[int, float] = field(default_factory=dict)


class Roaming:
    """The association of each robot with an access point.

    Args:
        channel: Received powers.
        events: Scheduled events.
        delivery: The packets, with robots and access points.
        options: Options of roaming.
        phases_ns: Time of the first beacon of each access point, and first time at which each robot examines its
            link, by index.
        high_throughput: True if the radios are of 802.11n or later.
    """

    def __init__(
        self,
        channel: RadioChannel,
        events: EventQueue,
        delivery: ManagedDelivery[Any],
        options: RoamingOptions,
        phases_ns: Mapping[int, int],
        *,
        high_throughput: bool,
    ) -> None:
        self._channel = channel
        self._events = events
        self._delivery = delivery
        self._options = options
        self._steps = _association_steps(options)
        self._clients = {robot: _Association(robot) for robot in delivery.robots}
        self._phases_ns = phases_ns
        self._high_throughput = high_throughput
        self._dwell_ns, self._home_ns = round(options.dwell * 1e9), round(options.home * 1e9)
        self._away_ns = round(options.away * 1e9)
        self._processing_ns = round(options.processing * 1e9)
        self._has_started = False
        delivery.serving_access_point = dict.fromkeys(delivery.robots)
        for access_point in delivery.access_points:
            events.schedule(phases_ns[access_point], self._send_beacon, access_point)

    @property
    def cells(self) -> Mapping[int, int | None]:
        """Access point with which each robot is associated, by index; None if it is not, or not yet, associated."""
        return {
            robot: None if client.scan is None else client.access_point for robot, client in self._clients.items()
        }

    def start(self, now_ns: int) -> None:
        """Associate each robot with the strongest access point; a second call does nothing.

        Robots that cannot receive any access point scan until they find one.
        """
        if self._has_started:
            return
        self._has_started = True
        for client in self._clients.values():
            client.levels_dbm = self._levels_dbm(now_ns, client)
            strongest = self._strongest(client)
            if strongest is None:
                self._events.schedule(now_ns, self._scan, client)
            else:
                client.access_point = strongest
                self._complete_association(now_ns, client)
            self._events.schedule(self._monitor_ns(client), self._check_link, client)

    def on_management(self, now_ns: int, transmitter: int, receiver: int, frame: ManagementFrame) -> None:
        """Implement `ManagementHandler`."""
        if frame.kind == BEACON:
            client = self._clients.get(receiver)
            if client is not None and client.scan is not None and client.access_point == transmitter:
                self._on_beacon(now_ns, client, client.scan)
            return
        client = self._clients.get(receiver) or self._clients.get(transmitter)
        if client is None:
            return
        if frame.kind == _NULL:
            client.beacon_ns = now_ns
            client.null_frames = 0
        elif frame.number == client.exchange and client.scan is None:
            client.exchange += 1
            client.step += 1
            client.tries = 0
            self._events.schedule(now_ns + self._processing_ns, self._send_next, client, client.exchange)

    def _send_beacon(self, now_ns: int, access_point: int) -> None:
        self._events.schedule(now_ns + BEACON_INTERVAL_NS, self._send_beacon, access_point)
        if not self._delivery.count_waiting_management(access_point):
            self._delivery.send_management(now_ns, access_point, None, ManagementFrame(BEACON), _BEACON_BYTES)

    def _on_beacon(self, now_ns: int, client: _Association, scan: BackgroundScan) -> None:
        client.beacon_ns = now_ns
        client.null_frames = 0
        scan.on_beacon(now_ns, self._level_dbm(now_ns, client, client.access_point))
        if not client.is_busy and scan.next_ns <= now_ns:
            self._scan(now_ns, client)

    def on_management_lost(self, now_ns: int, transmitter: int, frame: ManagementFrame) -> None:
        """Implement `ManagementHandler`: a robot sends a request or null frame again, or its link is lost."""
        client = self._clients.get(transmitter)
        if client is None:
            return
        if frame.kind in {_AUTHENTICATION, _REQUEST}:
            self._events.schedule(now_ns, self._send_next, client, frame.number)
        elif frame.kind == _NULL and client.null_frames and client.scan is not None:
            repeat = self._send_null if client.null_frames < _NULL_FRAMES else self._lose_link
            self._events.schedule(now_ns, repeat, client)

    def _monitor_ns(self, client: _Association) -> int:
        """Return the time at which the robot tests its link if no further beacon arrives."""
        phase_ns = self._phases_ns[client.index]
        periods = -((phase_ns - client.beacon_ns - BEACON_LOSS_NS) // MONITOR_NS)
        return phase_ns + periods * MONITOR_NS

    def _check_link(self, now_ns: int, client: _Association) -> None:
        """Test the link if no beacons arrive; the time of a scan, which misses beacons, does not count."""
        is_idle = client.scan is not None and not client.is_busy and not client.null_frames
        if is_idle and now_ns >= self._monitor_ns(client):
            self._send_null(now_ns, client)
        next_ns = max(self._monitor_ns(client), now_ns + BEACON_INTERVAL_NS)
        self._events.schedule(next_ns, self._check_link, client)

    def _send_null(self, now_ns: int, client: _Association) -> None:
        if client.access_point is not None:
            client.null_frames += 1
            frame = ManagementFrame(_NULL, client.exchange)
            self._delivery.send_management(now_ns, client.index, client.access_point, frame, _NULL_BYTES)

    def _lose_link(self, now_ns: int, client: _Association) -> None:
        client.access_point = client.scan = None
        client.is_busy = True
        client.null_frames = 0
        self._delivery.start_handover(now_ns, client.index)
        self._delivery.associate(now_ns, client.index, None)
        self._events.schedule(now_ns + _RECONNECT_NS, self._scan, client)

    def _scan(self, now_ns: int, client: _Association) -> None:
        client.is_busy = True
        client.levels_dbm = {}
        if client.scan is not None:
            client.scan.on_scan(now_ns)
            if self._options.channels == 1:
                # The robot continues to send and receive. It sends a probe request without the first half of `dwell`.
                self._events.schedule(now_ns + self._dwell_ns // 2, self._finish_scan, client)
                return
        self._leave_channel(now_ns, client, 0)

    def _leave_channel(self, now_ns: int, client: _Association, channel: int) -> None:
        """Visit channels of a scan, from the one of this number; one of them is the robot's channel."""
        client.left_ns = now_ns
        if client.scan is not None:
            self._delivery.hold(now_ns, client.index)
        self._events.schedule(now_ns + self._dwell_ns, self._end_visit, client, channel + 1)

    def _end_visit(self, now_ns: int, client: _Association, channel: int) -> None:
        """End the scan or visit the next channel; an associated robot returns first if it is away too long."""
        is_last = channel >= self._options.channels
        if not is_last and (client.scan is None or now_ns <= client.left_ns + self._away_ns):
            self._events.schedule(now_ns + self._dwell_ns, self._end_visit, client, channel + 1)
            return
        if client.scan is not None:
            self._delivery.release(now_ns, client.index)
            client.beacon_ns = now_ns
        if is_last:
            self._finish_scan(now_ns, client)
        else:
            self._events.schedule(now_ns + self._home_ns, self._leave_channel, client, channel)

    def _finish_scan(self, now_ns: int, client: _Association) -> None:
        """Associate with the strongest access point, if the robot has none or this one is sufficiently stronger."""
        client.levels_dbm = self._levels_dbm(now_ns, client)
        strongest = self._strongest(client)
        if client.scan is None:
            if strongest is None:
                self._events.schedule(now_ns + _RESCAN_NS, self._scan, client)
            else:
                self._associate(now_ns, client, strongest)
            return
        client.scan.on_scan_end(now_ns)
        if strongest is not None and self._prefers(client, client.scan, strongest):
            self._events.schedule(now_ns + _SELECTION_NS, self._associate, client, strongest)
        else:
            client.is_busy = False

    def _prefers(self, client: _Association, scan: BackgroundScan, access_point: int) -> bool:
        return access_point != client.access_point and prefers_other(
            scan.level_dbm,
            round(client.levels_dbm[access_point]),
            round(self._options.noise_dbm),
            high_throughput=self._high_throughput,
        )

    def _associate(self, now_ns: int, client: _Association, access_point: int) -> None:
        client.access_point, client.scan = access_point, None
        client.step = client.tries = 0
        client.exchange += 1
        self._delivery.start_handover(now_ns, client.index)
        self._send_next(now_ns, client, client.exchange)

    def _send_next(self, now_ns: int, client: _Association, exchange: int) -> None:
        """Send the next frame of an association, complete it, or scan again after the last attempt at a frame."""
        if exchange != client.exchange or client.access_point is None:
            return
        if client.step == len(self._steps):
            self._complete_association(now_ns, client)
            return
        if client.tries == _MAX_TRIES:
            client.access_point = None
            self._delivery.associate(now_ns, client.index, None)
            self._scan(now_ns, client)
            return
        client.tries += 1
        client.exchange += 1
        step = self._steps[client.step]
        ends = client.index, client.access_point
        transmitter, receiver = ends if step.is_from_robot else ends[::-1]
        self._events.schedule(now_ns + step.timeout_ns, self._send_next, client, client.exchange)
        content = ManagementFrame(step.kind, client.exchange)
        self._delivery.send_management(now_ns, transmitter, receiver, content, step.size_bytes)

    def _complete_association(self, now_ns: int, client: _Association) -> None:
        options = self._options
        client.is_busy = False
        client.exchange += 1
        client.beacon_ns = now_ns
        client.null_frames = 0
        client.scan = BackgroundScan.start(
            now_ns,
            self._level_dbm(now_ns, client, client.access_point),
            threshold_dbm=options.threshold_dbm,
            short_ns=round(options.short * 1e9),
            long_ns=round(options.long * 1e9),
        )
        self._delivery.associate(now_ns, client.index, client.access_point)

    def _strongest(self, client: _Association) -> int | None:
        return max(client.levels_dbm, key=client.levels_dbm.__getitem__, default=None)

    def _levels_dbm(self, now_ns: int, client: _Association) -> dict[int, float]:
        """Return the signal of each access point that is linked with the robot."""
        return {
            access_point: self._level_dbm(now_ns, client, access_point)
            for access_point in self._delivery.access_points
            if self._channel.are_linked(access_point, client.index)
        }

    def _level_dbm(self, now_ns: int, client: _Association, access_point: int | None) -> float:
        assert access_point is not None
        return decibel(self._channel.powers_mw(access_point, now_ns)[client.index])


def _association_steps(options: RoamingOptions) -> tuple[_Step, ...]:
    handshake = _SAE_HANDSHAKE if options.sae else _HANDSHAKE
    return (*(_SAE if options.sae else _OPEN), *_REASSOCIATION, *(handshake if options.handshake else ()))
