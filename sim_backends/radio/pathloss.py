"""How strong a signal arrives, and what 802.11g makes of it."""

import math
from typing import Final

SPEED_OF_LIGHT_M_S: Final = 299_792_458.0

# Minimum sensitivity per bit rate, 20 MHz channel: IEEE 802.11-2020, 17.3.10.2, table 17-18; clause 18 (802.11g)
# takes it over for 2.4 GHz.
SENSITIVITY_DBM: Final = {
    6_000_000: -82.0,
    9_000_000: -81.0,
    12_000_000: -79.0,
    18_000_000: -77.0,
    24_000_000: -74.0,
    36_000_000: -70.0,
    48_000_000: -66.0,
    54_000_000: -65.0,
}
BASIC_RATE_BIT_S: Final = 6_000_000

# The same table defines sensitivity: a tenth of frames of 1000 octets is lost at it.
_PACKET_ERROR_AT_SENSITIVITY: Final = 0.1
_BITS_AT_SENSITIVITY: Final = 8000
_BIT_ERROR_AT_SENSITIVITY: Final = -math.log1p(-_PACKET_ERROR_AT_SENSITIVITY) / _BITS_AT_SENSITIVITY

# Signal to noise that the slowest rate needs: its sensitivity over the noise that the standard assumes for the table,
# -101 dBm thermal in 20 MHz, 10 dB noise figure (and 5 dB for the implementation, which stays in the need).
_SNR_OF_BASIC_RATE_DB: Final = SENSITIVITY_DBM[BASIC_RATE_BIT_S] - (-101.0 + 10.0)


def log_distance_loss_db(distance_m: float, *, exponent: float, reference_loss_db: float) -> float:
    """Return the path loss in dB by the log-distance law, L(1 m) + 10 n log10(d / 1 m).

    Source: Rappaport, Wireless Communications, 2nd ed., 4.9.1. Nearer than 1 m the loss stays that of 1 m.
    """
    return reference_loss_db + 10.0 * exponent * math.log10(max(distance_m, 1.0))


def propagation_delay_ns(distance_m: float) -> int:
    """Return the time that light takes over `distance_m`, in nanoseconds."""
    return round(distance_m / SPEED_OF_LIGHT_M_S * 1e9)


def threshold_dbm(*, sensitivity_dbm: float, noise_floor_dbm: float) -> float:
    """Return the weakest usable signal in dBm: the receiver's own limit, or what the noise leaves of it."""
    return max(sensitivity_dbm, noise_floor_dbm + _SNR_OF_BASIC_RATE_DB)


def bit_rate_bit_s(margin_db: float) -> int | None:
    """Return the fastest 802.11g bit rate for a signal `margin_db` above the threshold; None out of range.

    The steps between the rates are those of the sensitivity table: 54 Mbit/s needs 17 dB more than 6 Mbit/s.
    """
    level_dbm = SENSITIVITY_DBM[BASIC_RATE_BIT_S] + margin_db
    return max((rate for rate, needed_dbm in SENSITIVITY_DBM.items() if level_dbm >= needed_dbm), default=None)


def bit_error_rate(margin_db: float) -> float:
    """Return the residual bit error rate of a link `margin_db` above the threshold of the slowest rate.

    b(m) = b(0) 10^(-m / 10 dB): at the threshold a tenth of 1000-byte frames is lost, as sensitivity is defined, and
    each 10 dB of margin divides the loss by ten, the slope of outage on a Rayleigh channel without diversity (Tse
    and Viswanath, Fundamentals of Wireless Communication, 3.1.2). The margin counts from the slowest rate because
    rate control falls back before it gives a frame up. 1500-byte packets lose 15 % at 0 dB, 0.02 % at 30 dB.
    """
    return _BIT_ERROR_AT_SENSITIVITY * math.pow(10.0, -margin_db / 10.0)
