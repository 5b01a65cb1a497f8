"""Tables of cells (the repeats under one condition, and their estimates) for programs, in CSV and JSON."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Final

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.core.columns import SCHEMA_VERSION, Kind, csv_text
from fieldkit.core.result_rows import EstimateRow, declared_columns
from fieldkit.core.text import json_text

MORE: Final = "more_wanted"
"""Column with the number of additional repeats that the requested width of an interval needs."""


def estimate_rows(cell: Cell) -> Iterator[EstimateRow]:
    """Yield the table rows of a cell: one per quantity and per word, or one row if the cell has neither."""
    counts: dict[str, Any] = {"n_valid": cell.n_valid, "n_void": cell.n_void, "n_failed": cell.n_failed}
    if not cell.estimates and not cell.tallies:
        yield EstimateRow(**counts)
    for name, estimate in cell.estimates.items():
        values = {item.name: getattr(estimate, item.name, None) for item in fields(EstimateRow)}
        yield EstimateRow(
            **{
                **values,
                **counts,
                "quantity": name,
                "unit": estimate.quantity.unit,
                "estimate": estimate.quantity.kind,
            }
        )
    for tally in cell.tallies.values():
        for word, events in tally.counts.items():
            yield EstimateRow(
                quantity=tally.quantity(word),
                unit="share",
                **counts,
                n=tally.n,
                value=tally.share(word),
                estimate=Kind.WORDS,
                events=events,
                trials=tally.n,
            )


def to_csv(by: Sequence[str], cells: Sequence[Cell], more: Sequence[Mapping[str, int]] = ()) -> str:
    """Return cells as CSV: the columns `by` that identify a cell, then the columns of `EstimateRow`.

    Args:
        by: Columns that identify cells.
        cells: The cells.
        more: Number of additional repeats by quantity, for each cell. If it is not empty, it is the last column.
    """
    names = [column.name for column in declared_columns(EstimateRow)]
    additional = more or ({},) * len(cells)
    rows = (
        [*(cell.key[name] for name in by), *(getattr(row, name) for name in names)]
        + ([counts.get(row.quantity or "")] if more else [])
        for cell, counts in zip(cells, additional, strict=True)
        for row in estimate_rows(cell)
    )
    return csv_text([*by, *names, *([MORE] if more else [])], rows)


def to_json(by: Sequence[str], cells: Sequence[Cell], more: Sequence[Mapping[str, int]] = ()) -> str:
    """Return cells as one JSON object with the names, units and digits of `to_csv`; missing values are null."""
    additional = more or ({},) * len(cells)
    cell_objects = [
        _cell_object(cell, counts if more else None) for cell, counts in zip(cells, additional, strict=True)
    ]
    cautions = list(wording.cautions(cells))
    document = {"schema_version": SCHEMA_VERSION, "by": list(by), "cautions": cautions, "cells": cell_objects}
    return json_text(document, indent=1, allow_nan=False) + "\n"


def _cell_object(cell: Cell, more: Mapping[str, int] | None) -> dict[str, Any]:
    """Return a cell in the form of `to_json`; `more` has the number of additional repeats by quantity."""
    counts = ("n_valid", "n_void", "n_failed")
    estimates = {}
    for row in estimate_rows(cell):
        if row.quantity is not None:
            values = {name: rounded(value) for name, value in asdict(row).items()}
            additional = {} if more is None else {MORE: more.get(row.quantity)}
            estimates[values.pop("quantity")] = {
                name: value for name, value in (values | additional).items() if name not in counts
            }
    return {"key": dict(cell.key), **{name: getattr(cell, name) for name in counts}, "estimates": estimates}


def rounded(value: object) -> Any:  # noqa: ANN401 (any JSON value)
    """Return a number rounded to the digits of a CSV."""
    return float(f"{value:.9g}") if isinstance(value, float) else value
