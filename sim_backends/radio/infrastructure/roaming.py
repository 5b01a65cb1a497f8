"""Association of robots with access points between which they roam: beacons, scans, association and its loss.

All access points and robots share one channel here; a robot that scans another channel neither sends nor receives.
Probe frames would be on the other channels, so they are omitted. A scan finds each access point that is linked with
the robot when the scan ends. Beacons are sent on the air as broadcasts; the frames of an association have retries.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from sim_backends.radio.channel import RadioChannel
from sim_backends.radio.infrastructure.background_scan import BackgroundScan, required_difference_db
from sim_backends.radio.infrastructure.infrastructure_options import RoamingOptions
from sim_backends.radio.infrastructure.managed_delivery import ManagedDelivery, ManagementFrame
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.power_save import BEACON_INTERVAL_NS

BEACON: Final = "beacon"

_BEACON_BYTES: Final = 250
"""Size of a beacon of hostapd with 802.11n and WPA2, estimated from its elements."""

# Kind, size with MAC header and FCS, and True if the robot sends it. 802.11-2020: 9.3.3.6 to 9.3.3.12 with the
# elements of 802.11n and WPA2; 12.7.6 (an EAPOL-Key frame has 99 bytes and key data, and 8 bytes of LLC and SNAP).
_ASSOCIATION: Final = (
    ("authentication", 34, True),
    ("authentication", 34, False),
    ("reassociation request", 130, True),
    ("reassociation response", 140, False),
)
_HANDSHAKE: Final = (
    ("EAPOL-Key 1", 135, False),
    ("EAPOL-Key 2", 157, True),
    ("EAPOL-Key 3", 191, False),
    ("EAPOL-Key 4", 135, True),
)
_STEP_TIMEOUT_NS: Final = 200_000_000
_MAX_TRIES: Final = 3
"""Time after which a frame of an association is sent again, and number of attempts: IEEE80211_AUTH_TIMEOUT,
IEEE80211_ASSOC_TIMEOUT and their MAX_TRIES in mlme.c."""

LINK_LOSS_NS: Final = 7 * BEACON_INTERVAL_NS + 2 * 500_000_000
"""Time without beacons after which a link is lost: 7 beacon intervals, and 2 null frames with a timeout of 500 ms
each, as in mlme.c."""

_RESCAN_NS: Final = 5_000_000_000
"""Interval of scans without an association: the default of wpa_supplicant."""


@dataclass(slots=True)
class _Association:
    """A robot's association.

    Attributes:
        index: Index of the robot.
        access_point: The access point with which the robot is associated or is being associated, or None.
        scan: Schedule of its scans; None without an association.
        beacon_ns: Time of the last beacon, or of a later association or return to the channel.
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
        phases_ns: Time of the first beacon of each access point, by index.
    """

    def __init__(
        self,
        channel: RadioChannel,
        events: EventQueue,
        delivery: ManagedDelivery[Any],
        options: RoamingOptions,
        phases_ns: Mapping[int, int],
    ) -> None:
        self._channel = channel
        self._events = events
        self._delivery = delivery
        self._options = options
        self._steps = _ASSOCIATION + (_HANDSHAKE if options.handshake else ())
        self._clients = {robot: _Association(robot) for robot in delivery.robots}
        self._dwell_ns, self._home_ns = round(options.dwell * 1e9), round(options.home * 1e9)
        self._processing_ns = round(options.processing * 1e9)
        self._has_started = False
        delivery.serving_access_point = dict.fromkeys(delivery.robots)
        for access_point, phase_ns in phases_ns.items():
            events.schedule(phase_ns, self._send_beacon, access_point)

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
            self._events.schedule(now_ns + LINK_LOSS_NS, self._check_link, client)

    def on_management(self, now_ns: int, transmitter: int, receiver: int, frame: ManagementFrame) -> None:
        """Implement `ManagementHandler`."""
        if frame.kind == BEACON:
            client = self._clients.get(receiver)
            if client is not None and client.scan is not None and client.access_point == transmitter:
                self._on_beacon(now_ns, client, client.scan)
            return
        client = self._clients.get(receiver) or self._clients.get(transmitter)
        if client is not None and frame.number == client.exchange and client.scan is None:
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
        scan.on_beacon(now_ns, self._level_dbm(now_ns, client, client.access_point))
        if not client.is_busy and scan.next_ns <= now_ns:
            self._scan(now_ns, client)

    def _check_link(self, now_ns: int, client: _Association) -> None:
        """End the association if no beacons arrive; the time of a scan, which misses beacons, does not count."""
        if client.scan is not None and not client.is_busy and now_ns >= client.beacon_ns + LINK_LOSS_NS:
            self._lose_link(now_ns, client)
        next_ns = max(client.beacon_ns + LINK_LOSS_NS, now_ns + BEACON_INTERVAL_NS)
        self._events.schedule(next_ns, self._check_link, client)

    def _lose_link(self, now_ns: int, client: _Association) -> None:
        client.access_point = client.scan = None
        self._delivery.start_handover(now_ns, client.index)
        self._delivery.associate(now_ns, client.index, None)
        self._scan(now_ns, client)

    def _scan(self, now_ns: int, client: _Association) -> None:
        client.is_busy = True
        client.levels_dbm = {}
        if client.scan is not None:
            client.scan.on_scan(now_ns)
        # Channel 0 is the current channel. An associated robot visits only the others.
        self._visit_channel(now_ns, client, 0 if client.scan is None else 1)

    def _visit_channel(self, now_ns: int, client: _Association, channel: int) -> None:
        """Scan a channel, or end the scan after the last channel."""
        if channel >= self._options.channels:
            self._finish_scan(now_ns, client)
            return
        if client.scan is not None:
            self._delivery.hold(now_ns, client.index)
        self._events.schedule(now_ns + self._dwell_ns, self._leave_channel, client, channel)

    def _leave_channel(self, now_ns: int, client: _Association, channel: int) -> None:
        pause_ns = 0
        if client.scan is not None:
            self._delivery.release(now_ns, client.index)
            client.beacon_ns = now_ns
            pause_ns = self._home_ns if channel + 1 < self._options.channels else 0
        self._events.schedule(now_ns + pause_ns, self._visit_channel, client, channel + 1)

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
        current_dbm = client.scan.average_dbm
        if (
            strongest is not None
            and strongest != client.access_point
            and client.levels_dbm[strongest] >= current_dbm + required_difference_db(current_dbm)
        ):
            self._associate(now_ns, client, strongest)
        else:
            client.is_busy = False

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
        kind, size_bytes, is_from_robot = self._steps[client.step]
        ends = client.index, client.access_point
        transmitter, receiver = ends if is_from_robot else ends[::-1]
        content = ManagementFrame(kind, exchange)
        self._delivery.send_management(now_ns, transmitter, receiver, content, size_bytes)
        self._events.schedule(now_ns + _STEP_TIMEOUT_NS, self._send_next, client, exchange)

    def _complete_association(self, now_ns: int, client: _Association) -> None:
        options = self._options
        client.is_busy = False
        client.exchange += 1
        client.beacon_ns = now_ns
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
