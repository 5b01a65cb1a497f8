"""Quantiles of the delays of all sent packets. Lost packets have an infinite delay."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def quantile_of_sent(delays_s: Sequence[float] | NDArray[np.float64], sent: int, share: float) -> float | None:
    """Return a quantile of the delays of all sent packets. The delay of a lost packet is infinite.

    The quantile is interpolated linearly as by `numpy.quantile`, so it is the quantile of the received packets if no
    packet was lost.

    Args:
        delays_s: Delays of the received packets in seconds, in any order.
        sent: Number of sent packets. If it is below the number of delays, the number of delays is used.
        share: Which quantile, from 0 to 1.

    Returns:
        The quantile in seconds; None if it is infinite because too many packets were lost, or if no packet was sent.
    """
    total = max(sent, len(delays_s))
    position = share * (total - 1)
    if not len(delays_s) or math.ceil(position) >= len(delays_s):
        return None
    ordered = np.sort(np.asarray(delays_s, dtype=np.float64))
    low, high = float(ordered[math.floor(position)]), float(ordered[math.ceil(position)])
    return low + (high - low) * (position - math.floor(position))
