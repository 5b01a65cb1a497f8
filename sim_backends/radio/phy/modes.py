"""Frequency bands and modes (modulation and coding) of 802.11, and the airtime of frames.

This module contains the modes of 802.11a/g, and those of 802.11n with one stream in 20 MHz at 2.4 GHz. All other
modes of 802.11n, ac and ax are in `high_throughput`. Clauses refer to IEEE 802.11-2020: 17 (OFDM), 18 (ERP-OFDM,
802.11g: clause 17 at 2.4 GHz), 19 (HT, 802.11n), 21 (VHT, 802.11ac); clause 27 (HE) is in IEEE 802.11ax-2021.
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property
from typing import Final, Literal

Standard = Literal["802.11g", "802.11n"]
Modulation = Literal["BPSK", "QPSK", "16-QAM", "64-QAM", "256-QAM", "1024-QAM"]
PhyFormat = Literal["OFDM", "HT", "VHT", "HE"]
BandName = Literal["2.4 GHz", "5 GHz", "6 GHz"]

BITS_PER_SUBCARRIER: Final[dict[Modulation, int]] = {
    "BPSK": 1,
    "QPSK": 2,
    "16-QAM": 4,
    "64-QAM": 6,
    "256-QAM": 8,
    "1024-QAM": 10,
}

SLOT_NS: Final = 9_000
"""Duration of a backoff slot: the short slot of tables 17-21 and 18-5, because there is no 802.11b station."""


@dataclass(frozen=True, eq=False)
class Band:
    """A frequency band, and the times that depend on it.

    Attributes:
        name: Its name.
        carrier_hz: Centre frequency of the modelled channel.
        sifs_ns: Short inter-frame space: tables 17-21, 18-5 and 27-54.
        signal_extension_ns: Time without signal after each OFDM frame, during which the receiver decodes (18.5.3.2).
    """

    name: BandName
    carrier_hz: float
    sifs_ns: int
    signal_extension_ns: int

    def __deepcopy__(self, memo: dict[int, object]) -> "Band":
        return self

    @property
    def difs_ns(self) -> int:
        """Inter-frame space before the backoff of stations without QoS: 10.3.7."""
        return self.sifs_ns + 2 * SLOT_NS

    @property
    def best_effort_aifs_ns(self) -> int:
        """Inter-frame space of the access category best effort, AIFSN 3: 10.3.2.3.6 and table 9-155."""
        return self.sifs_ns + 3 * SLOT_NS


CHANNEL_6_HZ: Final = 2.437e9
"""Centre frequency of channel 6."""

BAND_2_4: Final = Band("2.4 GHz", CHANNEL_6_HZ, 10_000, 6_000)
BANDS: Final[dict[BandName, Band]] = {
    "2.4 GHz": BAND_2_4,
    # Channel 42 at 5 GHz and channel 7 at 6 GHz, which are 80 MHz wide.
    "5 GHz": Band("5 GHz", 5.21e9, 16_000, 0),
    "6 GHz": Band("6 GHz", 5.985e9, 16_000, 0),
}

SIFS_NS: Final = BAND_2_4.sifs_ns
DIFS_NS: Final = BAND_2_4.difs_ns
"""Inter-frame spaces at 2.4 GHz."""

CW_MIN: Final = 15
CW_MAX: Final = 1023
"""Smallest and largest contention window (table 18-5)."""
SHORT_RETRY_LIMIT: Final = 7
"""Largest number of attempts (dot11ShortRetryLimit, annex C)."""

ENERGY_DETECTION_DBM: Final = -62.0
"""Any signal of at least this power keeps a station from sending: 17.3.10.6, 20 dB above -82 dBm."""

ACK_BYTES: Final = 14
"""Size of an ACK."""
SYMBOL_NS: Final = 4_000
"""Duration of an OFDM symbol with a guard interval of 800 ns."""
_SERVICE_BITS, _TAIL_BITS = 16, 6
"""Bits that are added before and after the data of a frame."""
_OFDM_PREAMBLE_NS: Final = 20_000
_HT_PREAMBLE_NS: Final = 36_000


@dataclass(frozen=True, eq=False)
class WifiMode:
    """Modulation, coding and format of a frame. Each mode is one object, so comparing and hashing use its identity.

    Attributes:
        name: Its name, for example `g54`, `n7` or `vht80-mcs9-2ss-400ns`.
        modulation: Modulation of each subcarrier.
        code_rate: Rate of the convolutional code.
        bits_per_symbol: Data bits of all streams in an OFDM symbol, N_DBPS.
        phy_format: Format of the frame.
        band: Band in which it is used.
        preamble_ns: Duration of the preamble and headers before the data.
        symbol_ns: Duration of a symbol with its guard interval.
        granularity_ns: The data end at a multiple of this time after the preamble: 4 us for short guard intervals
            (19.4.3, 21.4.3).
        width_mhz: Channel width.
        streams: Number of spatial streams.
        encoders: Number of convolutional encoders, N_ES, each of which needs 6 tail bits.
    """

    name: str
    modulation: Modulation
    code_rate: Fraction
    bits_per_symbol: int
    phy_format: PhyFormat = "OFDM"
    band: Band = BAND_2_4
    preamble_ns: int = _OFDM_PREAMBLE_NS
    symbol_ns: int = SYMBOL_NS
    granularity_ns: int = 1
    width_mhz: int = 20
    streams: int = 1
    encoders: int = 1

    def __deepcopy__(self, memo: dict[int, object]) -> "WifiMode":
        return self

    @property
    def is_high_throughput(self) -> bool:
        """True for a mode of 802.11n or later."""
        return self.phy_format != "OFDM"

    @property
    def rate_bit_s(self) -> int:
        """PHY data rate: data bits per symbol divided by the symbol duration."""
        return self.bits_per_symbol * 1_000_000_000 // self.symbol_ns

    @property
    def guard_interval_ns(self) -> int:
        """Guard interval: the symbol duration minus 12.8 us in HE and minus 3.2 us in other formats."""
        return self.symbol_ns - (12_800 if self.phy_format == "HE" else 3_200)

    @cached_property
    def noise_factor(self) -> float:
        """Noise power relative to the noise power in 20 MHz."""
        return self.width_mhz / 20

    def airtime_ns(self, size_bytes: int) -> int:
        """Return the time for which a frame of `size_bytes`, with MAC header and FCS, occupies the channel.

        TXTIME of 17.4.3 (OFDM), 19.4.3 (HT, mixed format), 21.4.3 (VHT), 27.4.3 (HE, single user, no packet
        extension), with the signal extension of the band.
        """
        data_ns = -(-(self._overhead_bits + 8 * size_bytes) // self.bits_per_symbol) * self.symbol_ns
        if self.granularity_ns > 1:
            data_ns = -(-data_ns // self.granularity_ns) * self.granularity_ns
        return self._overhead_ns + data_ns

    @cached_property
    def _overhead_bits(self) -> int:
        return _SERVICE_BITS + _TAIL_BITS * self.encoders

    @cached_property
    def _overhead_ns(self) -> int:
        return self.preamble_ns + self.band.signal_extension_ns


def _modes(letter: str, band: Band, table: tuple[tuple[str, Modulation, int, int, int], ...]) -> tuple[WifiMode, ...]:
    phy_format: PhyFormat = "HT" if letter == "n" else "OFDM"
    preamble_ns = _HT_PREAMBLE_NS if letter == "n" else _OFDM_PREAMBLE_NS
    return tuple(
        WifiMode(f"{letter}{name}", modulation, Fraction(data, coded), bits, phy_format, band, preamble_ns)
        for name, modulation, data, coded, bits in table
    )


# Table 17-4.
_OFDM_TABLE: Final[tuple[tuple[str, Modulation, int, int, int], ...]] = (
    ("6", "BPSK", 1, 2, 24),
    ("9", "BPSK", 3, 4, 36),
    ("12", "QPSK", 1, 2, 48),
    ("18", "QPSK", 3, 4, 72),
    ("24", "16-QAM", 1, 2, 96),
    ("36", "16-QAM", 3, 4, 144),
    ("48", "64-QAM", 2, 3, 192),
    ("54", "64-QAM", 3, 4, 216),
)
G_MODES: Final = _modes("g", BAND_2_4, _OFDM_TABLE)
# Table 19-27.
N_MODES: Final = _modes(
    "n",
    BAND_2_4,
    (
        ("0", "BPSK", 1, 2, 26),
        ("1", "QPSK", 1, 2, 52),
        ("2", "QPSK", 3, 4, 78),
        ("3", "16-QAM", 1, 2, 104),
        ("4", "16-QAM", 3, 4, 156),
        ("5", "64-QAM", 2, 3, 208),
        ("6", "64-QAM", 3, 4, 234),
        ("7", "64-QAM", 5, 6, 260),
    ),
)
MODES: Final[dict[Standard, tuple[WifiMode, ...]]] = {"802.11g": G_MODES, "802.11n": N_MODES}

OFDM_MODES: Final[dict[BandName, tuple[WifiMode, ...]]] = {
    "2.4 GHz": G_MODES,
    "5 GHz": _modes("a", BANDS["5 GHz"], _OFDM_TABLE),
    "6 GHz": _modes("a", BANDS["6 GHz"], _OFDM_TABLE),
}
"""The non-HT modes of each band."""

# Indices of the mandatory rates of clause 17, fastest first.
_MANDATORY: Final = (4, 2, 0)


def basic_mode(band: Band) -> WifiMode:
    """Return the mode of broadcasts: the lowest basic rate, which every station supports (10.6.5.3)."""
    return OFDM_MODES[band.name][0]


@cache
def control_mode(mode: WifiMode) -> WifiMode:
    """Return the mode of the ACK to a frame in `mode`: the fastest mandatory rate up to the frame's rate (10.6.6.5).

    The rate of an HT, VHT or HE frame is its non-HT reference rate: the rate of the clause 17 mode with the same
    modulation and code rate, or 54 Mbit/s if there is no such mode (10.6.11).
    """
    reference, modes = mode, OFDM_MODES[mode.band.name]
    if mode.is_high_throughput:
        matches = [
            ofdm_mode
            for ofdm_mode in modes
            if (ofdm_mode.modulation, ofdm_mode.code_rate) == (mode.modulation, mode.code_rate)
        ]
        reference = matches[0] if matches else modes[-1]
    return next(modes[index] for index in _MANDATORY if modes[index].bits_per_symbol <= reference.bits_per_symbol)


@cache
def ack_ns(mode: WifiMode) -> int:
    """Return the airtime of the ACK to a frame in `mode`."""
    return response_ns(mode, ACK_BYTES)


@cache
def response_ns(mode: WifiMode, size_bytes: int) -> int:
    """Return the airtime of the ACK or Block Ack of this size to a frame in `mode`."""
    return control_mode(mode).airtime_ns(size_bytes)
