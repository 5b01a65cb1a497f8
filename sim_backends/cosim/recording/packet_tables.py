"""Writes and reads the tables of a recording. Each table is a folder of Parquet files, which are its parts.

Each part is readable without the others. `RecordingState` is the state of a recording between two parts.
"""

import hashlib
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.parquet

from fieldkit.core import files
from fieldkit.core.errors import EvidenceError
from sim_backends.cosim.recording.manifest import RUN_AGAIN
from sim_backends.cosim.run_record import EventDigest, Fate, Window
from sim_backends.world.motion import State

Row = tuple[Any, ...]
"""The values of a table's columns, in order; a vector is a tuple of three."""

_TEXT: Final = pa.dictionary(pa.int32(), pa.string())
_VECTOR: Final = pa.list_(pa.float64(), 3)


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


def _end_fields(prefix: str, meaning: str) -> list[pa.Field]:
    """Return the fields of the states of source and destination, for example `known_source_m`."""
    kinds = (
        ("m", _VECTOR, "m", "position (east, north, up)", ""),
        ("m_s", _VECTOR, "m/s", "velocity (east, north, up)", ""),
        ("heading_rad", pa.float64(), "rad", "heading (from east towards north)", "; empty if there is none"),
    )
    return [
        _field(f"{prefix}_{end}_{quantity}", kind, unit, f"{name} of the {agent} {meaning}{note}")
        for end, agent in (("source", "sending agent"), ("destination", "receiving agent"))
        for quantity, kind, unit, name, note in kinds
    ]


SCHEMAS: Final[Mapping[str, pa.Schema]] = {
    "packets": pa.schema(
        [
            _field("packet_id", pa.int64(), "", "number of the packet in the run"),
            _field("flow", _TEXT, "", "name of the packet's flow"),
            _field("number", pa.int64(), "", "number of the packet in its flow"),
            _field("source", _TEXT, "", "sending agent"),
            _field("destination", _TEXT, "", "receiving agent"),
            _field("protocol", _TEXT, "", "transport of the packet"),
            _field("size_bytes", pa.int64(), "B", "size of the packet"),
            _field("sent_ns", pa.int64(), "ns", "time when the program sent the packet"),
            _field("enters_ns", pa.int64(), "ns", "time when the packet entered the network"),
            _field("entered_window", pa.int64(), "", "number of the window in which the packet entered the network"),
            _field(
                "arrived_ns",
                pa.int64(),
                "ns",
                "time at which the network delivered the packet; empty if it was lost, or was under way at the end",
            ),
            _field(
                "counted_ns",
                pa.int64(),
                "ns",
                "time from which the sync policy counts the packet as arrived: `arrived_ns`, or the end of the "
                "window if the policy defers arrivals; empty if `arrived_ns` is empty",
            ),
            _field(
                "late_ns",
                pa.int64(),
                "ns",
                "time from counted_ns to the receiver's simulated time at delivery, if that is later; else 0",
            ),
            _field(
                "reason",
                _TEXT,
                "",
                "reason why the packet never arrived; empty if it did, or was under way at the end",
            ),
            _field(
                "ended_window",
                pa.int64(),
                "",
                "number of the window in which the packet arrived or was dropped; empty if under way at the end",
            ),
            *_end_fields("known", "that the network assumed when the packet entered it"),
            *_end_fields("true", "when the packet was sent (true value)"),
        ]
    ),
    "states": pa.schema(
        [
            _field("at_ns", pa.int64(), "ns", "time"),
            _field("agent", _TEXT, "", "name of the agent"),
            _field("position_m", _VECTOR, "m", "position of the agent, east, north, up"),
            _field("velocity_m_s", _VECTOR, "m/s", "velocity of the agent, east, north, up"),
            _field(
                "heading_rad",
                pa.float64(),
                "rad",
                "heading of the agent from east towards north; empty if there is none",
            ),
        ]
    ),
    "windows": pa.schema(
        [
            _field("window", pa.int64(), "", "number of the window, from 0"),
            _field("begin_ns", pa.int64(), "ns", "start of the window"),
            _field("end_ns", pa.int64(), "ns", "end of the window"),
            _field(
                "decided_by", _TEXT, "", "reason for the length of the window; empty if the policy does not report it"
            ),
            _field("agents_s", pa.float64(), "s", "wall time of physics and programs"),
            _field("network_s", pa.float64(), "s", "wall time of the network"),
            _field("exchange_s", pa.float64(), "s", "wall time of the policy and the coordinator"),
            _field("wait_s", pa.float64(), "s", "wall time in which federates only waited"),
        ]
    ),
}
"""Fields of each table of a recording."""

TABLES: Final = tuple(SCHEMAS)
"""The names of the tables, in the order in which parts are written: if the last part exists, all are complete."""


def part_path(table: str, number: int) -> str:
    """Return the path of a part of a table, relative to the folder of the recording."""
    return f"{table}/{number:06d}.parquet"


