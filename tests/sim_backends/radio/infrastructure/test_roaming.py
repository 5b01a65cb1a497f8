"""Roaming between two access points: route of packets, gap of a handover compared with its closed form, losses."""

from collections import Counter
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.core.links import NOT_ASSOCIATED
from sim_backends.radio.infrastructure.managed_delivery import ManagedDelivery, ManagementFrame, ManagementHandler
from sim_backends.radio.infrastructure.roaming import BEACON_LOSS_NS, MONITOR_NS
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.phy.high_throughput import PhyCapability
from sim_backends.radio.phy.modes import BAND_2_4, CW_MIN, SLOT_NS, ack_ns, basic_mode
from sim_backends.radio.radio_options import RadioOptions

MS, S = 10**6, 10**9
ANTENNA = Antenna("802.11n", 15.0, -88.0)
ACCESS_POINTS = {"west": {"at_m": [0, 3]}, "east": {"at_m": [100, 3]}}
AT_WEST, AT_EAST, FAR = (0.0, 0.0, 0.2), (100.0, 0.0, 0.2), (9e4, 0.0, 0.2)
EVERY_SECOND: dict[str, Any] = {"short": "1s", "long": "1s", "threshold_dbm": -40}
"""A scan each second."""

Packet = tuple[str, int]


class Lab:
    """A robot `base` at the western access point, and a robot `walker` that sends and receives pings."""

    def __init__(
        self, *, interval_ns: int = 20 * MS, antenna: Antenna = ANTENNA, seed: int = 1, **roaming: object
    ) -> None:
        options = {"fading": False, "access_points": ACCESS_POINTS, "roaming": roaming}
        self.model: WifiInWorld[Packet] = WifiInWorld(
            seed, RadioOptions.model_validate(options), dict.fromkeys(("base", "walker"), antenna), None
        )
        self.model.use_meter()
        self.lost: list[tuple[Packet, str, str]] = []
        self.model.log_losses(lambda _, packet, receiver, reason: self.lost.append((packet, receiver, reason)))
        self.interval_ns = interval_ns
        self.sent: list[tuple[Packet, int]] = []
        self.arrived_ns: dict[tuple[Packet, str], int] = {}
        self.cells: list[tuple[int, str | None]] = []
        self.now_ns = 0

    def run(self, until_ns: int, walker_m: Vector) -> None:
        while self.now_ns < until_ns:
            now_ns = self.now_ns
            self.model.place(now_ns, {"base": AT_WEST, "walker": walker_m}, None)
            for source, destination in (("walker", "base"), ("base", "walker")):
                packet = source, len(self.sent)
                self.sent.append((packet, now_ns))
                self.model.send(now_ns, source, packet, 84, destination)
            self._receive(now_ns)
            cell = self.model.sample(now_ns, now_ns)["walker"].cell
            if not self.cells or self.cells[-1][1] != cell:
                self.cells.append((now_ns, cell))
            self.now_ns += self.interval_ns

    def finish(self) -> None:
        self._receive(self.now_ns + S)

    def _receive(self, now_ns: int) -> None:
        for at_ns, receiver, packet, _, _ in self.model.deliveries(now_ns):
            key = packet, receiver
            assert key not in self.arrived_ns, "delivered twice"
            self.arrived_ns[key] = at_ns

    @property
    def access_points(self) -> list[str]:
        return [cell for _, cell in self.cells if cell is not None]


def test_a_robot_roams_to_the_stronger_access_point_and_packets_follow_it() -> None:
    lab = Lab(**EVERY_SECOND)
    lab.run(2 * S, AT_WEST)
    lab.run(9 * S, AT_EAST)
    lab.finish()
    assert lab.access_points == ["west", "east"]
    last_number = lab.sent[-1][0][1]
    assert {(("walker", last_number - 1), "base"), (("base", last_number), "walker")} <= lab.arrived_ns.keys()
    assert lab.model.counters()["west", "base"].delivered > 400
    assert lab.model.counters()["east", "walker"].delivered > 150


PHY = PhyCapability("n", "2.4 GHz", 20, 1, 800, "minstrel_ht")
VARIANTS = {
    "802.11g": None,
    "A-MPDU": PHY,
    "EDCA": replace(PHY, access_categories="linux"),
    "power save": replace(PHY, power_save_timeout_ns=5 * MS),
    "RTS": replace(PHY, rts_threshold_bytes=0),
}


