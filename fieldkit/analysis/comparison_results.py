"""Results of comparisons: verdicts and conclusions as text, tables as CSV and JSON."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Final

from fieldkit.analysis import wording
from fieldkit.analysis.compare import Comparison, Difference, Pair
from fieldkit.analysis.quantities import DIFFERENCE_UNITS, Tally
from fieldkit.analysis.result_tables import rounded
from fieldkit.analysis.statistics import CONFIDENCE
from fieldkit.core.columns import SCHEMA_VERSION, Kind, csv_text
from fieldkit.core.result_rows import DifferenceRow, declared_columns
from fieldkit.core.text import json_text
from fieldkit.core.units import format_count

NOT_JUDGED: Final = "words are counted, not judged"
"""Verdict on a text column: the repeats with each value (word) are counted, and their comparison has no interval."""


def difference_rows(comparison: Comparison) -> Iterator[tuple[Pair, DifferenceRow]]:
    """Yield conditions and their rows. A condition has a row per quantity and per word, or one row without both."""
    for pair in comparison.pairs:
        missing_in = pair.missing_in or None
        rows = [_difference_row(difference, missing_in, comparison.n_compared) for difference in pair.differences]
        rows += [row for a, b in pair.words for row in _word_rows(a, b, missing_in)]
        yield from ((pair, row) for row in rows or [DifferenceRow(missing_in=missing_in)])


def to_csv(comparison: Comparison) -> str:
    """Return a comparison as CSV: the columns that identify conditions, then the columns of `DifferenceRow`."""
    names = [column.name for column in declared_columns(DifferenceRow)]
    rows = (
        [*pair.key.values(), *(getattr(row, name) for name in names)] for pair, row in difference_rows(comparison)
    )
    return csv_text([*comparison.by, *names], rows)


def to_json(comparison: Comparison) -> str:
    """Return a comparison as one JSON object: conclusions, concerns, and differences as in the CSV."""
    text = json_text(
        {
            "schema_version": SCHEMA_VERSION,
            "by": list(comparison.by),
            "conclusions": list(conclusions(comparison)),
            "concerns": [asdict(concern) for concern in comparison.concerns],
            "missed": comparison.exceeds_threshold,
            "differences": [
                {**pair.key, **{name: rounded(value) for name, value in asdict(row).items()}}
                for pair, row in difference_rows(comparison)
            ],
        },
        indent=1,
        allow_nan=False,
    )
    return f"{text}\n"


def _difference_row(difference: Difference, missing_in: str | None, comparisons: int) -> DifferenceRow:
    return DifferenceRow(
        missing_in=missing_in,
        quantity=difference.quantity.name,
        unit=difference.quantity.unit,
        estimate=difference.quantity.kind,
        n_a=difference.a.n if difference.a else None,
        n_b=difference.b.n if difference.b else None,
        a=difference.a.value if difference.a else None,
        b=difference.b.value if difference.b else None,
        difference=difference.value,
        low=difference.interval.low if difference.interval else None,
        high=difference.interval.high if difference.interval else None,
        cliffs_delta=difference.cliffs_delta,
        p_holm=difference.p_holm,
        threshold=difference.threshold,
        within=difference.within,
        verdict=verdict(difference, comparisons),
    )


def _word_rows(a: Tally, b: Tally, missing_in: str | None) -> Iterator[DifferenceRow]:
    """Yield a row for each word in a column of either run."""
    for word in dict.fromkeys((*a.counts, *b.counts)):
        share_a, share_b = a.share(word), b.share(word)
        yield DifferenceRow(
            missing_in=missing_in,
            quantity=a.quantity(word),
            unit="share",
            estimate=Kind.WORDS,
            n_a=a.n or None,
            n_b=b.n or None,
            a=share_a,
            b=share_b,
            difference=None if share_a is None or share_b is None else share_b - share_a,
            verdict=NOT_JUDGED,
        )


def verdict(difference: Difference, comparisons: int) -> str:
    """Return the verdict on a difference, such as `B 3.10 points more [1.20, 5.00]`.

    Args:
        difference: The difference.
        comparisons: Number of all comparisons.
    """
    if difference.value is None:
        text = f"only {'B' if difference.a is None else 'A'} has it"
    elif difference.interval is None:
        text = "no interval, so no verdict"
    elif difference.excludes_zero:
        low, high = sorted((abs(difference.interval.low), abs(difference.interval.high)))
        more = "more" if difference.value > 0 else "less"
        interval_text = comparison_scale(difference).interval(low, high)
        text = f"B {_amount(abs(difference.value), difference)} {more} {interval_text}"
        if not is_significant(difference):
            text += f"; may be chance among {comparisons} comparisons"
    else:
        largest = max(abs(difference.interval.low), abs(difference.interval.high))
        text = f"no difference seen; up to {_amount(largest, difference)} possible"
    return text + _threshold_text(difference)


def is_significant(difference: Difference) -> bool:
    """Return True if a difference is significant after correction for the number of comparisons."""
    return difference.p_holm is not None and difference.p_holm < 1 - CONFIDENCE


def conclusions(comparison: Comparison) -> Iterator[str]:
    """Yield the conclusions of a comparison, and the conditions that could not be compared."""
    comparisons, differences = comparison.n_compared, comparison.differences
    excludes_zero = sum(difference.excludes_zero for difference in differences)
    significant = sum(is_significant(difference) for difference in differences)
    yield (
        f"{format_count(comparisons, 'comparison')}: {format_count(excludes_zero, 'difference')} seen, {significant} "
        f"after correction for their number; without real differences about {(1 - CONFIDENCE) * comparisons:.1f} "
        "would be seen by chance"
    )
    for pair in comparison.pairs:
        if pair.missing_in:
            yield f"not compared, because {pair.missing_in} has no such condition: {pair.name}"
    limited = [
        (pair.name, difference)
        for pair in comparison.pairs
        for difference in pair.differences
        if difference.within is not None
    ]
    not_within = [(name, difference) for name, difference in limited if not difference.within]
    if limited:
        yield f"shown to be within its threshold: {len(limited) - len(not_within)} of {len(limited)}"
    for name, difference in not_within:
        yield f"not shown to be within {_threshold_amount(difference)}: {difference.quantity.name} in {name}"
    sides = (("A", [pair.a for pair in comparison.pairs]), ("B", [pair.b for pair in comparison.pairs]))
    for side, cells in sides:
        # A caution starts with the mark (`* ` or `! `) of the intervals that it explains. Comparisons print no marks.
        yield from (
            f"{side}: {caution[2:]}" for caution in wording.cautions([cell for cell in cells if cell is not None])
        )


def _threshold_text(difference: Difference) -> str:
    if difference.within is None:
        return ""
    return f"; {'within' if difference.within else 'may exceed'} {_threshold_amount(difference)}"


def comparison_scale(difference: Difference) -> wording.Scale:
    """Return the scale for the values of A and B."""
    return wording.scale_of(difference.quantity, [side.value for side in (difference.a, difference.b) if side])


def _threshold_amount(difference: Difference) -> str:
    limit = comparison_scale(difference).factor * (difference.threshold or 0)
    return f"{limit:.6g} {_unit(difference)}".rstrip()


def _amount(amount: float, difference: Difference) -> str:
    return f"{comparison_scale(difference).number(amount)} {_unit(difference)}".rstrip()


def _unit(difference: Difference) -> str:
    """Return the unit of a difference, such as percentage points for shares."""
    return DIFFERENCE_UNITS.get(difference.quantity.unit, comparison_scale(difference).unit)
