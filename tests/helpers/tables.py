"""Tables of trials without the other files of a trial, as input of `aggregate` and similar commands."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fieldkit.analysis.parsing import Numbers, Texts
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.core.columns import SCHEMA_VERSION, Value, cell_text
from fieldkit.trial import rows
from fieldkit.trial.columns import trial_columns


class RepeatRow(dict[str, Any]):
    """A row of trial.csv. Columns are also attributes; an empty column has no key, and its attribute is None."""

    def __init__(self, **values: object) -> None:
        super().__init__({name: value for name, value in values.items() if value is not None})
        assert self.keys() <= COLUMNS

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 (any value of a column)
        if name not in COLUMNS:
            raise AttributeError(name)
        return self.get(name)


COLUMNS = frozenset(column.name for column in trial_columns())


def replace(row: RepeatRow, **changes: object) -> RepeatRow:
    """The row with changed values; None removes a value."""
    return RepeatRow(**{**row, **changes})


ROW = RepeatRow(
    schema_version=SCHEMA_VERSION,
    trial="20261121T020000.000000Z_los_30ft_master",
    procedure="los",
    scenario="los",
    topology="master",
    backend="field",
    distance="30ft",
    distance_m=9.144,
    protocol="udp",
    repeat=1,
    attempt=1,
    status="valid",
    ip_packets_sent=216,
    ip_packets_received=206,
    ip_loss=10 / 216,
    file_loss=0.2,
    rtt_median_s=0.010,
    transfer_s=1.0,
)
COMPARABLE = replace(
    ROW,
    sent_bytes=230_695,
    datagrams_sent=29,
    rtt_payload_bytes=8192,
    paper_window_bytes=8192,
    profiles_sha256="aaaa",
    procedure_sha256="bbbb",
    code_sha256="cccc",
)
"""A row with all columns that `compare` needs."""


def repeats(row: RepeatRow, count: int) -> list[RepeatRow]:
    """`count` valid repeats like `row`, with different measured values."""
    return [
        replace(
            row,
            repeat=1 + index,
            ip_packets_received=206 - index,
            ip_loss=(10 + index) / 216,
            transfer_s=1.0 + 0.01 * index,
        )
        for index in range(count)
    ]


def bursty(row: RepeatRow, count: int, *, seed: int, loss: float = 0.1) -> list[RepeatRow]:
    """Valid repeats like `row` with a mean loss of `loss` that varies between repeats, as with burst losses."""
    random = np.random.default_rng(seed)
    received_packets = random.binomial(216, 1 - random.beta(2, 2 / loss - 2, count)).tolist()
    times_s = random.lognormal(0.0, 0.2, (count, 2)).tolist()
    return [
        replace(
            row,
            repeat=1 + index,
            ip_packets_sent=216,
            ip_packets_received=received_packets[index],
            ip_loss=1 - received_packets[index] / 216,
            rtt_median_s=0.01 * times_s[index][0],
            transfer_s=times_s[index][1],
        )
        for index in range(count)
    ]


def parsed(table: Sequence[Mapping[str, Value]]) -> Repeats:
    """The rows as they would be parsed from a trial.csv."""
    numbers: dict[str, Numbers] = {}
    texts: dict[str, Texts] = {}
    for column in trial_columns():
        cells = [cell_text(row.get(column.name)) for row in table]
        if column.type is str:
            texts[column.name] = np.array(cells, dtype=np.object_)
        elif column.type is bool:
            numbers[column.name] = np.array([float(text == "true") if text else np.nan for text in cells])
        else:
            width = np.longdouble if column.unit == "ns" else np.float64
            numbers[column.name] = np.array([text or "nan" for text in cells], dtype=np.str_).astype(width)
    return Repeats(numbers, {**texts, SOURCE: np.full(len(table), "", np.object_)}, trial_columns())


def write(folder: Path, table: Sequence[RepeatRow], name: str = "trial.csv") -> Path:
    """Write a table of repeats to a new folder; return the path of the table."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(rows.to_csv(table, trial_columns()), encoding="utf-8")
    return path