@pytest.mark.parametrize("phy", VARIANTS.values(), ids=VARIANTS.keys())
def test_each_packet_is_delivered_or_lost_once(phy: PhyCapability | None) -> None:
    lab = Lab(interval_ns=40 * MS, antenna=Antenna("802.11n", 15.0, -88.0, phy), **EVERY_SECOND)
    for second in range(2, 20, 3):
        lab.run(second * S, AT_WEST if second % 2 else AT_EAST)
    lab.model.send(lab.now_ns, "walker", ("walker", -1), 84, None)
    lab.sent.append((("walker", -1), lab.now_ns))
    lab.finish()
    lost_packets = [packet for packet, _, _ in lab.lost]
    delivered_packets = [packet for packet, _ in lab.arrived_ns]
    assert Counter(lost_packets + delivered_packets) == Counter(packet for packet, _ in lab.sent)
    assert {receiver for _, receiver, _ in lab.lost} <= {"base", "walker"}
    assert NOT_ASSOCIATED in {reason for _, _, reason in lab.lost}


# Sizes of the frames that mac80211, hostapd and wpa_supplicant sent (tests/data/hwsim).
@pytest.mark.parametrize(
    ("settings", "sizes"),
    [
        ({}, [34, 34, 159, 143, 137, 159, 193, 137]),
        ({"handshake": False}, [34, 34, 159, 143]),
        ({"sae": True}, [132, 132, 68, 68, 159, 143, 159, 165, 225, 137]),
    ],
)
def test_the_gap_of_a_handover_is_the_sum_of_its_frames_and_processing_times(
    settings: dict[str, Any], sizes: list[int]
) -> None:
    """Without other traffic: sum of (DIFS + backoff + frame + SIFS + ACK) and of the processing times."""
    processing_ns = 3 * MS
    lab = Lab(**settings, processing="3ms", channels=1, **EVERY_SECOND)
    lab.run(S, AT_WEST)
    lab.interval_ns = 2 * MS
    lab.run(3 * S + 300 * MS, AT_EAST)
    (disconnect_ns, connect_ns) = next(
        (start_ns, end_ns)
        for (start_ns, start), (end_ns, end) in pairwise(lab.cells)
        if start is None and end == "east"
    )
    mode = basic_mode(BAND_2_4)
    shortest_ns = sum(BAND_2_4.difs_ns + mode.airtime_ns(size) + BAND_2_4.sifs_ns + ack_ns(mode) for size in sizes)
    shortest_ns += len(sizes) * processing_ns
    # Each frame is sent at a rate of at least 6 Mbit/s; at the highest rate its airtime is about 0.1 ms.
    airtimes_ns = sum(mode.airtime_ns(size) for size in sizes)
    waits_ns = len(sizes) * (CW_MIN * SLOT_NS + MS)
    assert shortest_ns - airtimes_ns - 2 * MS <= connect_ns - disconnect_ns <= shortest_ns + waits_ns + 2 * MS


@dataclass
class LossyHandler:
    """Loses the first management frame of a kind; a lost request of a robot is reported like one without an ACK."""

    handler: ManagementHandler
    kind: str
    is_from_robot: bool
    lost_ns: int = 0

    def on_management(self, now_ns: int, transmitter: int, receiver: int, frame: ManagementFrame) -> None:
        if frame.kind != self.kind or (transmitter <= 1) != self.is_from_robot or self.lost_ns:
            self.handler.on_management(now_ns, transmitter, receiver, frame)
            return
        self.lost_ns = now_ns
        if self.is_from_robot:
            self.on_management_lost(now_ns, transmitter, frame)

    def on_management_lost(self, now_ns: int, transmitter: int, frame: ManagementFrame) -> None:
        self.handler.on_management_lost(now_ns, transmitter, frame)


def handover_ns(lost_kind: str, *, is_from_robot: bool, until_ns: int = 3500 * MS, sae: bool = False) -> int:
    """Return the time without association of a handover in which the first frame of a kind is lost."""
    lab = Lab(processing="1ms", channels=1, sae=sae, **EVERY_SECOND)
    lab.run(S, AT_WEST)
    delivery = lab.model._delivery
    assert isinstance(delivery, ManagedDelivery)
    assert delivery.handler is not None
    delivery.handler = handler = LossyHandler(delivery.handler, lost_kind, is_from_robot)
    lab.interval_ns = 5 * MS
    lab.run(until_ns, AT_EAST)
    assert bool(handler.lost_ns) == (lost_kind != "none")
    return next(
        end_ns - start_ns
        for (start_ns, start), (end_ns, end) in pairwise(lab.cells)
        if start is None and end == "east"
    )


