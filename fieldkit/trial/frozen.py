"""The columns that `trial.yaml` lists: the columns of the trial's table that are not in the table of every trial.

They are frozen: a later version of fieldkit or of a step's package reads the table with the same columns.
"""

import json
import sys
from collections import Counter
from collections.abc import Iterable
from functools import lru_cache
from typing import Annotated, Final

from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Field, Int, Number, Strict
from fieldkit.core.columns import Column, Figure, Kind

MAX_COLUMNS: Final = 3000
"""Maximum number of columns that a trial's table has in addition to the columns of every trial."""
_MAX_FLOAT: Final = sys.float_info.max  # replaces an infinite bound, because the YAML reader rejects infinity


class FrozenFigure(Strict):
    """A `fieldkit.core.columns.Figure` in the form that `trial.yaml` contains."""

    label: str
    kind: Kind
    arrived: str | None = None
    sent: str | None = None
    rank: Int
    at_least: str | None = Field(default=None, exclude_if=schema.is_empty)
    of_sent: str | None = Field(default=None, exclude_if=schema.is_empty)


class FrozenColumn(Strict):
    """A `fieldkit.core.columns.Column` as `trial.yaml` contains it. Its position in the list is its rank."""

    name: str
    unit: str
    meaning: str
    bounds: tuple[Number, Number] | None = None
    figure: FrozenFigure | None = None

    @schema.model_validator(mode="after")
    def _is_valid_column(self) -> "FrozenColumn":
        if declaration_error := self.column.declaration_error():
            raise schema.validation_error(declaration_error, "name")
        return self

    @property
    def column(self) -> Column:
        """The column."""
        figure = None if self.figure is None else Figure(**dict(self.figure))
        return Column(self.name, self.unit, self.meaning, bounds=self.bounds, figure=figure)


def _require_unique_names(columns: tuple[FrozenColumn, ...]) -> tuple[FrozenColumn, ...]:
    for name, count in Counter(column.name for column in columns).items():
        if count > 1:
            raise schema.validation_error(f"the column {name} occurs twice")
    return columns


Columns = Annotated[tuple[FrozenColumn, ...], Field(max_length=MAX_COLUMNS), AfterValidator(_require_unique_names)]


def freeze(columns: Iterable[Column]) -> tuple[FrozenColumn, ...]:
    """Return columns in the form that is stored in a plan."""
    return tuple(
        FrozenColumn(
            name=column.name,
            unit=column.unit,
            meaning=column.meaning,
            bounds=column.bounds and (max(column.bounds[0], -_MAX_FLOAT), min(column.bounds[1], _MAX_FLOAT)),
            figure=None if column.figure is None else FrozenFigure(**vars(column.figure)),
        )
        for column in columns
    )


def to_json(columns: Iterable[Column]) -> str:
    """Return columns as JSON."""
    return json.dumps([column.model_dump(mode="json") for column in freeze(columns)])


@lru_cache  # the trials of a procedure have the same columns
def from_json(text: str) -> tuple[Column, ...]:
    """Return the columns that `to_json` wrote."""
    return tuple(FrozenColumn.model_validate_json(json.dumps(item)).column for item in json.loads(text))
