"""Tables of numpy columns, and integers read out of a file's bytes at one position per row."""

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
Buffer = bytes | mmap

BIG: Final = ">"
LITTLE: Final = "<"
Order = Literal["<", ">"]
"""Byte order, as `struct` and numpy write it."""


# Any odd number with well spread bits multiplies without loss; this one is 2**64 over the golden ratio.
_SPREAD: Final = np.uint64(0x9E3779B97F4A7C15)


def layout(order: Order, size_bytes: int, **fields: tuple[int, int]) -> np.dtype[np.void]:
    """Return the form of a header of `size_bytes`, its fields unsigned integers: offset and size in bytes of each."""
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
    """Columns of one length; a subclass declares them as its fields."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def where(self, chosen: Mask | Ints | slice) -> Self:
        """Return the rows of a mask, or those of an index in its order."""
        if not isinstance(chosen, slice) and chosen.dtype == np.bool_ and chosen.all():
            return self
        return type(self)(**{name: column[chosen] for name, column in vars(self).items()})

    def room(self, rows: int) -> Self:
        """Return so many rows of the same columns, to be written.

        They are one block of memory, for which the system has large pages.
        """
        columns: dict[str, NDArray[Any]] = vars(self)
        sizes = [rows * column.dtype.itemsize * math.prod(column.shape[1:]) for column in columns.values()]
        # Each column begins where a number may.
        starts = np.cumsum([0, *((size + 7) // 8 * 8 for size in sizes)])
        block = np.empty(starts[-1], dtype=np.uint8)
        return type(self)(
            **{
                name: block[start : start + size].view(column.dtype).reshape(rows, *column.shape[1:])
                for (name, column), start, size in zip(columns.items(), starts, sizes, strict=False)
            }
        )

    def write(self, at: int, rows: Self) -> None:
        """Write rows from row `at` on."""
        for name, column in vars(rows).items():
            vars(self)[name][at : at + len(rows)] = column

    @classmethod
    def joined(cls, parts: Iterable[Self]) -> Self:
        """Return the rows of all parts, of which there is at least one, in their order."""
        parts = list(parts)
        if len(parts) == 1:
            return parts[0]
        found, at = parts[0].room(sum(map(len, parts))), 0
        for part in parts:
            found.write(at, part)
            at += len(part)
        return found


class Narrow:
    """Column of a `Table` that takes few bytes in memory and is read as 64-bit integers.

    Whoever reads it can add and subtract without an overflow. A table holds above twenty columns of millions of
    packets, of which a computation reads a few.

    Args:
        kind: Type in memory, which holds every value that the column can have.
    """

    def __init__(self, kind: type[np.integer[Any]]) -> None:
        self._kind = kind
        self._name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        """Take the name of the column."""
        self._name = name

    def __get__(self, table: object, owner: type | None = None) -> Ints:
        """Return the column, a copy.

        Raises:
            AttributeError: The class is asked, whose field has no default.
        """
        if table is None:
            raise AttributeError(self._name)
        return np.asarray(vars(table)[self._name], dtype=np.int64)

    def __set__(self, table: object, values: Ints) -> None:
        """Keep values, which fit."""
        vars(table)[self._name] = np.asarray(values, dtype=self._kind)


class Integers:
    """Unsigned integers in a buffer, at any position.

    A position too near to the end of the buffer reads the last integer that is whole: headers of a packet that was
    cut short may reach beyond the file, and whoever reads them masks what was not kept.
    """

    def __init__(self, data: Buffer, order: Order = BIG) -> None:
        self._data = data
        self._views = {
            size: np.ndarray(max(len(data) - size + 1, 0), f"{order}u{size}", buffer=data, strides=(1,))
            for size in (1, 2, 4, 8)
        }

    def in_order(self, order: Order) -> "Integers":
        """Return the integers of the same buffer in another byte order."""
        return Integers(self._data, order)

    def u8(self, at: Ints) -> Ints:
        """Return the byte at each position."""
        return self._read(1, at).astype(np.int64)

    def u16(self, at: Ints) -> Ints:
        """Return the two bytes from each position on."""
        return self._read(2, at).astype(np.int64)

    def u32(self, at: Ints) -> Ints:
        """Return the four bytes from each position on."""
        return self._read(4, at).astype(np.int64)

    def u64(self, at: Ints) -> NDArray[np.uint64]:
        """Return the eight bytes from each position on."""
        return self._read(8, at).astype(np.uint64)

    def fields(self, form: np.dtype[np.void], at: Ints) -> "Fields":
        """Return the headers from each position on: one look into the buffer for all of their fields.

        Where the buffer ends inside a header, the rest of it is zeros.
        """
        size = form.itemsize
        inside = at <= len(self._data) - size
        every = np.ndarray(max(len(self._data) - size + 1, 0), f"V{size}", buffer=self._data, strides=(1,))
        if inside.all():
            return Fields(every[at].view(form))
        found = np.zeros(len(at), every.dtype)
        found[inside] = every[at[inside]]
        for index in np.flatnonzero(~inside):
            found[index] = np.void(bytes(self._data[at[index] : at[index] + size]).ljust(size, b"\0"))
        return Fields(found.view(form))

    def _read(self, size: int, at: Ints) -> NDArray[Any]:
        view = self._views[size]
        return view[np.minimum(at, len(view) - 1)]


def mixed(*columns: Ints | Keys) -> Keys:
    """Return a number per row: equal for equal rows, and for others by a chance of one in 2**64."""
    found = np.zeros(len(columns[0]), dtype=np.uint64)
    for column in columns:
        found ^= column.view(np.uint64)
        found *= _SPREAD
        found ^= found >> np.uint64(29)
    return found


class Fields:
    """Fields of headers, as `Integers.fields` found them."""

    def __init__(self, rows: NDArray[np.void]) -> None:
        self._rows = rows

    def __getitem__(self, field: str) -> Ints:
        return self._rows[field].astype(np.int64)


NO_TIME: Final = -1
"""Time of a frame of which the file tells none."""


@dataclass(frozen=True, eq=False)
class Frames(Table):
    """Frames in the order of the file.

    Attributes:
        start: Index of the first byte of each.
        captured_bytes: How much of it was kept.
        wire_bytes: Its length on the link.
        time_ns: Time of capture, nanoseconds since 1970 UTC; `NO_TIME` where the file tells none.
        link_type: How it begins, by number (https://www.tcpdump.org/linktypes.html).
    """

    start: Ints
    captured_bytes: Ints
    wire_bytes: Ints
    time_ns: Ints
    link_type: Ints


@dataclass(frozen=True)
class Chunk:
    """Some frames that follow each other in a file.

    Attributes:
        frames: They.
        damage: Where and how the file is damaged after them, so that this chunk is the last; None when it is not.
    """

    frames: Frames
    damage: str | None
