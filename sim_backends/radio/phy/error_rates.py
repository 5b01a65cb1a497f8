"""Packet errors due to noise: bit errors of the modulation, and the convolutional code.

The model is from Pei and Henderson, "Validation of OFDM error rate model in ns-3" (2010), which follows Miller,
"Validation of 802.11a/UWB coexistence simulation" (NIST, 2003). It assumes hard decisions on a channel with additive
white Gaussian noise. The error probability of the code is the union bound over its weight spectrum. Each spatial
stream has the signal-to-noise ratio of the frame, as in ns-3.
"""

import math
from collections.abc import Mapping
from fractions import Fraction
from functools import cache
from typing import Final

from sim_backends.radio.phy.modes import BITS_PER_SUBCARRIER, WifiMode

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

# Ratios of signal to noise in the table of `_log_success_per_bit`: step, lowest and highest.
_STEP_DB: Final = 0.05
_LOWEST_DB: Final = -10.0
_HIGHEST_DB: Final = 40.0


def bit_error(mode: WifiMode, snr: float) -> float:
    """Return the share of coded bits in error at the signal-to-noise power ratio `snr` in the signal's bandwidth.

    The formula (Proakis, Digital Communications, 4th ed., 5.2) is for one subcarrier with Gray code, and for errors
    between nearest neighbours.
    """
    if mode.modulation == "BPSK":
        return 0.5 * math.erfc(math.sqrt(snr))
    bits = BITS_PER_SUBCARRIER[mode.modulation]
    side = 1 << bits // 2
    neighbours = 4 * (side - 1) / (bits * side)
    return neighbours * 0.5 * math.erfc(math.sqrt(snr / (2 * (side * side - 1) / 3)))


def decoded_bit_error(mode: WifiMode, snr: float) -> float:
    """Return an upper bound (the union bound) of the share of data bits in error after decoding, at most 1."""
    coded_error = bit_error(mode, snr)
    bhattacharyya = math.sqrt(4 * coded_error * (1 - coded_error))
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
    Without interpolation the error would be up to 0.05 dB, which increases the number of corrupted frames at the edge
    of a link's range by a tenth. At -10 dB or less no bit arrives; above 40 dB the value is that at 40 dB.
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
