"""The part of `trial.yaml` about tables: columns that are not in every one, and what is expected of figures."""

import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Field, Int, Number, Strict
from fieldkit.core import files
from fieldkit.core.columns import Column, Figure, Kind

MOST_COLUMNS: Final = 2000
"""Of one trial, beside those of every trial."""
_MOST: Final = sys.float_info.max  # YAML here has no infinity, and a column no such value


class FrozenFigure(Strict):
    """As `fieldkit.core.columns.Figure`."""

    label: str
    kind: Kind
    arrived: str | None = None
    sent: str | None = None
    rank: Int
    at_least: str | None = Field(default=None, exclude_if=schema.is_empty)
    of_sent: str | None = Field(default=None, exclude_if=schema.is_empty)


class FrozenColumn(Strict):
    """As `fieldkit.core.columns.Column`, whose rank is its place in the list."""

    name: str
    unit: str
    meaning: str
    bounds: tuple[Number, Number] | None = None
    figure: FrozenFigure | None = None

    @schema.model_validator(mode="after")
    def _is_one(self) -> "FrozenColumn":
        if flaw := self.column.flaw():
            raise schema.complaint(flaw, "name")
        return self

    @property
    def column(self) -> Column:
        """The column."""
        figure = None if self.figure is None else Figure(**dict(self.figure))
        return Column(self.name, self.unit, self.meaning, bounds=self.bounds, figure=figure)


def _demand_different(columns: tuple[FrozenColumn, ...]) -> tuple[FrozenColumn, ...]:
    for name, times in Counter(column.name for column in columns).items():
        if times > 1:
            raise schema.complaint(f"the column {name} is there twice")
    return columns


Columns = Annotated[tuple[FrozenColumn, ...], Field(max_length=MOST_COLUMNS), AfterValidator(_demand_different)]


class _Beyond(Strict):
    """Of a plan what says what its columns are."""

    columns: Columns | None = None


def read(path: Path) -> tuple[Column, ...]:
    """Return the columns that a `trial.yaml` has, without asking for the kinds of step that its procedure names.

    Raises:
        ConfigurationError: It cannot be read, or a column is none.
    """
    document = schema.read(path)
    if not isinstance(document.data, dict) or "columns" not in document.data:
        return ()
    found = schema.validate(replace(document, data={"columns": document.data["columns"]}), _Beyond)
    return tuple(frozen.column for frozen in found.columns or ())


class _Expecting(Strict):
    """Of a procedure what it expects."""

    expect: tuple[str, ...] = ()


def expected(path: Path) -> tuple[str, ...]:
    """Return what the procedure in a `trial.yaml` expects of figures, likewise; most expect nothing.

    Raises:
        ConfigurationError: It cannot be read, or does not say so.
    """
    if b"expect:" not in files.read(path):  # which of a thousand plans are then read takes no time
        return ()
    procedure = schema.read(path).part("procedure")
    said = {"expect": procedure.data["expect"]} if "expect" in procedure.data else {}
    return schema.validate(replace(procedure, data=said), _Expecting).expect


def freeze(columns: Iterable[Column]) -> tuple[FrozenColumn, ...]:
    """Return columns as a plan holds them."""
    return tuple(
        FrozenColumn(
            name=column.name,
            unit=column.unit,
            meaning=column.meaning,
            bounds=column.bounds and (max(column.bounds[0], -_MOST), min(column.bounds[1], _MOST)),
            figure=None if column.figure is None else FrozenFigure(**vars(column.figure)),
        )
        for column in columns
    )
