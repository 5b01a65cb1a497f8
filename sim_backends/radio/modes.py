"""Modulation and coding of 802.11g and of 802.11n with one stream in 20 MHz: airtime of frames, and packet errors.

Clauses refer to IEEE 802.11-2020: 17 (OFDM), 18 (ERP-OFDM, 802.11g: clause 17 at 2.4 GHz), 19 (HT, 802.11n).

Packet errors by noise follow from the bit error rate of the modulation and from the convolutional code. The model is
that of Pei and Henderson, "Validation of OFDM error rate model in ns-3" (2010), after Miller, "Validation of
802.11a/UWB coexistence simulation" (NIST, 2003): hard decisions on a channel with additive white Gaussian noise; the
error probability of the code by the union bound over its weight spectrum.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import Final, Literal

from fieldkit.config.profiles import Radio
from fieldkit.core.errors import ConfigurationError

Standard = Literal["802.11g", "802.11n"]
Modulation = Literal["BPSK", "QPSK", "16-QAM", "64-QAM"]

SIFS_NS: Final = 10_000
SLOT_NS: Final = 9_000
DIFS_NS: Final = SIFS_NS + 2 * SLOT_NS
"""Table 18-5, short slot: there is no 802.11b station. DIFS by 10.3.7."""

CW_MIN: Final = 15
CW_MAX: Final = 1023
SHORT_RETRY_LIMIT: Final = 7
"""CW of table 18-5; dot11ShortRetryLimit by annex C."""

ENERGY_DETECTION_DBM: Final = -62.0
"""Any signal of at least this power keeps a station from sending: 17.3.10.6, 20 dB above -82 dBm."""

ACK_BYTES: Final = 14
_SYMBOL_NS: Final = 4_000
_SIGNAL_EXTENSION_NS: Final = 6_000
_SERVICE_AND_TAIL_BITS: Final = 16 + 6
_OFDM_PREAMBLE_NS: Final = 20_000
_HT_PREAMBLE_NS: Final = 36_000


@dataclass(frozen=True, eq=False)
class WifiMode:
    """A combination of modulation and coding; one object exists for each, so comparing and hashing use the identity.

    Attributes:
        name: `g54` or `n7`.
        modulation: Modulation of each subcarrier.
        code_rate: Rate of the convolutional code.
        bits_per_symbol: Data bits in an OFDM symbol of 4 us, N_DBPS.
        ht: True for a mode of 802.11n.
    """

    name: str
    modulation: Modulation
    code_rate: Fraction
    bits_per_symbol: int
    ht: bool = False

    def __deepcopy__(self, memo: dict[int, object]) -> "WifiMode":
        return self

    @property
    def rate_bit_s(self) -> int:
        """Data bits per second within symbols."""
        return self.bits_per_symbol * 1_000_000_000 // _SYMBOL_NS

    def airtime_ns(self, size_bytes: int) -> int:
        """Return the time for which a frame of `size_bytes`, with MAC header and FCS, occupies the channel.

        TXTIME of 17.4.3 with the signal extension of 18.5.3.2 for ERP-OFDM; TXTIME of 19.4.3 for HT in mixed format
        with one stream (legacy preamble 20 us, HT-SIG 8 us, one HT-STF and one HT-LTF of 4 us each), with the same
        extension.
        """
        symbols = -(-(_SERVICE_AND_TAIL_BITS + 8 * size_bytes) // self.bits_per_symbol)
        return self.preamble_ns + symbols * _SYMBOL_NS + _SIGNAL_EXTENSION_NS

    @property
    def preamble_ns(self) -> int:
        """Duration of the preamble and headers before the data."""
        return _HT_PREAMBLE_NS if self.ht else _OFDM_PREAMBLE_NS


def _modes(letter: str, table: tuple[tuple[str, Modulation, int, int, int], ...]) -> tuple[WifiMode, ...]:
    return tuple(
        WifiMode(f"{letter}{name}", modulation, Fraction(data, coded), bits, letter == "n")
        for name, modulation, data, coded, bits in table
    )


# Tables 17-4 and 19-27.
G_MODES: Final = _modes(
    "g",
    (
        ("6", "BPSK", 1, 2, 24),
        ("9", "BPSK", 3, 4, 36),
        ("12", "QPSK", 1, 2, 48),
        ("18", "QPSK", 3, 4, 72),
        ("24", "16-QAM", 1, 2, 96),
        ("36", "16-QAM", 3, 4, 144),
        ("48", "64-QAM", 2, 3, 192),
        ("54", "64-QAM", 3, 4, 216),
    ),
)
N_MODES: Final = _modes(
    "n",
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

BASIC: Final = G_MODES[0]
"""The mode of broadcasts and multicasts: the lowest basic rate, which every station receives (10.6.5.3)."""

# The mandatory rates of clause 18.
_CONTROL_MODES: Final = (G_MODES[4], G_MODES[2], G_MODES[0])


def standard_of(radio: Radio) -> Standard:
    """Return the standard of a robot's radio; any standard other than 802.11n is treated as 802.11g."""
    return "802.11n" if radio.standard.startswith("802.11n") else "802.11g"