def write_part(folder: Path, table: str, number: int, rows: Sequence[Row]) -> str:
    """Write a part of a table; it becomes visible when it is complete.

    Returns:
        BLAKE2b of the file (128 bits), in hexadecimal.

    Raises:
        OSError: The part cannot be written; no incomplete file remains.
    """
    schema = SCHEMAS[table]
    columns = zip(*rows, strict=True) if rows else [()] * len(schema)
    arrays = [_array(values, field.type) for values, field in zip(columns, schema, strict=True)]
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(pa.Table.from_arrays(arrays, schema=schema), sink, compression="zstd")
    content = sink.getvalue()
    files.write(folder / part_path(table, number), content)
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def file_checksum(path: Path) -> str:
    """Return the BLAKE2b of a file, computed as by `write_part`.

    Raises:
        OSError: The file cannot be read.
    """
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def read_parts(folder: Path, table: str, count: int) -> dict[str, list[Any]]:
    """Return the columns of the first parts of a table; vectors are tuples of three.

    Raises:
        EvidenceError: A part is missing or damaged.
    """
    columns: dict[str, list[Any]] = {name: [] for name in SCHEMAS[table].names}
    for number in range(count):
        path = folder / part_path(table, number)
        try:
            part = pa.parquet.read_table(path.absolute(), partitioning=None)
            if not part.schema.equals(SCHEMAS[table]):
                raise EvidenceError(f"the columns of the table {table} differ", where=str(path), remedy=RUN_AGAIN)
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
        flat = pa.array([component for vector in values for component in vector], pa.float64())
        return pa.FixedSizeListArray.from_arrays(flat, 3)
    return pa.array(values, kind)


def _values(array: pa.Array) -> list[Any]:
    if array.type == _VECTOR:
        flat = iter(array.flatten().to_pylist())
        return list(zip(flat, flat, flat, strict=True))
    values: list[Any] = array.to_pylist()
    return values


Rows = dict[str, list[Row]]


@dataclass
class RecordingState:
    """The state of a recording between two parts.

    Attributes:
        parts: Number of parts of each table.
        windows: Number of recorded windows.
        digest: Hash over all events of these windows.
        under_way: Packets whose fate is not decided yet, by packet id, each with the window in which it entered.
        checksums: Checksums of all files of tables, by path.
    """

    parts: int = 0
    windows: int = 0
    digest: EventDigest = field(default_factory=EventDigest)
    under_way: dict[int, tuple[Fate, int]] = field(default_factory=dict)
    checksums: dict[str, str] = field(default_factory=dict)

    def copy(self) -> Self:
        """Return an independent copy."""
        return replace(
            self, digest=deepcopy(self.digest), under_way=dict(self.under_way), checksums=dict(self.checksums)
        )

    def add_windows(self, windows: Sequence[Window]) -> Rows:
        """Add windows to the state, and return the rows of each table."""
        rows: Rows = {table: [] for table in TABLES}
        for window in windows:
            for fate in window.entered_fates:
                self.under_way[fate.packet.packet_id] = fate, self.windows
            for fate in window.decided_fates:
                _, entered_window = self.under_way.pop(fate.packet.packet_id)
                rows["packets"].append(_packet_row(fate, entered_window, self.windows))
            rows["windows"].append(
                (
                    self.windows,
                    window.begin_ns,
                    window.end_ns,
                    window.decided_by,
                    *(window.wall_s[part] for part in ("agents", "network", "exchange", "wait")),
                )
            )
            rows["states"] += state_rows(window.end_ns, window.states)
            self.digest.add_window(window.end_ns, window.entered_fates, window.decided_fates)
            self.windows += 1
        return rows

    def undecided_rows(self) -> list[Row]:
        """Return the rows of `packets` for the packets that are under way."""
        return [_packet_row(fate, entered_window, None) for fate, entered_window in self.under_way.values()]


def state_rows(at_ns: int, states: Mapping[str, State]) -> list[Row]:
    """Return one row of the table `states` per agent, for the time `at_ns`."""
    return [(at_ns, name, *_state_values(state)) for name, state in states.items()]


def _packet_row(fate: Fate, entered_window: int, ended_window: int | None) -> Row:
    packet = fate.packet
    # The fate may have been decided in a window that was interrupted and is not recorded.
    outcome = (
        (None, None, 0, "") if ended_window is None else (fate.arrived_ns, fate.counted_ns, fate.late_ns, fate.reason)
    )
    ends = (*fate.assumed_states, *fate.true_states)
    return (
        packet.packet_id,
        *packet.identity,
        packet.source,
        packet.destination,
        packet.protocol,
        packet.size_bytes,
        packet.sent_ns,
        packet.enters_ns,
        entered_window,
        *outcome,
        ended_window,
        *(value for state in ends for value in _state_values(state)),
    )


def _state_values(state: State) -> Row:
    return state.position_m, state.velocity_m_s, state.heading_rad
