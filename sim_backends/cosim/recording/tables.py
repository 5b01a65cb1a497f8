"""Tables of a recording: each a folder of Parquet parts, of which each is whole.

The only module of `sim_backends` that imports pyarrow.
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet

from fieldkit.core import files
from fieldkit.core.errors import EvidenceError
from sim_backends.cosim.recording.manifest import RUN_AGAIN

Row = tuple[Any, ...]
"""Values of a table's columns, in order; a vector is a tuple of three."""

_TEXT: Final = pa.dictionary(pa.int32(), pa.string())
_VECTOR: Final = pa.list_(pa.float64(), 3)


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


def _ends(what: str, said: str) -> list[pa.Field]:
    kinds = (
        ("m", _VECTOR, "m", "position, east, north, up"),
        ("m_s", _VECTOR, "m/s", "velocity, east, north, up"),
        ("heading_rad", pa.float64(), "rad", "heading from east towards north, empty where that is not known"),
    )
    return [
        _field(f"{what}_{end}_{quantity}", kind, unit, f"{said} {end}'s {name}")
        for end in ("source", "destination")
        for quantity, kind, unit, name in kinds
    ]


_SCHEMAS: Final[Mapping[str, pa.Schema]] = {
    "packets": pa.schema(
        [
            _field("packet_id", pa.int64(), "", "counts the packets of the run"),
            _field("flow", _TEXT, "", "stream of packets that it belongs to"),
            _field("number", pa.int64(), "", "which it is of its flow"),
            _field("source", _TEXT, "", "who sent it"),
            _field("destination", _TEXT, "", "who was to get it"),
            _field("protocol", _TEXT, "", "transport that carried it"),
            _field("size_bytes", pa.int64(), "B", "its size"),
            _field("sent_ns", pa.int64(), "ns", "when its program sent it"),
            _field("enters_ns", pa.int64(), "ns", "when the network got it"),
            _field("entered_window", pa.int64(), "", "number of the window in which the network got it"),
            _field("arrived_ns", pa.int64(), "ns", "when it arrived by the network's clock; empty if it did not"),
            _field("counted_ns", pa.int64(), "ns", "when it arrived by the policy; empty if it did not"),
            _field("late_ns", pa.int64(), "ns", "by how much its receiver had passed that time"),
            _field("reason", _TEXT, "", "why it never arrived; empty if it did, or was under way at the end"),
            _field("ended_window", pa.int64(), "", "number of the window in which its fate became known"),
            *_ends("known", "what the network took, when it got the packet, for the"),
            *_ends("true", "when the packet was sent, the"),
        ]
    ),
    "states": pa.schema(
        [
            _field("at_ns", pa.int64(), "ns", "when"),
            _field("agent", _TEXT, "", "whose state"),
            _field("position_m", _VECTOR, "m", "where it was, east, north, up"),
            _field("velocity_m_s", _VECTOR, "m/s", "how it moved, east, north, up"),
            _field("heading_rad", pa.float64(), "rad", "its heading from east towards north; empty where not known"),
        ]
    ),
    "windows": pa.schema(
        [
            _field("window", pa.int64(), "", "its number, from 0"),
            _field("begin_ns", pa.int64(), "ns", "when it began"),
            _field("end_ns", pa.int64(), "ns", "when it ended"),
            _field("decided_by", _TEXT, "", "what decided its length; empty where the policy does not say"),
            _field("agents_s", pa.float64(), "s", "wall time of physics and programs"),
            _field("network_s", pa.float64(), "s", "wall time of the network"),
            _field("exchange_s", pa.float64(), "s", "wall time of the policy and of what carries data between them"),
            _field("wait_s", pa.float64(), "s", "wall time in which a federate itself only waited"),
        ]
    ),
}

TABLES: Final = tuple(_SCHEMAS)
"""Their names, in the order in which parts are written: the part of the last says that the others are whole."""


def part_path(table: str, number: int) -> str:
    """Return where a part of a table is in the folder of a recording."""
    return f"{table}/{number:06d}.parquet"


def write_part(folder: Path, table: str, number: int, rows: Sequence[Row]) -> str:
    """Write a part of a table; while it is written, nobody sees it.

    Returns:
        BLAKE2b of the file, in hexadecimal.

    Raises:
        OSError: It cannot be written; there is no part of it then.
    """
    schema = _SCHEMAS[table]
    columns = zip(*rows, strict=True) if rows else [()] * len(schema)
    arrays = [_array(values, one.type) for values, one in zip(columns, schema, strict=True)]
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(pa.Table.from_arrays(arrays, schema=schema), sink, compression="zstd")
    content = sink.getvalue()
    files.write(folder / part_path(table, number), content)
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def checksum(path: Path) -> str:
    """Return what `write_part` returned for a file that nobody changed since.

    Raises:
        OSError: It cannot be read.
    """
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def read_parts(folder: Path, table: str, count: int) -> dict[str, list[Any]]:
    """Return the columns of a table's first parts, vectors as tuples of three.

    Raises:
        EvidenceError: A part is missing or damaged.
    """
    columns: dict[str, list[Any]] = {name: [] for name in _SCHEMAS[table].names}
    for number in range(count):
        path = folder / part_path(table, number)
        try:
            part = pa.parquet.read_table(path, partitioning=None)
            if not part.schema.equals(_SCHEMAS[table]):
                raise EvidenceError(f"its columns are not those of {table}", where=str(path), remedy=RUN_AGAIN)
            for name in columns:
                columns[name] += _values(part.column(name).combine_chunks())
        except FileNotFoundError as error:
            raise EvidenceError(f"a part of {table} is missing", where=str(path), remedy=RUN_AGAIN) from error
        except (OSError, pa.ArrowException) as error:
            raise EvidenceError(
                f"a part of {table} is damaged: {error}", where=str(path), remedy=RUN_AGAIN
            ) from error
    return columns


def _array(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    if kind == _TEXT:
        return pa.array(values, pa.string()).dictionary_encode()
    if kind == _VECTOR:
        flat = pa.array([one for vector in values for one in vector], pa.float64())
        return pa.FixedSizeListArray.from_arrays(flat, 3)
    return pa.array(values, kind)


def _values(array: pa.Array) -> list[Any]:
    if array.type == _VECTOR:
        flat = iter(array.flatten().to_pylist())
        return list(zip(flat, flat, flat, strict=True))
    values: list[Any] = array.to_pylist()
    return values
