"""The packet captures of robots as pcap files (draft-ietf-opsawg-pcap), in nanoseconds of simulated time."""

import os
import struct
from collections.abc import Sequence
from io import FileIO
from pathlib import Path
from typing import Final

from sim_backends.cosim.recording.internet import IpEncoder
from sim_backends.network.ip import Fragment

_NANOSECONDS_MAGIC: Final = 0xA1B23C4D
_LINKTYPE_RAW: Final = 101
"""Packets begin with the IP header."""
_FILE: Final = struct.Struct("<IHHiIII")
_RECORD: Final = struct.Struct("<IIII")


class Captures:
    """One capture file per robot, with the packets that it sent and that arrived at it; none for robots without any.

    Files grow by whole packets, so they are readable even if the run is killed.

    Args:
        folder: Folder of the files; it is created for the first packet.
        names: The robots.
        snap_bytes: Number of bytes kept of each packet, like tcpdump's `-s`.
    """

    def __init__(self, folder: Path, names: Sequence[str], snap_bytes: int) -> None:
        self._folder = folder
        self._snap_bytes = snap_bytes
        self._encoder = IpEncoder(names)
        self._pending: dict[str, bytearray] = {}
        self._files: dict[str, FileIO] = {}
        self._written_bytes: dict[str, int] = {}

    def log(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Add a packet, or a fragment of one, that a robot sent or that arrived at it (`IpLog`)."""
        data = self._encoder.encode(fragment, self._snap_bytes)
        if name not in self._pending:
            self._pending[name] = bytearray(
                _FILE.pack(_NANOSECONDS_MAGIC, 2, 4, 0, 0, self._snap_bytes, _LINKTYPE_RAW)
            )
        self._pending[name] += _RECORD.pack(*divmod(at_ns, 10**9), len(data), fragment.size_bytes) + data

    def flush(self) -> None:
        """Write the packets that are not written yet.

        Raises:
            OSError: A file cannot be written.
        """
        for name, pending in self._pending.items():
            if name not in self._files:
                self._folder.mkdir(exist_ok=True)
                self._written_bytes[name] = 0
                self._files[name] = (self._folder / f"{name}.pcap").open("xb", buffering=0)
            self._write(name, pending)

    def close(self) -> None:
        """Close the files; packets that were not flushed are lost."""
        for file in self._files.values():
            file.close()

    def _write(self, name: str, pending: bytearray) -> None:
        descriptor, at, done = self._files[name].fileno(), self._written_bytes[name], 0
        while done < len(pending):
            # Written at an explicit position, so that an interrupt before the count is updated duplicates nothing.
            done += os.pwrite(descriptor, bytes(pending[done:]), at + done)
        self._written_bytes[name], self._pending[name] = at + done, bytearray()