# Times that Linux 6.1 and hostapd 2.10 needed to send the frame, or the previous one, again (`roaming_vs_kernel`).
@pytest.mark.parametrize(
    ("kind", "is_from_robot", "delay_ms"),
    [
        ("authentication", True, 1),
        ("authentication", False, 103),
        ("reassociation request", True, 1),
        ("reassociation response", False, 104),
        ("EAPOL-Key 1", False, 101),
        ("EAPOL-Key 2", True, 1003),
        ("EAPOL-Key 3", False, 101),
        ("EAPOL-Key 4", True, 101),
    ],
)
def test_a_lost_frame_delays_an_association_like_in_linux(kind: str, is_from_robot: bool, delay_ms: float) -> None:
    lossless_ns, lossy_ns = (handover_ns(lost_kind, is_from_robot=is_from_robot) for lost_kind in ("none", kind))
    assert (lossy_ns - lossless_ns) / MS == pytest.approx(delay_ms, abs=10)


# A request without an ACK is sent again immediately. After its ACK, mac80211 waits for the response for
# `IEEE80211_AUTH_TIMEOUT_SAE`, which is 2 * HZ (mlme.c, ieee80211_sta_work, Linux 6.1).
@pytest.mark.parametrize(("is_from_robot", "delay_ms"), [(True, 1), (False, 2001)])
def test_a_lost_frame_of_sae_delays_an_association_like_in_linux(*, is_from_robot: bool, delay_ms: float) -> None:
    lossless_ns, lossy_ns = (
        handover_ns(lost_kind, is_from_robot=is_from_robot, until_ns=6 * S, sae=True)
        for lost_kind in ("none", "authentication")
    )
    assert (lossy_ns - lossless_ns) / MS == pytest.approx(delay_ms, abs=10)


def test_a_scan_delays_packets_and_loses_none() -> None:
    lab = Lab(channels=4, **EVERY_SECOND)
    lab.run(6 * S, AT_WEST)
    lab.finish()
    assert lab.access_points == ["west"]
    assert not lab.lost
    delays_ms = [(lab.arrived_ns[packet, receiver] - sent_ns) / MS for packet, sent_ns in lab.sent
                 for receiver in ("base", "walker") if (packet, receiver) in lab.arrived_ns]  # fmt: skip
    assert 100 < max(delays_ms) < 130
    # Three scans in six seconds, each away for 128 ms twice, delay packets in two directions, and each packet at both
    # robots, which scan at the same time.
    delayed_packets = sum(delay_ms > 10 for delay_ms in delays_ms)
    assert delayed_packets == pytest.approx(3 * 2 * 2 * 118 / 20, rel=0.3)


def absences_ms(channels: int, dwell: str = "64ms") -> list[tuple[float, float]]:
    """Return start and duration, in ms, of each absence of the walker during its first scan; `base` does not scan."""
    lab = Lab(interval_ns=2 * MS, short="3s", long="300s", threshold_dbm=-45, channels=channels, dwell=dwell)
    lab.run(6 * S, (20.0, 0.0, 0.2))
    arrivals_ns = sorted(at_ns for (_, receiver), at_ns in lab.arrived_ns.items() if receiver == "walker")
    absences = [(start, end - start) for start, end in pairwise(arrivals_ns) if end - start > 15 * MS]
    first_ns = absences[0][0]
    return [((start_ns - first_ns) / MS, duration_ns / MS) for start_ns, duration_ns in absences]


def test_an_associated_robot_is_away_during_scans_like_a_station_of_linux() -> None:
    """mac80211 6.1 visits two channels of 64 ms each, and returns for 204 ms (`benchmarks.roaming_vs_kernel`)."""
    visits = [*[(number * (128 + 204), 128) for number in range(5)], (5 * (128 + 204), 64)]
    measured = absences_ms(channels=11)
    assert [start_ms for start_ms, _ in measured] == pytest.approx([start_ms for start_ms, _ in visits], abs=6)
    assert [duration_ms for _, duration_ms in measured] == pytest.approx([duration for _, duration in visits], abs=6)


