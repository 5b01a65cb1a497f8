"""What a comparison says, in words."""

from collections.abc import Iterator

from fieldkit.analysis import wording
from fieldkit.analysis.compare import Comparison, Difference
from fieldkit.analysis.student import CONFIDENCE
from fieldkit.analysis.wording import Scale
from fieldkit.core.units import format_count


def of(one: Difference, comparisons: int) -> str:
    """Return what a difference comes to: `B 3.10 points more [1.20, 5.00]`.

    Args:
        one: The difference.
        comparisons: How many were made with it.
    """
    if one.value is None:
        said = f"only {'B' if one.a is None else 'A'} has it"
    elif one.interval is None:
        said = "no interval, so no verdict"
    elif one.seen:
        low, high = sorted((abs(one.interval.low), abs(one.interval.high)))
        more = "more" if one.value > 0 else "less"
        said = f"B {_amount(abs(one.value), one)} {more} {scale(one).interval(low, high)}"
        if not holds(one):
            said += f"; may be chance among {comparisons}"
    else:
        most = max(abs(one.interval.low), abs(one.interval.high))
        said = f"no difference seen; up to {_amount(most, one)} possible"
    return said + _threshold(one)


def holds(one: Difference) -> bool:
    """Return whether a difference is still one after correction for the number of all."""
    return one.p_holm is not None and one.p_holm < 1 - CONFIDENCE


def conclusions(comparison: Comparison) -> Iterator[str]:
    """Yield what the whole comes to, and what of it could not be compared."""
    made, every = comparison.made, comparison.differences
    seen, held = sum(one.seen for one in every), sum(holds(one) for one in every)
    yield (
        f"{format_count(made, 'comparison')}: {format_count(seen, 'difference')} seen, {held} after correction "
        f"for their number; were there none, about {(1 - CONFIDENCE) * made:.1f} would be seen"
    )
    for pair in comparison.pairs:
        if pair.missing_in:
            yield f"not compared, because {pair.missing_in} has no such condition: {pair.name}"
    limited = [(pair.name, one) for pair in comparison.pairs for one in pair.differences if one.within is not None]
    missed = [(name, one) for name, one in limited if not one.within]
    if limited:
        yield f"shown to be within its threshold: {len(limited) - len(missed)} of {len(limited)}"
    for name, one in missed:
        yield f"not shown to be within {_limit(one)}: {one.quantity.name} in {name}"


def _threshold(one: Difference) -> str:
    if one.within is None:
        return ""
    return f"; {'within' if one.within else 'may exceed'} {_limit(one)}"


def scale(one: Difference) -> Scale:
    """Return in what to write the values of A and B."""
    return wording.scale_of(one.quantity, [side.value for side in (one.a, one.b) if side])


def _limit(one: Difference) -> str:
    return f"{scale(one).factor * (one.threshold or 0):.6g} {_unit(one)}"


def _amount(amount: float, one: Difference) -> str:
    return f"{scale(one).number(amount)} {_unit(one)}"


def _unit(one: Difference) -> str:
    """Return the unit of how far two values are apart: shares, percentage points."""
    return "points" if one.quantity.unit == "share" else scale(one).unit