def fixed_mode(name: str | None, standards: Mapping[str, Standard]) -> WifiMode | None:
    """Return the mode in which all stations must send; stations of 802.11n also support the modes of 802.11g.

    Args:
        name: Name of the mode; None if each station chooses its mode.
        standards: Standards of the stations, by name.

    Raises:
        ConfigurationError: A station does not support the mode.
    """
    if name is None:
        return None
    mode = next(mode for mode in (*G_MODES, *N_MODES) if mode.name == name)
    for station, standard in standards.items():
        if mode.ht and standard != "802.11n":
            raise ConfigurationError(
                f"radio.mode {name} is a mode of 802.11n, but {station} supports only {standard}",
                remedy=f"use a mode that all stations support: {', '.join(mode.name for mode in G_MODES)}",
            )
    return mode


@cache
def control_mode(mode: WifiMode) -> WifiMode:
    """Return the mode of the ACK to a frame in `mode`: the fastest mandatory rate that is no faster (10.6.6.5).

    The reference rate of an HT mode is that of the clause 17 mode with its modulation and code rate (10.6.11).
    """
    reference = mode
    if mode.ht:
        matches = [
            g_mode for g_mode in G_MODES if (g_mode.modulation, g_mode.code_rate) == (mode.modulation, mode.code_rate)
        ]
        reference = matches[0] if matches else G_MODES[-1]
    return next(control for control in _CONTROL_MODES if control.bits_per_symbol <= reference.bits_per_symbol)


@cache
def ack_ns(mode: WifiMode) -> int:
    """Return the airtime of the ACK to a frame in `mode`."""
    return control_mode(mode).airtime_ns(ACK_BYTES)


# Input bits per step, free distance, and the sum of bit errors over the paths of each weight from the free distance
# upwards, for the generators 133, 171 and the punctured codes: Haccoun and Begin, IEEE Trans. Commun. 37:1113 (1989);
# Frenger, Orten and Ottosson, IEEE Commun. Lett. 3:317 (1999).
_SPECTRA: Final[Mapping[Fraction, tuple[int, int, tuple[int, ...]]]] = {
    Fraction(1, 2): (
        1,
        10,
        (36, 0, 211, 0, 1404, 0, 11633, 0, 77433, 0, 502690, 0, 3322763, 0, 21292910, 0, 134365911),
    ),
    Fraction(2, 3): (2, 6, (3, 70, 285, 1276, 6160, 27128, 117019, 498860, 2103891, 8784123)),
    Fraction(3, 4): (3, 5, (42, 201, 1492, 10469, 62935, 379644, 2253373, 13073811, 75152755, 428005675)),
    Fraction(5, 6): (
        5,
        4,
        (92, 528, 8694, 79453, 792114, 7375573, 67884974, 610875423, 5427275376, 47664215639),
    ),
}

_STEP_DB: Final = 0.05
_LOWEST_DB: Final = -10.0
_HIGHEST_DB: Final = 40.0


def bit_error(mode: WifiMode, snr: float) -> float:
    """Return the share of coded bits in error at the signal-to-noise power ratio `snr` in the signal's bandwidth.

    Proakis, Digital Communications, 4th ed., 5.2: Gray-coded, per subcarrier.
    """
    match mode.modulation:
        case "BPSK":
            return 0.5 * math.erfc(math.sqrt(snr))
        case "QPSK":
            return 0.5 * math.erfc(math.sqrt(snr / 2))
        case "16-QAM":
            return 0.75 * 0.5 * math.erfc(math.sqrt(snr / 10))
        case "64-QAM":
            return 7 / 12 * 0.5 * math.erfc(math.sqrt(snr / 42))


def decoded_bit_error(mode: WifiMode, snr: float) -> float:
    """Return an upper bound (the union bound) of the share of data bits in error after decoding, at most 1."""
    raw = bit_error(mode, snr)
    bhattacharyya = math.sqrt(4 * raw * (1 - raw))
    inputs, free_distance, weights = _SPECTRA[mode.code_rate]
    bound = sum(
        weight * bhattacharyya ** (free_distance + excess_weight) for excess_weight, weight in enumerate(weights)
    )
    return min(bound / (2 * inputs), 1.0)


@cache
def _log_success_per_bit(mode: WifiMode) -> tuple[float, ...]:
    """Return ln(1 - p) of a decoded bit at each step of the table, -inf if p is 1."""
    steps = round((_HIGHEST_DB - _LOWEST_DB) / _STEP_DB)
    errors = (decoded_bit_error(mode, 10 ** ((_LOWEST_DB + n * _STEP_DB) / 10)) for n in range(steps + 1))
    return tuple(math.log1p(-error) if error < 1 else -math.inf for error in errors)


def log_success(mode: WifiMode, snr_db: float, bits: float) -> float:
    """Return ln of the probability that `bits` data bits arrive without error at `snr_db`; -inf if it is 0.

    The value is interpolated linearly in a table with steps of 0.05 dB, which is within 0.002 dB of the formula.
    Without interpolation the error would be up to 0.05 dB, which corrupts a tenth more of the frames at the edge of a
    link's range.
    """
    steps = (snr_db - _LOWEST_DB) / _STEP_DB
    if steps <= 0:
        return -math.inf
    table = _log_success_per_bit(mode)
    step = int(steps)
    if step >= len(table) - 1:
        return bits * table[-1]
    below, above = table[step], table[step + 1]
    if below == -math.inf:
        return below
    return bits * (below + (above - below) * (steps - step))


def packet_error(mode: WifiMode, snr_db: float, size_bytes: int) -> float:
    """Return the probability that a frame of `size_bytes` is corrupted at `snr_db`."""
    return -math.expm1(log_success(mode, snr_db, 8 * size_bytes))
