"""A comparison as tables: one line per condition and quantity."""

import json
from collections.abc import Iterator
from dataclasses import asdict

from fieldkit.analysis import verdicts
from fieldkit.analysis.compare import Comparison, Difference, Pair
from fieldkit.analysis.tables import rounded
from fieldkit.core.columns import SCHEMA_VERSION, DifferenceRow, csv_text, declared

Line = tuple[Pair, DifferenceRow]


def lines(comparison: Comparison) -> Iterator[Line]:
    """Yield every condition with a row per quantity, or with one without any where neither run measured."""
    for pair in comparison.pairs:
        missing_in = pair.missing_in or None
        if not pair.differences:
            yield pair, DifferenceRow(missing_in=missing_in)
        for one in pair.differences:
            yield pair, _row(one, missing_in, comparison.made)


def to_csv(comparison: Comparison) -> str:
    """Return a comparison as CSV: the columns that tell conditions apart, then those of `DifferenceRow`."""
    names = [column.name for column in declared(DifferenceRow)]
    rows = ([*pair.key.values(), *(getattr(row, name) for name in names)] for pair, row in lines(comparison))
    return csv_text([*comparison.by, *names], rows)


def to_json(comparison: Comparison) -> str:
    """Return a comparison as one JSON object: conclusions in words, concerns, and differences as in the CSV."""
    text = json.dumps(
        {
            "schema_version": SCHEMA_VERSION,
            "by": list(comparison.by),
            "conclusions": list(verdicts.conclusions(comparison)),
            "concerns": [asdict(one) for one in comparison.concerns],
            "missed": comparison.missed,
            "differences": [
                {**pair.key, **{name: rounded(value) for name, value in asdict(row).items()}}
                for pair, row in lines(comparison)
            ],
        },
        indent=1,
        ensure_ascii=False,
        allow_nan=False,
    )
    return f"{text}\n"


def _row(one: Difference, missing_in: str | None, made: int) -> DifferenceRow:
    return DifferenceRow(
        missing_in=missing_in,
        quantity=one.quantity.name,
        unit=one.quantity.unit,
        estimate=one.quantity.kind,
        n_a=one.a.n if one.a else None,
        n_b=one.b.n if one.b else None,
        a=one.a.value if one.a else None,
        b=one.b.value if one.b else None,
        difference=one.value,
        low=one.interval.low if one.interval else None,
        high=one.interval.high if one.interval else None,
        cliffs_delta=one.cliffs_delta,
        p_holm=one.p_holm,
        threshold=one.threshold,
        within=one.within,
        verdict=verdicts.of(one, made),
    )
