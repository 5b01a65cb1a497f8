"""One-sided 95 % bounds that expectations are judged by: shares of repeats, and of packets lost in bursts."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from fieldkit.analysis.statistics import CONFIDENCE

SHORTEST_BURST: Final = 10
"""Packets. Shortest burst of losses that a bound assumes, whatever the data show.

A convention and no measurement: 0 losses show nothing about bursts. Where losses come in longer bursts that are so
rare that none was in the run, the true loss may be above the bound.
"""

_BISECTIONS: Final = 60


def share_low(met: int, n: int) -> float:
    """Return the lower bound of the share of all repeats that meet a demand.

    Exact (Clopper and Pearson 1934, Biometrika 26:404), one-sided: the share with which `met` or more of `n` repeats
    meet it in 5 % of such samples.
    """
    if met == 0:
        return 0.0
    return _solve(lambda share: _at_most(n - met, n, 1 - share), 1 - CONFIDENCE)


def share_high(met: int, n: int) -> float:
    """Return the upper bound of that share, likewise."""
    return 1 - share_low(n - met, n)


def repeats_for(share: float) -> int:
    """Return the least number of repeats of which all must meet a demand, to show it for this share of all repeats.

    From `share_low`: the least n with share^n <= 5 %.
    """
    return math.ceil(math.log(1 - CONFIDENCE) / math.log(share) * (1 - 1e-12))


def loss_high(lost: ArrayLike, sent: ArrayLike) -> float:
    """Return the upper bound of the share of packets lost, over the packets of all repeats.

    Losses come in bursts. A burst is taken to be as long as the losses of the worst repeat, which is the longest that
    these data allow, and `SHORTEST_BURST` at least. The number of bursts is then Poisson: with L packets in each, and
    X of N packets lost, the bound is L/N times the 95 % quantile of the gamma distribution of shape X/L + 1 (Garwood
    1936, Biometrika 28:437). Without losses it is 3 L/N: the rule of three with N/L for the number of trials.

    Fewer losses in any repeat never make the bound larger: it increases with X and with L.

    Args:
        lost: Packets lost by each repeat, shape (n,); below 0, where copies arrived, it is taken as 0.
        sent: Of how many, same shape.

    Returns:
        1 at most; 1 where nothing was sent.
    """
    losses = np.maximum(np.asarray(lost, dtype=np.float64), 0)
    total = float(np.sum(sent))
    if total <= 0:
        return 1.0
    burst = max(float(losses.max(initial=0)), SHORTEST_BURST)
    return min(burst * _gamma_quantile(float(losses.sum()) / burst + 1) / total, 1.0)


def packets_for(bound: float) -> int:
    """Return the least number of packets, none of them lost, for which `loss_high` is below `bound`."""
    return math.floor(SHORTEST_BURST * -math.log(1 - CONFIDENCE) / bound) + 1


def _gamma_quantile(shape: float) -> float:
    """Return the 95 % quantile of the gamma distribution of this shape, 1 or above, and scale 1."""
    most = shape + 5 * math.sqrt(shape) + 5
    return most * _solve(lambda part: _gamma_below(shape, most * part), CONFIDENCE)


def _gamma_below(shape: float, x: float) -> float:
    """Return the regularized lower incomplete gamma function, by its series (Abramowitz and Stegun 1964, 6.5.29)."""
    if x <= 0:
        return 0.0
    term = math.exp(shape * math.log(x) - x - math.lgamma(shape + 1))
    total, step = term, shape
    while term > total * 1e-16:
        step += 1
        term *= x / step
        total += term
    return min(total, 1.0)


def _at_most(k: int, n: int, share: float) -> float:
    """Return the probability of `k` or fewer of `n`, each with this share."""
    if share <= 0 or k >= n:
        return 1.0
    if share >= 1:
        return 0.0
    logs = (
        math.lgamma(n + 1)
        - math.lgamma(i + 1)
        - math.lgamma(n - i + 1)
        + i * math.log(share)
        + (n - i) * math.log1p(-share)
        for i in range(k + 1)
    )
    return min(math.fsum(map(math.exp, logs)), 1.0)


def _solve(rising: Callable[[float], float], goal: float) -> float:
    """Return where in 0..1 a function that rises there reaches `goal`."""
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < goal else (low, middle)
    return (low + high) / 2
