"""Datasets of Parquet files: the results of a sweep, with the columns of trial.csv and columns of its settings.

A sweep runs a simulation with several values of each factor. A flow is a stream of packets and its receiver.

The metadata of each file has the names of the columns whose values are names of folders (`partitions`), the columns
that identify a condition (`by`), and declarations of columns that trials do not have.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet

from fieldkit.analysis.parsing import Numbers, Texts, arrow_columns, arrow_type
from fieldkit.core.columns import Column, Figure, Kind
from fieldkit.core.errors import EvidenceError

_REMEDY = "run the command of the sweep again, which writes its dataset"


def _schema(folder: Path) -> pa.Schema:
    """Return the schema of a dataset.

    Raises:
        EvidenceError: The dataset has no file, or its first file is damaged.
    """
    first = next(iter(sorted(folder.rglob("*.parquet"))), None)
    if first is None:
        raise EvidenceError("no run has ended yet", where=str(folder), remedy=_REMEDY)
    try:
        return pa.parquet.read_schema(first)
    except (OSError, pa.ArrowException) as error:
        raise EvidenceError(f"cannot be read: {error}", where=str(first), remedy=_REMEDY) from error


def _metadata(folder: Path, key: str) -> object:
    return json.loads((_schema(folder).metadata or {}).get(key.encode(), b"[]"))


def condition(folder: Path) -> dict[str, str]:
    """Return the columns that identify a condition: the flow, and the factors of the sweep.

    Raises the same errors as `read`.

    Returns:
        For each column, in order, the name of the column that contains its values as the user typed them.
    """
    by, partitions = ([*map(str, _metadata(folder, key))] for key in ("by", "partitions"))  # type: ignore[call-overload]
    return dict(zip(by, (*by[:1], *partitions), strict=True))  # the column of the flow contains the typed names


def declared_columns(folder: Path) -> tuple[Column, ...]:
    """Return the columns that the dataset declares. Raises the same errors as `read`."""
    partitions = dict(_metadata(folder, "partitions") or {})  # type: ignore[call-overload]
    return (
        *(Column(name, "text", meaning) for name, meaning in partitions.items()),
        *(_column(field) for field in _schema(folder) if field.metadata),
    )


def names(folder: Path) -> tuple[str, ...]:
    """Return the names of all columns. Raises the same errors as `read`."""
    return tuple(dict.fromkeys((*(column.name for column in declared_columns(folder)), *_schema(folder).names)))


def read(folder: Path, declared: Mapping[str, Column]) -> tuple[dict[str, Numbers], dict[str, Texts], int]:
    """Return columns and the number of rows in the form of `parsing.columns`.

    Raises:
        EvidenceError: The dataset is empty or damaged.
    """
    partitions = pa.schema([(name, pa.string()) for name in dict(_metadata(folder, "partitions") or {})])  # type: ignore[call-overload]
    partitioning = pa.dataset.partitioning(partitions, flavor="hive")
    base = folder.absolute()  # pyarrow opens the files in threads, which may have another working folder
    try:
        dataset = pa.dataset.dataset(
            sorted(map(str, base.rglob("*.parquet"))),
            schema=pa.schema([*_schema(folder), *partitions]),
            format="parquet",
            partitioning=partitioning,
            partition_base_dir=str(base),
        )
        table = dataset.to_table([name for name in dataset.schema.names if name in declared])
        columns = {
            name: table.column(name).cast(arrow_type(declared[name]))
            for name in table.column_names
            if name in declared
        }
    except (OSError, pa.ArrowException) as error:
        raise EvidenceError(f"cannot be read: {error}", where=str(folder), remedy=_REMEDY) from error
    return *arrow_columns(columns, declared, len(table)), len(table)


def _column(field: pa.Field) -> Column:
    metadata = {key.decode(): value.decode() for key, value in field.metadata.items()}
    figure = Figure(metadata["label"], Kind(metadata["kind"])) if "label" in metadata else None
    return Column(field.name, metadata["unit"], metadata["meaning"], figure=figure)