def test_passive_scans_visit_one_channel_at_a_time() -> None:
    measured = absences_ms(channels=3, dwell="112ms")
    assert [duration_ms for _, duration_ms in measured] == pytest.approx([112] * 3, abs=6)
    assert [start_ms for start_ms, _ in measured] == pytest.approx([0, 316, 632], abs=6)


def test_a_scan_of_the_current_channel_alone_delays_no_packet() -> None:
    lab = Lab(channels=1, **EVERY_SECOND)
    lab.run(3 * S, AT_WEST)
    lab.finish()
    delays_ns = [lab.arrived_ns[packet, receiver] - sent_ns for packet, sent_ns in lab.sent
                 for receiver in ("base", "walker") if (packet, receiver) in lab.arrived_ns]  # fmt: skip
    assert max(delays_ns) < 10 * MS


@pytest.mark.parametrize("seed", range(2))
def test_a_robot_out_of_range_loses_its_association_and_associates_again_when_it_returns(seed: int) -> None:
    """The link is lost at the first whole second, by the robot's clock, after seven beacons were missed."""
    lab = Lab(interval_ns=20 * MS, seed=seed)
    lab.run(2 * S, AT_WEST)
    lab.run(8 * S, FAR)
    disconnect_ns = lab.cells[-1][0]
    assert lab.cells[-1][1] is None
    assert 2 * S - 110 * MS + BEACON_LOSS_NS <= disconnect_ns <= 2 * S + BEACON_LOSS_NS + MONITOR_NS + 40 * MS
    lab.interval_ns = 100 * MS
    lab.run(16 * S, AT_EAST)
    assert lab.access_points == ["west", "east"]


def test_the_times_of_link_losses_are_uniform_within_a_second() -> None:
    times_ns = []
    for seed in range(20):
        lab = Lab(interval_ns=20 * MS, seed=seed)
        lab.run(2 * S, AT_WEST)
        lab.run(4 * S, FAR)
        times_ns.append(next(at_ns for at_ns, cell in lab.cells if cell is None and at_ns > S))
    assert max(times_ns) - min(times_ns) > 0.6 * S


def test_a_robot_that_only_misses_beacons_keeps_its_association_until_it_is_out_of_range() -> None:
    """Its null frames are acknowledged, and sent again every second."""
    lab = Lab(channels=1, interval_ns=20 * MS)
    lab.run(2 * S, AT_WEST)
    delivery = lab.model._delivery
    delivery.count_waiting_management = lambda _: 1  # type: ignore[attr-defined]  # beacons are omitted
    lab.run(6 * S, AT_WEST)
    assert [cell for _, cell in lab.cells] == ["west"]
    lab.run(8 * S, FAR)
    assert [cell for _, cell in lab.cells] == ["west", None]


def test_a_robot_and_an_access_point_have_different_names() -> None:
    options = RadioOptions.model_validate({"access_points": {"base": {"at_m": [0, 0]}}})
    with pytest.raises(ConfigurationError, match="have the name base"):
        WifiInWorld(1, options, {"base": ANTENNA}, None)


def test_a_copy_during_a_scan_continues_like_its_original() -> None:
    options = {
        "access_points": ACCESS_POINTS,
        "roaming": EVERY_SECOND,
        "neighbours": {"office": {"at_m": [50, 0], "duty": "20%"}},
        "microwave_ovens": {"kitchen": {"at_m": [20, 0]}},
    }
    model: WifiInWorld[Packet] = WifiInWorld(
        1, RadioOptions.model_validate(options), dict.fromkeys(("base", "walker"), ANTENNA), None
    )
    model.place(0, {"base": AT_WEST, "walker": AT_WEST}, None)
    model.place(S, {"base": AT_WEST, "walker": AT_EAST}, None)
    model.advance(1100 * MS)
    model_copy = deepcopy(model)
    results = []
    for radio in (model, model_copy):
        radio.use_meter()
        for number in range(100):
            radio.send(1100 * MS + number * 50 * MS, "walker", ("walker", number), 84, "base")
        arrivals = [(at_ns, packet) for at_ns, _, packet, _, _ in radio.deliveries(8 * S)]
        sample = radio.sample(8 * S, 0)["walker"]
        results.append((arrivals, sample.cell, sample.busy_ns))
    assert results[0] == results[1]
    assert (len(results[0][0]) > 50, results[0][1]) == (True, "east")
