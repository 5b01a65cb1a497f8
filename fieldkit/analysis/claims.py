"""Number of repeats or packets that the expectations of a trial need, computed before the trial runs."""

import math
from collections.abc import Iterable, Iterator

from fieldkit.analysis import bounds
from fieldkit.analysis.expectations import Expectation, Scope
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.statistics import CONFIDENCE, MIN_FOR_ORDER_STATISTICS, NORMAL
from fieldkit.core.columns import Kind

_USUAL_SHARE = 0.9
"""Share of all repeats that is used to show the difference between `every` repeat of a trial and all repeats."""


def unmet_requirements(
    expectations: Iterable[Expectation], figures: Iterable[Quantity], repeats: int
) -> Iterator[str]:
    """Yield a sentence for each expectation that needs more repeats or packets than a trial has.

    Args:
        expectations: Expectations of the trial.
        figures: Quantities that its repeats measure, including those of the expectations.
        repeats: Number of repeats per protocol.
    """
    by_name = {quantity.name: quantity for quantity in figures}
    for expectation in expectations:
        if needs := _needs(expectation, by_name[expectation.quantity], repeats):
            yield f"expected {expectation.text}: {needs}"


def _needs(expectation: Expectation, quantity: Quantity, repeats: int) -> str:
    has = f"this trial has {repeats}"
    if expectation.scope is Scope.PACKETS:
        packets = bounds.packets_for(expectation.bound)
        return f"needs at least {packets} packets per condition for 95 % confidence, if none is lost"
    if expectation.scope is Scope.SHARE and expectation.share is not None:
        needed = bounds.repeats_for(expectation.share)
        text = f"needs at least {needed} repeats for 95 % confidence, if all meet it; {has}"
        return text if repeats < needed else ""
    if expectation.scope is Scope.EVERY:
        needed, shown = bounds.repeats_for(_USUAL_SHARE), bounds.share_low(repeats, repeats)
        return (
            f"is about the repeats of this trial; over {100 * _USUAL_SHARE:.0f} % of all repeats it needs at least "
            f"{needed} for 95 % confidence, and {repeats} show it for {math.floor(100 * shown)} %"
            if repeats < needed
            else ""
        )
    needed = _for_interval(expectation, quantity)
    if repeats < needed:
        alternative = f"; for these packets alone: {expectation.text} of all packets"
        has_alternative = quantity.kind is Kind.COUNTED and expectation.is_below
        return f"needs at least {needed} repeats for 95 % confidence, {_best_case(quantity)}; {has}" + (
            alternative if has_alternative else ""
        )
    if quantity.kind is Kind.MEDIAN and repeats < MIN_FOR_ORDER_STATISTICS:
        coverage = f"{100 * CONFIDENCE:.0f} % confidence for any distribution of the repeats"
        return f"needs at least {MIN_FOR_ORDER_STATISTICS} repeats for {coverage}; {has}"
    return ""


def _best_case(quantity: Quantity) -> str:
    """Return a description of the best results, for which this number of repeats is enough."""
    if quantity.kind is Kind.FLAG:
        return "if it is true in all of them"
    return "even if nothing is lost" if quantity.unit == "share" else "which give an interval"


def _for_interval(expectation: Expectation, quantity: Quantity) -> int:
    """Return the smallest number of repeats with which the 95 % interval of a figure can be within the bound.

    For shares this is the score interval of repeats without any loss (Wilson 1927), whose end is z²/(n + z²).
    """
    if quantity.unit != "share" or quantity.kind is Kind.MEDIAN:
        return 2
    width = expectation.bound if expectation.is_below else 1 - expectation.bound
    if not 0 < width < 1 or (quantity.kind is not Kind.FLAG and not expectation.is_below):
        return 2
    return max(math.floor(NORMAL**2 * (1 / width - 1) * (1 + 1e-12)) + 1, 2)
