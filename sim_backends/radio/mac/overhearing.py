"""Decoding of frames by stations to which they are not addressed, for EIFS (IEEE 802.11-2020, 10.3.2.3.7).

Most frames are clearly above or below the signal that a station needs. Two thresholds per mode and size detect these
cases, so that only the others need an error probability and a random draw.
"""

import math
from functools import cache
from typing import Final

from sim_backends.radio.phy.error_rates import log_success
from sim_backends.radio.phy.modes import WifiMode
from sim_backends.radio.phy.transmissions import Transmission, part_success_probability, success_probability

_CERTAIN: Final = 1e-6
"""Error probability, or success probability, that counts as 0."""

LARGEST_MAGNITUDE: Final = (11_454).bit_length()
"""Number of binary digits of the size of the largest frame in bytes."""

# Search range of the thresholds in dB, and the number of bisections (0.0001 dB).
_RANGE_DB: Final = (-20.0, 60.0)
_BISECTIONS: Final = 20


@cache
def certain_ratios(mode: WifiMode, magnitude: int) -> tuple[float, float]:
    """Return two ratios of signal to noise in 20 MHz: no frame is decoded below the first, all above the second.

    Args:
        mode: Mode of the frame.
        magnitude: Number of binary digits of its size in bytes.
    """
    never_db = _threshold_db(mode, 1 << (magnitude - 1), math.log(_CERTAIN))
    always_db = _threshold_db(mode, 1 << magnitude, math.log1p(-_CERTAIN))
    never, always = (mode.noise_factor * 10 ** (ratio_db / 10) for ratio_db in (never_db, always_db))
    return never, always


def _threshold_db(mode: WifiMode, size_bytes: int, logarithm: float) -> float:
    """Return the ratio at which the logarithm of the success probability has this value."""
    low_db, high_db = _RANGE_DB
    for _ in range(_BISECTIONS):
        middle_db = (low_db + high_db) / 2
        if log_success(mode, middle_db, 8.0 * size_bytes) < logarithm:
            low_db = middle_db
        else:
            high_db = middle_db
    return high_db


def always_decoded_ratio(transmission: Transmission) -> float:
    """Return the ratio of signal to noise in 20 MHz at which a station certainly decodes a frame."""
    return certain_ratios(transmission.mode, _magnitude(transmission))[1]


def decoding_probability(transmission: Transmission, station: int, noise_mw: float) -> float:
    """Return the probability that a station decodes a frame, or at least one frame of an aggregate.

    The frames of an aggregate count as equally long.

    Args:
        transmission: The frame or aggregate.
        station: Index of the station.
        noise_mw: Its noise power in 20 MHz.
    """
    never, always = certain_ratios(transmission.mode, _magnitude(transmission))
    signal_mw, interferers = transmission.powers_mw[station], transmission.interferers
    if signal_mw < never * noise_mw:
        return 0.0
    # All interference together, even if it overlaps only a part of the frame.
    interference_mw = sum([other.powers_mw[station] for other in interferers])
    factor = transmission.mode.noise_factor
    if signal_mw * factor >= always * (noise_mw * factor + interference_mw):
        return 1.0
    parts = transmission.frame_count
    if parts == 1:
        return success_probability(transmission, station, noise_mw)
    start_ns = transmission.start_ns + transmission.mode.preamble_ns
    length_ns, bits = (transmission.end_ns - start_ns) / parts, 8.0 * transmission.size_bytes / parts
    failure = 1.0
    # The last frames are first, because interference often overlaps only the first ones.
    for part in reversed(range(parts)):
        part_ns = start_ns + round(part * length_ns), start_ns + round((part + 1) * length_ns)
        failure *= 1 - part_success_probability(transmission, station, noise_mw, part_ns, bits)
        if failure < _CERTAIN:
            return 1.0
    return 1 - failure


def _magnitude(transmission: Transmission) -> int:
    return (transmission.size_bytes // transmission.frame_count).bit_length()
