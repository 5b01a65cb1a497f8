"""A record in a file, with one writer and any number of readers.

Two slots are written alternately, each with a number and a CRC. After the first record, one of them therefore always
has a complete record, even while the other one is being written, or after the writer was killed during a write.
"""

import os
import struct
import zlib
from pathlib import Path
from typing import Any, ClassVar, Final, Self

_NUMBER: Final = struct.Struct("<Q")
_CRC: Final = struct.Struct("<I")


class Slots:
    """The two slots of a file.

    Args:
        fd: Descriptor of the file, which this object closes.
        layout: Layout of the values in the notation of `struct`, without padding.
    """

    def __init__(self, fd: int, layout: str) -> None:
        self._fd = fd
        self._slot = struct.Struct(f"<Q{layout}")
        self._slot_bytes = self._slot.size + _CRC.size
        self._number = 0
        self._values: tuple[Any, ...] | None = None
        self.read()

    def write(self, *values: int | float) -> None:
        """Write the values.

        Raises:
            OSError: There is no space for them.
        """
        self._number, self._values = self._number + 1, values
        slot = self._slot.pack(self._number, *values)
        os.pwrite(self._fd, slot + _CRC.pack(zlib.crc32(slot)), self._number % 2 * self._slot_bytes)

    def read(self) -> tuple[Any, ...] | None:
        """Return the newest values, or None if none were written. The same object is returned until they change.

        Raises:
            OSError: The file cannot be read.
        """
        data = os.pread(self._fd, 2 * self._slot_bytes, 0)
        for start in (0, self._slot_bytes):
            slot, crc = (
                data[start : start + self._slot.size],
                data[start + self._slot.size : start + self._slot_bytes],
            )
            if len(crc) == _CRC.size and _NUMBER.unpack_from(slot)[0] > self._number:
                self._accept(slot, crc)
        return self._values

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)

    def _accept(self, slot: bytes, crc: bytes) -> None:
        """Store the values of a newer slot, unless its CRC shows that it is being written."""
        if _CRC.unpack(crc)[0] == zlib.crc32(slot):
            self._number, *values = self._slot.unpack(slot)
            self._values = tuple(values)


class Record:
    """A record with a fixed layout in a file; subclasses add `write` and `read`.

    Args:
        fd: Descriptor of the file, which this object closes.

    Attributes:
        layout: Layout of the values; see `Slots`.
    """

    layout: ClassVar[str]

    def __init__(self, fd: int) -> None:
        self._slots = Slots(fd, self.layout)

    @classmethod
    def open(cls, path: Path) -> Self:
        """Return the record in a file, which is created if it is missing.

        Raises:
            OSError: The file cannot be created.
        """
        return cls(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))

    def close(self) -> None:
        """Close the file."""
        self._slots.close()
