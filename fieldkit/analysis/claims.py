"""What the expectations of a trial need before they can hold: repeats, or packets. Known before anything runs."""

import math
from collections.abc import Iterable, Iterator

from fieldkit.analysis import bounds
from fieldkit.analysis.expectations import Expectation, Scope
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.statistics import CONFIDENCE, FEWEST_FOR_ORDER, NORMAL
from fieldkit.core.columns import Kind

_USUAL_SHARE = 0.9
"""Share of further repeats for which a claim on every repeat is compared with one on a share of them."""


def shortfalls(expectations: Iterable[Expectation], figures: Iterable[Quantity], repeats: int) -> Iterator[str]:
    """Yield what each expectation needs and a trial does not have, in a sentence.

    Args:
        expectations: Of the trial.
        figures: What its repeats measure, which every expectation is of.
        repeats: How many it has per protocol.
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
        wanted = f"needs at least {needed} repeats for 95 % confidence, if all meet it; {has}"
        return wanted if repeats < needed else ""
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
        otherwise = f"; for these packets alone: {expectation.text} of all packets"
        gate = quantity.kind is Kind.COUNTED and expectation.is_below
        return f"needs at least {needed} repeats for 95 % confidence, {_if(quantity)}; {has}" + (
            otherwise if gate else ""
        )
    if quantity.kind is Kind.MEDIAN and repeats < FEWEST_FOR_ORDER:
        held = f"{100 * CONFIDENCE:.0f} % confidence whatever the distribution of the repeats is"
        return f"needs at least {FEWEST_FOR_ORDER} repeats for {held}; {has}"
    return ""


def _if(quantity: Quantity) -> str:
    """Return under which best results so few repeats are enough."""
    if quantity.kind is Kind.FLAG:
        return "if it is so in all of them"
    return "even if nothing is lost" if quantity.unit == "share" else "which give an interval"


def _for_interval(expectation: Expectation, quantity: Quantity) -> int:
    """Return the least number of repeats of which the 95 % interval of a figure can be within the bound.

    Of shares it is the score interval of repeats that all lost nothing (Wilson 1927), which ends at z²/(n + z²).
    """
    if quantity.unit != "share" or quantity.kind is Kind.MEDIAN:
        return 2
    room = expectation.bound if expectation.is_below else 1 - expectation.bound
    if not 0 < room < 1 or (quantity.kind is not Kind.FLAG and not expectation.is_below):
        return 2
    return max(math.floor(NORMAL**2 * (1 / room - 1) * (1 + 1e-12)) + 1, 2)
