"""A-MSDU: sizes compared with packets of scapy, delivery of whole frames, and goodput compared with a closed form."""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.dot11 import Dot11, Dot11FCS, Dot11QoS
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import LLC, SNAP, Dot3
from typing_extensions import override

from fieldkit.config.profiles import Radio
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.mac.aggregation import DELIMITER_BYTES, AmpduLimits, remove_frames
from sim_backends.radio.mac.amsdu import AmsduSession, frame_bytes, frames_of, limits_with_amsdu
from sim_backends.radio.mac.frames import Frame, TransmissionAttempt
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import format_modes
from sim_backends.radio.phy.modes import CW_MIN, SLOT_NS, PhyFormat, WifiMode, response_ns
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.wifi import Wifi
from sim_backends.radio.world_channel import WorldChannel
from tests.helpers.stations import HEADERS_BYTES, NOISE_MW, STRONG_MW, FixedPowers, saturate

HT20_7 = format_modes("HT", "2.4 GHz", 20, 1, 800)[7]
VHT80_9 = format_modes("VHT", "5 GHz", 80, 2, 400)[9]
SIZES_BYTES = st.lists(st.integers(28, 1500), min_size=1, max_size=40)


def packets(sizes_bytes: Sequence[int]) -> deque[Frame[int]]:
    return deque(
        Frame(number, size_bytes, "a", 1, (), True, ("a", number), queued_ns=0)
        for number, size_bytes in enumerate(sizes_bytes)
    )


def scapy_frame_bytes(sizes_bytes: Sequence[int]) -> int:
    """Return the size of a QoS data frame with IP packets of these sizes; an A-MSDU has several."""
    ip_packets = [LLC() / SNAP() / IP() / UDP() / bytes(size_bytes - 28) for size_bytes in sizes_bytes]
    bodies = [bytes(packet) for packet in ip_packets]
    if len(bodies) > 1:
        subframes = [bytes(Dot3(dst="02:00:00:00:00:02", src="02:00:00:00:00:01") / body) for body in bodies]
        bodies = [*(subframe + bytes(-len(subframe) % 4) for subframe in subframes[:-1]), subframes[-1]]
    header = Dot11FCS(type=2, subtype=8) / Dot11QoS(A_MSDU_Present=int(len(sizes_bytes) > 1))
    return len(bytes(header / b"".join(bodies)))


@given(SIZES_BYTES)
def test_frames_have_the_sizes_of_scapys_frames(sizes_bytes: list[int]) -> None:
    assert len(bytes(Dot11())) == 24
    assert frame_bytes(packets(sizes_bytes)) == scapy_frame_bytes(sizes_bytes)


@given(SIZES_BYTES, st.sampled_from([3839, 7935, 11454]), st.sampled_from([HT20_7, VHT80_9]))
def test_frames_are_as_large_as_their_limits_permit(sizes_bytes: list[int], maximum: int, mode: WifiMode) -> None:
    aggregate = AmsduSession[int](limits_with_amsdu(mode.phy_format, maximum)).build_aggregate(
        packets(sizes_bytes), mode
    )
    frames = list(frames_of(aggregate.frames))
    assert [packet.payload for packet in aggregate.frames] == list(range(len(sizes_bytes)))
    assert aggregate.frame_count == len(frames)
    largest_frame = 4095 if mode is HT20_7 else 11_454
    msdu_limit = min(maximum, 4065 if mode is HT20_7 else 11_454 - 30)
    size_bytes = 0
    for frame in frames:
        frame_size = scapy_frame_bytes([packet.size_bytes for packet in frame])
        assert frame_size <= largest_frame
        assert len(frame) == 1 or frame_size - 30 <= msdu_limit
        size_bytes += -size_bytes % 4 + DELIMITER_BYTES + frame_size
    assert aggregate.size_bytes == size_bytes - (DELIMITER_BYTES if len(frames) == 1 and mode is HT20_7 else 0)
    for frame, following in pairwise(frames):
        joined = [packet.size_bytes for packet in (*frame, following[0])]
        assert scapy_frame_bytes(joined) - 30 > msdu_limit, "the next packet does not fit"


