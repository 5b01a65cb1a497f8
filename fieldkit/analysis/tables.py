"""Cells as tables for programs: one line or object per cell and quantity."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Final

from fieldkit.analysis.cells import Cell
from fieldkit.core.columns import SCHEMA_VERSION, EstimateRow, csv_text, declared

MORE: Final = "more_wanted"


def estimate_rows(cell: Cell) -> Iterator[EstimateRow]:
    """Yield what stands in a table of one cell: a row per quantity, or one without any where nothing was measured."""
    counts: dict[str, Any] = {"n_valid": cell.n_valid, "n_void": cell.n_void, "n_failed": cell.n_failed}
    if not cell.estimates:
        yield EstimateRow(**counts)
    for name, estimate in cell.estimates.items():
        same = {item.name: getattr(estimate, item.name) for item in fields(estimate) if item.name != "quantity"}
        yield EstimateRow(
            quantity=name, unit=estimate.quantity.unit, estimate=estimate.quantity.kind, **counts, **same
        )


def to_csv(by: Sequence[str], cells: Sequence[Cell], more: Sequence[Mapping[str, int]] = ()) -> str:
    """Return cells as CSV: the columns `by` that tell them apart, then those of `EstimateRow`.

    Args:
        by: Columns that tell cells apart.
        cells: What to tell of.
        more: By cell and quantity, the repeats that are wanted beside those that are there: the last column, if any.
    """
    names = [column.name for column in declared(EstimateRow)]
    wanted = more or ({},) * len(cells)
    lines = (
        [*(cell.key[name] for name in by), *(getattr(row, name) for name in names)]
        + ([counts.get(row.quantity or "")] if more else [])
        for cell, counts in zip(cells, wanted, strict=True)
        for row in estimate_rows(cell)
    )
    return csv_text([*by, *names, *([MORE] if more else [])], lines)


def to_json(by: Sequence[str], cells: Sequence[Cell], more: Sequence[Mapping[str, int]] = ()) -> str:
    """Return cells as one JSON object; names, units and digits as in `to_csv`, what is missing is null."""
    wanted = more or ({},) * len(cells)
    listed = [_object(cell, counts if more else None) for cell, counts in zip(cells, wanted, strict=True)]
    whole = {"schema_version": SCHEMA_VERSION, "by": list(by), "cells": listed}
    return json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _object(cell: Cell, more: Mapping[str, int] | None) -> dict[str, Any]:
    counts = ("n_valid", "n_void", "n_failed")
    estimates = {}
    for row in estimate_rows(cell):
        if row.quantity is not None:
            values = {name: rounded(value) for name, value in asdict(row).items()}
            wanted = {} if more is None else {MORE: more.get(row.quantity)}
            estimates[values.pop("quantity")] = {
                name: value for name, value in (values | wanted).items() if name not in counts
            }
    return {"key": dict(cell.key), **{name: getattr(cell, name) for name in counts}, "estimates": estimates}


def rounded(value: object) -> Any:  # noqa: ANN401 (any JSON value)
    """Return a number to the digits that a CSV has of it."""
    return float(f"{value:.9g}") if isinstance(value, float) else value
