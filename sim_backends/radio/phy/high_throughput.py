"""Modes of 802.11n, ac and ax (HT, VHT, HE) with one or two spatial streams in 20, 40 and 80 MHz.

Clauses 19 (HT) and 21 (VHT) are in IEEE 802.11-2020, clause 27 (HE) is in IEEE 802.11ax-2021. Beamforming,
STBC, LDPC, dual carrier modulation, 1x HE-LTF, packet extension and multi-user frames are not modelled.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import product
from typing import Final, Literal

from fieldkit.config.wifi_phy import DscpMapping, WifiAmendment, WifiPhy, WifiRateControl
from sim_backends.radio.phy.modes import (
    BAND_2_4,
    BANDS,
    BITS_PER_SUBCARRIER,
    G_MODES,
    N_MODES,
    OFDM_MODES,
    SYMBOL_NS,
    Band,
    BandName,
    Modulation,
    WifiMode,
)

HighThroughput = Literal["HT", "VHT", "HE"]

# Amendments of 802.11, earliest first.
_ORDER: Final[tuple[WifiAmendment, ...]] = ("n", "ac", "ax")
_FORMATS: Final[dict[WifiAmendment, HighThroughput]] = {"n": "HT", "ac": "VHT", "ax": "HE"}

# Modulation and code rate by MCS: tables 19-27 and 21-29, clause 27.5.
_MCS: Final[tuple[tuple[Modulation, Fraction], ...]] = (
    ("BPSK", Fraction(1, 2)),
    ("QPSK", Fraction(1, 2)),
    ("QPSK", Fraction(3, 4)),
    ("16-QAM", Fraction(1, 2)),
    ("16-QAM", Fraction(3, 4)),
    ("64-QAM", Fraction(2, 3)),
    ("64-QAM", Fraction(3, 4)),
    ("64-QAM", Fraction(5, 6)),
    ("256-QAM", Fraction(3, 4)),
    ("256-QAM", Fraction(5, 6)),
    ("1024-QAM", Fraction(3, 4)),
    ("1024-QAM", Fraction(5, 6)),
)
_MCS_COUNT: Final[dict[HighThroughput, int]] = {"HT": 8, "VHT": 10, "HE": 12}

# Data subcarriers by width, N_SD: tables 19-6, 21-5 and 27-14 (one resource unit of 242, 484 or 996 tones).
_SUBCARRIERS: Final[dict[HighThroughput, dict[int, int]]] = {
    "HT": {20: 52, 40: 108},
    "VHT": {20: 52, 40: 108, 80: 234},
    "HE": {20: 234, 40: 468, 80: 980},
}

# Data bits per symbol of 4 us that one convolutional encoder handles: tables of 19.5 and 21.5. HE would use LDPC; in
# this model it has one encoder for any number of bits.
_ENCODER_BITS_PER_SYMBOL: Final[dict[HighThroughput, int]] = {"HT": 1080, "VHT": 2160, "HE": 1 << 30}

_LEGACY_PREAMBLE_NS: Final = 20_000
_HE_SYMBOL_NS: Final = 12_800
# HE-LTF by guard interval: the combinations that are mandatory (27.3.11.10), 2x with 0.8 and 1.6 us, 4x with 3.2 us.
_HE_LTF_NS: Final = {800: 7_200, 1600: 8_000, 3200: 16_000}


@dataclass(frozen=True)
class PhyCapability:
    """The capability of a station of 802.11n or later.

    Attributes:
        amendment: Its amendment of 802.11.
        band_name: Its band.
        width_mhz: Widest channel.
        streams: Maximum number of spatial streams.
        guard_interval_ns: Shortest guard interval.
        rate_control: Its rate control.
        firmware_margin_db: Margin of `firmware` below the measured signal.
        firmware_interval_ns: Time between two selections of `firmware`.
        rts_threshold_bytes: Largest size of a frame or aggregate that it sends without RTS; None for any size.
        access_categories: Mapping of packets to its access categories; None if it sends all packets as best effort.
        power_save_timeout_ns: Time from its last frame until it dozes; None if it never dozes.
        packet_time_ns: Time that its bus and driver need per packet before the queue of the radio.
        amsdu_max_bytes: Maximum size of the A-MSDUs that it sends and receives; None if it supports none.
    """

    amendment: WifiAmendment
    band_name: BandName
    width_mhz: int
    streams: int
    guard_interval_ns: int
    rate_control: WifiRateControl = "minstrel"
    firmware_margin_db: float = 3.0
    firmware_interval_ns: int = 100_000_000
    rts_threshold_bytes: int | None = None
    access_categories: DscpMapping | None = None
    power_save_timeout_ns: int | None = None
    packet_time_ns: int = 0
    amsdu_max_bytes: int | None = None

    @property
    def band(self) -> Band:
        """The band in which the station sends."""
        return BANDS[self.band_name]

    def supports(self, mode: WifiMode) -> bool:
        """Return True if the station can send and receive frames in this mode of HT, VHT or HE."""
        formats = [_FORMATS[amendment] for amendment in _ORDER[: _ORDER.index(self.amendment) + 1]]
        # The guard interval of a station of 802.11ax limits only its HE modes.
        allows_all_intervals = self.amendment == "ax" and mode.phy_format != "HE"
        return (
            mode.phy_format in formats
            and mode.width_mhz <= self.width_mhz
            and mode.streams <= self.streams
            and (allows_all_intervals or mode.guard_interval_ns >= self.guard_interval_ns)
        )


def capability_of(standard: str, phy: WifiPhy | None) -> PhyCapability | None:
    """Return the capability of a radio with this standard, `802.11ac 5 GHz`; None for a radio without key `phy`."""
    if phy is None:
        return None
    amendment, band_name = phy.split_standard(standard)
    return PhyCapability(
        amendment,
        band_name,
        phy.width_mhz,
        phy.streams,
        phy.guard_interval_ns,
        phy.rate_control,
        float(phy.firmware_margin_db),
        round(phy.firmware_interval * 1e9),
        phy.rts_threshold_bytes,
        phy.access_categories,
        round(phy.power_save_timeout * 1e9) if phy.power_save else None,
        round(phy.packet_time * 1e9),
        phy.amsdu_max_bytes,
    )


@dataclass(frozen=True)
class _Common:
    """Common properties of two stations of one band: format, width, number of streams, shortest guard interval."""

    phy_format: HighThroughput
    width_mhz: int
    streams: int
    guard_ns: int


def _common(first: PhyCapability, second: PhyCapability) -> _Common:
    amendment = min(first.amendment, second.amendment, key=_ORDER.index)
    if amendment == "ac" and first.band_name == "2.4 GHz":
        amendment = "n"
    phy_format = _FORMATS[amendment]
    width_mhz = min(first.width_mhz, second.width_mhz, max(_SUBCARRIERS[phy_format]))
    guard_ns = max(first.guard_interval_ns, second.guard_interval_ns)
    if amendment != "ax":
        guard_ns = min(guard_ns, 800)
    return _Common(phy_format, width_mhz, min(first.streams, second.streams), guard_ns)


def common_modes(first: PhyCapability, second: PhyCapability) -> tuple[WifiMode, ...]:
    """Return the modes that two stations of one band support, slowest first.

    They use the latest amendment, the widest channel and the shortest guard interval that both support, and every
    number of streams that both support. With a station of an earlier amendment, a station of 802.11ax uses a guard
    interval of 800 ns.
    """
    common = _common(first, second)
    modes = [
        mode
        for count in range(1, common.streams + 1)
        for mode in format_modes(common.phy_format, first.band_name, common.width_mhz, count, common.guard_ns)
    ]
    return tuple(sorted(modes, key=lambda mode: (mode.rate_bit_s, mode.streams)))


def mode_groups(first: PhyCapability, second: PhyCapability) -> tuple[tuple[WifiMode, ...], ...]:
    """Return the modes that two stations of one band support in their common format, also in narrower channels.

    There is a group for each width, guard interval (longest first) and number of streams, in this order; the modes of
    a group are slowest first.
    """
    common = _common(first, second)
    widths = [width_mhz for width_mhz in _SUBCARRIERS[common.phy_format] if width_mhz <= common.width_mhz]
    intervals = [guard_ns for guard_ns in guard_intervals_ns(common.phy_format) if guard_ns >= common.guard_ns]
    return tuple(
        format_modes(common.phy_format, first.band_name, width_mhz, streams, guard_ns)
        for width_mhz, guard_ns, streams in product(widths, reversed(intervals), range(1, common.streams + 1))
    )


@cache
def format_modes(
    phy_format: HighThroughput, band_name: BandName, width_mhz: int, streams: int, guard_interval_ns: int
) -> tuple[WifiMode, ...]:
    """Return the modes of all MCS of a format, slowest first; each call returns the same objects."""
    return tuple(
        _mode(phy_format, BANDS[band_name], mcs, width_mhz=width_mhz, streams=streams, guard_ns=guard_interval_ns)
        for mcs in range(_MCS_COUNT[phy_format])
        # Tables 21-29 and 21-30: N_DBPS would not be an integer.
        if not (phy_format == "VHT" and width_mhz == 20 and mcs == 9)
    )


def _mode(
    phy_format: HighThroughput, band: Band, mcs: int, *, width_mhz: int, streams: int, guard_ns: int
) -> WifiMode:
    modulation, code_rate = _MCS[mcs]
    coded_bits = _SUBCARRIERS[phy_format][width_mhz] * BITS_PER_SUBCARRIER[modulation] * streams
    bits = int(coded_bits * code_rate)  # rounded down: 27.5, HE-MCS 9 and 11 of 996 tones
    is_short = phy_format != "HE" and guard_ns == 400
    number = mcs + 8 * (streams - 1) if phy_format == "HT" else mcs
    return WifiMode(
        f"{phy_format.lower()}{width_mhz}-mcs{number}-{streams}ss-{guard_ns}ns",
        modulation,
        code_rate,
        bits,
        phy_format,
        band,
        _preamble_ns(phy_format, streams, guard_ns),
        (_HE_SYMBOL_NS if phy_format == "HE" else SYMBOL_NS - 800) + guard_ns,
        SYMBOL_NS if is_short else 1,
        width_mhz,
        streams,
        -(-bits // _ENCODER_BITS_PER_SYMBOL[phy_format]),
    )


def _preamble_ns(phy_format: HighThroughput, streams: int, guard_interval_ns: int) -> int:
    """Return the duration of the preamble in mixed format (HT: 19.4.3; VHT: 21.4.3; HE: 27.4.3).

    After the legacy preamble, HT has HT-SIG (8 us), HT-STF (4 us) and an HT-LTF of 4 us per stream; VHT has
    VHT-SIG-A (8 us), VHT-STF, a VHT-LTF per stream and VHT-SIG-B (4 us each); HE has RL-SIG (4 us), HE-SIG-A (8 us),
    HE-STF (4 us) and an HE-LTF per stream.
    """
    match phy_format:
        case "HT":
            return _LEGACY_PREAMBLE_NS + 8_000 + 4_000 + 4_000 * streams
        case "VHT":
            return _LEGACY_PREAMBLE_NS + 8_000 + 4_000 + 4_000 * streams + 4_000
        case "HE":
            return _LEGACY_PREAMBLE_NS + 4_000 + 8_000 + 4_000 + _HE_LTF_NS[guard_interval_ns] * streams


def guard_intervals_ns(phy_format: HighThroughput) -> tuple[int, ...]:
    """Return the guard intervals of a format."""
    return tuple(_HE_LTF_NS) if phy_format == "HE" else (400, 800)


@cache
def _names() -> tuple[str, ...]:
    return tuple(mode.name for mode in _format_modes(BANDS["5 GHz"]))


def _format_modes(band: Band) -> Iterator[WifiMode]:
    for phy_format, widths in _SUBCARRIERS.items():
        for width_mhz, streams, guard_ns in product(widths, (1, 2), guard_intervals_ns(phy_format)):
            yield from format_modes(phy_format, band.name, width_mhz, streams, guard_ns)


def mode_names() -> tuple[str, ...]:
    """Return the names of all modes of all bands."""
    return (*(mode.name for mode in (*G_MODES, *N_MODES, *OFDM_MODES["5 GHz"])), *_names())


def mode_named(name: str, band: Band) -> WifiMode | None:
    """Return the mode of this name in a band, or None if no mode has the name."""
    legacy = (*G_MODES, *N_MODES) if band is BAND_2_4 else OFDM_MODES[band.name]
    return next((mode for mode in (*legacy, *_format_modes(band)) if mode.name == name), None)
