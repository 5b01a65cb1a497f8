"""Tables of numpy columns, and functions that read an integer per row from the bytes of a file."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from mmap import mmap
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Keys = NDArray[np.uint64]
"""Hashes of rows, from `row_hashes`."""
Buffer = bytes | mmap

BIG: Final = ">"
LITTLE: Final = "<"
Order = Literal["<", ">"]
"""Byte order in the notation of `struct` and numpy."""

# Multiplier of `row_hashes`: 2**64 divided by the golden ratio. The value is odd, so that the multiplication is
# invertible.
_MULTIPLIER: Final = np.uint64(0x9E3779B97F4A7C15)


def layout(order: Order, size_bytes: int, **fields: tuple[int, int]) -> np.dtype[np.void]:
    """Return the numpy type of a header of unsigned integers; `fields` gives the offset and size of each in bytes."""
    return np.dtype(
        {
            "names": list(fields),
            "formats": [f"{order}u{size}" for _, size in fields.values()],
            "offsets": [offset for offset, _ in fields.values()],
            "itemsize": size_bytes,
        }
    )


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length. A subclass declares the columns as its fields."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def where(self, selection: Mask | Ints | slice) -> Self:
        """Return the rows that a mask or a slice selects, or the rows at the given indices, in their order."""
        if not isinstance(selection, slice) and selection.dtype == np.bool_ and selection.all():
            return self
        return type(self)(**{name: column[selection] for name, column in vars(self).items()})

    def allocate(self, rows: int) -> Self:
        """Return an uninitialized table with the same columns and `rows` rows.

        All columns share one block of memory, so that the operating system can use large pages.
        """
        columns: dict[str, NDArray[Any]] = vars(self)
        sizes = [rows * column.dtype.itemsize * math.prod(column.shape[1:]) for column in columns.values()]
        # Each column starts at a multiple of 8 bytes for alignment.
        starts = np.cumsum([0, *((size + 7) // 8 * 8 for size in sizes)])
        block = np.empty(starts[-1], dtype=np.uint8)
        return type(self)(
            **{
                name: block[start : start + size].view(column.dtype).reshape(rows, *column.shape[1:])
                for (name, column), start, size in zip(columns.items(), starts, sizes, strict=False)
            }
        )

    def write(self, at: int, rows: Self) -> None:
        """Overwrite the rows of this table, starting at row `at`, with `rows`."""
        for name, column in vars(rows).items():
            vars(self)[name][at : at + len(rows)] = column

    @classmethod
    def concatenated(cls, parts: Iterable[Self]) -> Self:
        """Return the rows of all parts in order; there must be at least one part."""
        parts = list(parts)
        if len(parts) == 1:
            return parts[0]
        table, at = parts[0].allocate(sum(map(len, parts))), 0
        for part in parts:
            table.write(at, part)
            at += len(part)
        return table


class NarrowColumn:
    """Column of a `Table` that is stored in a narrow integer type and read as 64-bit integers.

    The narrow type saves memory, because a table has more than twenty columns of millions of packets. Reading as
    64-bit integers avoids overflows in additions and subtractions.

    Args:
        storage_type: Integer type in memory, which can represent every value of the column.
    """

    def __init__(self, storage_type: type[np.integer[Any]]) -> None:
        self._storage_type = storage_type
        self._name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        """Store the name of the column."""
        self._name = name

    def __get__(self, table: object, owner: type | None = None) -> Ints:
        """Return a copy of the column.

        Raises:
            AttributeError: The column was read from the class instead of a table.
        """
        if table is None:
            raise AttributeError(self._name)
        return np.asarray(vars(table)[self._name], dtype=np.int64)

    def __set__(self, table: object, values: Ints) -> None:
        """Store the values; each of them must fit into the storage type."""
        vars(table)[self._name] = np.asarray(values, dtype=self._storage_type)


class Integers:
    """Reads unsigned integers at any positions of a buffer.

    For a position too close to the end of the buffer, the last complete integer is read: the headers of a truncated
    packet may extend beyond the end of the file, and the caller masks the bytes that were not captured.
    """

    def __init__(self, data: Buffer, order: Order = BIG) -> None:
        self._data = data
        self._views = {
            size: np.ndarray(max(len(data) - size + 1, 0), f"{order}u{size}", buffer=data, strides=(1,))
            for size in (1, 2, 4, 8)
        }

    def with_order(self, order: Order) -> "Integers":
        """Return the integers of the same buffer in another byte order."""
        return Integers(self._data, order)

    def u8(self, at: Ints) -> Ints:
        """Return the byte at each position."""
        return self._read(1, at).astype(np.int64)

    def u16(self, at: Ints) -> Ints:
        """Return the two-byte integer at each position."""
        return self._read(2, at).astype(np.int64)

    def u32(self, at: Ints) -> Ints:
        """Return the four-byte integer at each position."""
        return self._read(4, at).astype(np.int64)

    def u64(self, at: Ints) -> NDArray[np.uint64]:
        """Return the eight-byte integer at each position."""
        return self._read(8, at).astype(np.uint64)

    def fields(self, header_type: np.dtype[np.void], at: Ints) -> "Fields":
        """Return the headers of this numpy type at the positions; all their fields are read together.

        If the buffer ends inside a header, the missing bytes are zeros.
        """
        size = header_type.itemsize
        is_complete = at <= len(self._data) - size
        headers = np.ndarray(max(len(self._data) - size + 1, 0), f"V{size}", buffer=self._data, strides=(1,))
        if is_complete.all():
            return Fields(headers[at].view(header_type))
        rows = np.zeros(len(at), headers.dtype)
        rows[is_complete] = headers[at[is_complete]]
        for index in np.flatnonzero(~is_complete):
            rows[index] = np.void(bytes(self._data[at[index] : at[index] + size]).ljust(size, b"\0"))
        return Fields(rows.view(header_type))

    def _read(self, size: int, at: Ints) -> NDArray[Any]:
        view = self._views[size]
        return view[np.minimum(at, len(view) - 1)]


def row_hashes(*columns: Ints | Keys) -> Keys:
    """Return a hash for each row.

    Equal rows have equal hashes. Rows that differ in one column only have different hashes. Other different rows have
    equal hashes with a probability of about 2**-64.
    """
    hashes = np.zeros(len(columns[0]), dtype=np.uint64)
    for column in columns:
        hashes ^= column.view(np.uint64)
        hashes *= _MULTIPLIER
        hashes ^= hashes >> np.uint64(29)  # the multiplication mixes only lower bits into higher ones
    return hashes


class Fields:
    """Fields of the headers that `Integers.fields` read."""

    def __init__(self, rows: NDArray[np.void]) -> None:
        self._rows = rows

    def __getitem__(self, field: str) -> Ints:
        return self._rows[field].astype(np.int64)


NO_TIME: Final = -1
"""Time of a frame without a time stamp in the file."""


@dataclass(frozen=True, eq=False)
class Frames(Table):
    """Frames in the order of the file.

    Attributes:
        start: Index of the frame's first byte in the file.
        captured_bytes: Number of captured bytes.
        wire_bytes: Length on the link.
        time_ns: Time of capture, nanoseconds since 1970 UTC, or `NO_TIME`.
        link_type: Link type number (https://www.tcpdump.org/linktypes.html).
    """

    start: Ints
    captured_bytes: Ints
    wire_bytes: Ints
    time_ns: Ints
    link_type: Ints


@dataclass(frozen=True)
class Chunk:
    """Consecutive frames of a file.

    Attributes:
        frames: The frames.
        damage: Position and kind of the damage after the frames; the chunk is then the last chunk of the file. None
            without damage.
    """

    frames: Frames
    damage: str | None
