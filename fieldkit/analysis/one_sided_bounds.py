"""One-sided 95 % bounds for expectations: share of repeats that meet a requirement, share of lost packets."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from fieldkit.analysis.statistics import CONFIDENCE

SHORTEST_BURST: Final = 10
"""Shortest burst of losses that a bound assumes, in packets.

This is a convention, because data without losses contain no information about bursts. If losses occur in longer
bursts that are too rare to occur during the run, the true loss can be above the bound.
"""

ROUNDING: Final = 1e-12
"""A bound that is below a required share by at most this relative rounding error counts as equal to it."""

_BISECTIONS: Final = 60
"""Number of bisections of the range 0 to 1. The result is then as exact as a double can be."""


def share_low(met: int, n: int) -> float:
    """Return the one-sided lower bound of the share of all repeats that meet a requirement.

    The bound is exact (Clopper and Pearson 1934, Biometrika 26:404): it is the share for which `met` or more of `n`
    repeats meet the requirement with a probability of 5 %.
    """
    if met == 0:
        return 0.0
    return _solve(lambda share: _binomial_cdf(n - met, n, 1 - share), 1 - CONFIDENCE)


def share_high(met: int, n: int) -> float:
    """Return the one-sided upper bound of the share of all repeats that meet a requirement; see `share_low`."""
    return 1 - share_low(n - met, n)


def repeats_for(share: float) -> int:
    """Return the number of repeats needed to show that this share of all repeats meets a requirement.

    All of these repeats must meet the requirement. By `share_low`, it is the smallest n with share^n <= 5 %.
    """
    return math.ceil(math.log(1 - CONFIDENCE) / math.log(share) * (1 - ROUNDING))


def loss_high(lost: ArrayLike, sent: ArrayLike) -> float:
    """Return the one-sided upper bound of the share of lost packets, over the packets of all repeats.

    Losses occur in bursts. The assumed length of a burst is the number of losses in the worst repeat, which is the
    longest burst that the data permit, and at least `SHORTEST_BURST`. The number of bursts is assumed to have a
    Poisson distribution. With L packets per burst, and X of N packets lost, the bound is L/N times the 95 % quantile
    of the gamma distribution with the shape X/L + 1 (Garwood 1936, Biometrika 28:437). Without losses, it is 3 L/N:
    the rule of three with N/L trials.

    The bound increases with X and with L. Fewer losses in a repeat therefore never increase it.

    Args:
        lost: Lost packets of each repeat, shape (n,); a negative number, caused by duplicates, counts as 0.
        sent: Sent packets of each repeat, same shape.

    Returns:
        At most 1; 1 if no packet was sent.
    """
    losses = np.maximum(np.asarray(lost, dtype=np.float64), 0)
    total = float(np.sum(sent))
    if total <= 0:
        return 1.0
    burst = max(float(losses.max(initial=0)), SHORTEST_BURST)
    return min(burst * _gamma_quantile(float(losses.sum()) / burst + 1) / total, 1.0)


def packets_for(bound: float) -> int:
    """Return the smallest number of packets for which `loss_high` is below `bound` if no packet is lost."""
    return math.floor(SHORTEST_BURST * -math.log(1 - CONFIDENCE) / bound) + 1


def _gamma_quantile(shape: float) -> float:
    """Return the 95 % quantile of the gamma distribution of this shape, at least 1, and scale 1."""
    upper = shape + 5 * math.sqrt(shape) + 5
    return upper * _solve(lambda part: _gamma_cdf(shape, upper * part), CONFIDENCE)


def _gamma_cdf(shape: float, x: float) -> float:
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


def _binomial_cdf(k: int, n: int, share: float) -> float:
    """Return the probability of at most `k` successes in `n` trials with the success probability `share`."""
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


def _solve(increasing: Callable[[float], float], goal: float) -> float:
    """Return the argument in 0..1 at which an increasing function reaches `goal`, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if increasing(middle) < goal else (low, middle)
    return (low + high) / 2
