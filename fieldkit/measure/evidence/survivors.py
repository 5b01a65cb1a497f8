"""Statistics of delays that also count what was lost, which a statistic over what arrived leaves out."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def quantile_of_sent(arrived_s: Sequence[float] | NDArray[np.float64], sent: int, share: float) -> float | None:
    """Return a quantile of the delays of all that was sent, where what was lost is later than all that arrived.

    Interpolated linearly, as `numpy.quantile`, so that it is the quantile of what arrived if nothing was lost.

    Args:
        arrived_s: Delays of what arrived, in seconds, in any order.
        sent: How many were sent; taken as the number of delays if it is smaller.
        share: Which quantile, 0 to 1.

    Returns:
        None if it is infinite, since too many were lost, or where nothing was sent.
    """
    total = max(sent, len(arrived_s))
    place = share * (total - 1)
    if not len(arrived_s) or math.ceil(place) >= len(arrived_s):
        return None
    ordered = np.sort(np.asarray(arrived_s, dtype=np.float64))
    low, high = float(ordered[math.floor(place)]), float(ordered[math.ceil(place)])
    return low + (high - low) * (place - math.floor(place))