@pytest.mark.parametrize(
    ("phy_format", "maximum", "expected"),
    [("HT", 3839, 3839), ("HT", 7935, 4065), ("VHT", 7935, 7935), ("HE", 11454, 11424)],
)
def test_formats_limit_the_size(phy_format: PhyFormat, maximum: int, expected: int) -> None:
    """In a Block Ack session of HT, the limit is min(max_amsdu_len, 4065): include/net/mac80211.h of Linux."""
    assert limits_with_amsdu(phy_format, maximum).amsdu_bytes == expected


def session() -> AmsduSession[int]:
    return AmsduSession(limits_with_amsdu("VHT", 3839))


def test_a_frame_that_is_sent_again_has_the_same_packets() -> None:
    queue, agreement = packets([1000] * 8), session()
    first = list(agreement.build_aggregate(queue, VHT80_9).frames)
    assert [packet.sequence for packet in first] == [0, 0, 0, 1, 1, 1, 2, 2]
    remove_frames(queue, set(first[3:6]))
    queue.extend(packets([100] * 3))
    repeated = agreement.build_aggregate(queue, VHT80_9)
    assert [len(frame) for frame in frames_of(repeated.frames)] == [3, 2, 3]
    assert [packet.sequence for packet in repeated.frames] == [0, 0, 0, 2, 2, 3, 3, 3]
    assert agreement.first_frame_bytes(queue) == scapy_frame_bytes([1000] * 3)


def test_a_recipient_passes_up_the_packets_of_frames_in_order_and_once() -> None:
    queue, agreement = packets([1000] * 9), session()
    sent = list(agreement.build_aggregate(queue, VHT80_9).frames)
    assert agreement.receive(sent[3:6]) == []
    assert agreement.receive(sent[:3]) == sent[:6]
    assert agreement.receive(sent[:6]) == []
    assert agreement.skip(sent[6:]) == []
    queue.clear()
    queue.extend(packets([500]))
    assert agreement.receive(agreement.build_aggregate(queue, VHT80_9).frames) == [queue[0]]


def test_a_probe_of_rate_control_has_one_packet_unless_its_frame_was_sent_before() -> None:
    queue, agreement = packets([1000] * 8), session()
    assert len(agreement.build_aggregate(queue, VHT80_9, is_single=True).frames) == 1
    agreement.build_aggregate(queue, VHT80_9)
    queue.popleft()
    assert len(agreement.build_aggregate(queue, VHT80_9, is_single=True).frames) == 3


class AmsduPowers(FixedPowers):
    """Stations that send A-MSDUs."""

    def __init__(self, names: Sequence[str], mode: WifiMode, maximum: int) -> None:
        super().__init__(names, mode)
        self.band, self._limits = mode.band, limits_with_amsdu(mode.phy_format, maximum)

    @override
    def ifs_ns(self, station: int) -> int:
        return self.band.best_effort_aifs_ns

    @override
    def ampdu_limits(self, transmitter: int, receiver: int) -> AmpduLimits:
        return self._limits


@pytest.mark.parametrize(
    ("mode", "maximum", "payload_bytes"),
    [(HT20_7, 3839, 100), (HT20_7, 3839, 1000), (VHT80_9, 3839, 1000), (VHT80_9, 11454, 1000)],
)
def test_goodput_equals_the_closed_form(mode: WifiMode, maximum: int, payload_bytes: int) -> None:
    """One station: AIFS, mean backoff, the largest aggregate, SIFS, Block Ack."""
    size_bytes = payload_bytes + HEADERS_BYTES
    aggregate = AmsduSession[int](limits_with_amsdu(mode.phy_format, maximum)).build_aggregate(
        packets([size_bytes] * 7000), mode
    )
    busy_ns = mode.airtime_ns(aggregate.size_bytes) + mode.band.sifs_ns + response_ns(mode, 32)
    cycle_ns = mode.band.best_effort_aifs_ns + CW_MIN / 2 * SLOT_NS + busy_ns
    expected = len(aggregate.frames) * 8 * payload_bytes / cycle_ns * 1e9
    goodput = saturate(
        AmsduPowers("ar", mode, maximum),
        "a",
        "r",
        seconds=0.3,
        payload_bytes=payload_bytes,
        queued=2 * len(aggregate.frames),
    )
    assert goodput["a"] == pytest.approx(expected, rel=0.05)


