"""Texts of verdicts on differences."""

from dataclasses import replace

import pytest

from fieldkit.analysis import comparison_results
from fieldkit.analysis.compare import Difference, compare
from fieldkit.core.model import Interval
from tests.helpers.tables import COMPARABLE, bursty, parsed

ROWS = parsed(bursty(COMPARABLE, 3, seed=1))
BY_NAME = {change.quantity.name: change for change in compare(ROWS, ROWS).differences}


def between(
    quantity: str, interval: Interval | None, p_holm: float | None = None, threshold: float | None = None
) -> Difference:
    """Return a difference from 0."""
    change = BY_NAME[quantity]
    assert change.a is not None
    assert change.b is not None
    a, b = replace(change.a, value=0.0), replace(change.b, value=interval.value if interval else 0.0)
    return replace(change, a=a, b=b, interval=interval, p_holm=p_holm, threshold=threshold)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (between("ip_loss", Interval(0.031, 0.012, 0.05), 0.01), "B 3.10 points more [1.20, 5.00]"),
        (between("ip_loss", Interval(-0.031, -0.05, -0.012), 0.01), "B 3.10 points less [1.20, 5.00]"),
        (
            between("ip_loss", Interval(0.031, 0.012, 0.05), 0.06),
            "B 3.10 points more [1.20, 5.00]; may be chance among 20 comparisons",
        ),
        (between("ip_loss", Interval(0.01, -0.01, 0.02), 1.0), "no difference seen; up to 2.00 points possible"),
        (between("ip_loss", Interval(-0.01, -0.02, 0.01), 1.0), "no difference seen; up to 2.00 points possible"),
        (
            between("rtt_median_s", Interval(0.001, -0.001, 0.002), 1.0, threshold=0.002),
            "no difference seen; up to 2.00 ms possible; within 2 ms",
        ),
        (
            between("rtt_median_s", Interval(0.001, 0.0005, 0.002), 0.01, threshold=0.0015),
            "B 1.00 ms more [0.50, 2.00]; may exceed 1.5 ms",
        ),
        (between("ip_loss", None), "no interval, so no verdict"),
        (replace(between("ip_loss", None), a=None), "only B has it"),
        (replace(between("ip_loss", None), b=None, threshold=0.02), "only A has it; may exceed 2 points"),
    ],
)
def test_the_verdict_on_a_difference(change: Difference, expected: str) -> None:
    assert comparison_results.verdict(change, 20) == expected
