"""What each robot would have captured, as pcap files: draft-ietf-opsawg-pcap, in nanoseconds of simulated time."""

import os
import struct
from collections.abc import Sequence
from io import FileIO
from pathlib import Path
from typing import Final

from sim_backends.cosim.recording.internet import InternetBytes
from sim_backends.network.ip import Fragment

_NANOSECONDS: Final = 0xA1B23C4D
_RAW_IP: Final = 101
"""LINKTYPE_RAW: packets begin with the header of IP."""
_FILE: Final = struct.Struct("<IHHiIII")
_RECORD: Final = struct.Struct("<IIII")


class Captures:
    """One capture file for each robot, of what it sent and of what arrived at it; for those that do neither, none.

    Files grow by whole packets, so that a run that is killed leaves them readable.

    Args:
        folder: Where to; made for the first packet.
        names: The robots.
        snap_bytes: How much of each packet is kept, as by tcpdump's `-s`.
    """

    def __init__(self, folder: Path, names: Sequence[str], snap_bytes: int) -> None:
        self._folder = folder
        self._snap_bytes = snap_bytes
        self._bytes = InternetBytes(names)
        self._pending: dict[str, bytearray] = {}
        self._files: dict[str, FileIO] = {}
        self._written: dict[str, int] = {}

    def log(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Take a packet, or a fragment of one, that a robot sent or that arrived at it (`IpLog`)."""
        data = self._bytes.of(fragment, self._snap_bytes)
        if name not in self._pending:
            self._pending[name] = bytearray(_FILE.pack(_NANOSECONDS, 2, 4, 0, 0, self._snap_bytes, _RAW_IP))
        self._pending[name] += _RECORD.pack(*divmod(at_ns, 10**9), len(data), fragment.size_bytes) + data

    def flush(self) -> None:
        """Write what is not written yet.

        Raises:
            OSError: A file cannot be written.
        """
        for name, pending in self._pending.items():
            if name not in self._files:
                self._folder.mkdir(exist_ok=True)
                self._written[name] = 0
                self._files[name] = (self._folder / f"{name}.pcap").open("xb", buffering=0)
            self._write(name, pending)

    def close(self) -> None:
        """Close the files; what was not flushed is lost."""
        for file in self._files.values():
            file.close()

    def _write(self, name: str, pending: bytearray) -> None:
        descriptor, at, done = self._files[name].fileno(), self._written[name], 0
        while done < len(pending):
            # At its place, so that who is interrupted before the account below writes nothing twice.
            done += os.pwrite(descriptor, bytes(pending[done:]), at + done)
        self._written[name], self._pending[name] = at + done, bytearray()