def test_goodput_is_within_one_percent_of_ns3() -> None:
    """ns-3 3.37: `benchmarks.high_throughput_vs_ns3`, A-MSDU in A-MPDU, one station."""
    goodput = saturate(AmsduPowers("ar", HT20_7, 3839), "a", "r", seconds=1.0, queued=150)
    assert goodput["a"] / 1e6 == pytest.approx(58.97, rel=0.01)


def test_all_packets_of_a_frame_are_received_or_none() -> None:
    channel = AmsduPowers("ar", VHT80_9, 3839)
    ratio_db = next(step / 100 for step in range(4000) if packet_error(VHT80_9, step / 100, 3160) < 0.3)
    channel.noise_mw = [NOISE_MW, STRONG_MW / VHT80_9.noise_factor / 10 ** (ratio_db / 10)]
    wifi: Wifi[int] = Wifi(channel, 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    for number in range(600):
        wifi.send(0, "a", number, 1028, "r")
    arrived = [payload for _, _, payload, _, _ in wifi.deliveries(10**10)]
    assert arrived == sorted(set(arrived)), "in order, without duplicates"
    results: dict[tuple[int, int], list[bool]] = {}
    for attempt in log:
        if attempt.number:
            results.setdefault((attempt.start_ns, (attempt.payload + 2) // 3), []).append(bool(attempt.received))
    assert {tuple(sorted(set(values))) for values in results.values()} == {(False,), (True,)}
    failed = sum(not any(values) for values in results.values())
    assert 0.15 * len(results) < failed < 0.45 * len(results)
    counters = wifi.counters()["a", "r"]
    assert (counters.delivered, counters.sent) == (len(arrived), 600)


def test_robots_use_amsdus_if_both_have_the_key() -> None:
    radios = {
        name: Radio.model_validate(
            {
                "interface": "wlan0",
                "standard": "802.11ac 5 GHz",
                "tx_power_dbm": 15,
                "sensitivity_dbm": -90,
                "phy": {"width_mhz": 80, **keys},
            }
        )
        for name, keys in {
            "small": {"amsdu_max_bytes": 3839},
            "large": {"amsdu_max_bytes": 11454},
            "none": {},
        }.items()
    }
    channel = WorldChannel(1, {name: antenna_of(radio) for name, radio in radios.items()}, RadioOptions())
    limits = [channel.ampdu_limits(*pair) for pair in ((0, 1), (1, 1), (0, 2))]
    assert [limit and limit.amsdu_bytes for limit in limits] == [3839, 11_424, 0]


@pytest.mark.parametrize(
    ("standard", "size_bytes", "message"),
    [
        ("802.11ac 5 GHz", 4000, "there is no A-MSDU size of 4000 bytes; write 3839, 7935 or 11454"),
        ("802.11n 5 GHz", 11454, "802.11n 5 GHz has no A-MSDU of 11454 bytes; .* 3839 or 7935"),
        ("802.11ax 2.4 GHz", 11454, "802.11ax 2.4 GHz has no A-MSDU of 11454 bytes"),
    ],
)
def test_an_invalid_size_is_refused(standard: str, size_bytes: int, message: str) -> None:
    radio = {"interface": "wlan0", "standard": standard, "tx_power_dbm": 15, "sensitivity_dbm": -90}
    with pytest.raises(ValueError, match=message):
        Radio.model_validate({**radio, "phy": {"amsdu_max_bytes": size_bytes, "guard_interval_ns": 800}})
