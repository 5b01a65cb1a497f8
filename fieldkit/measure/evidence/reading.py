"""The names of the files that make up the evidence of one repeat, and how they are read."""

import os
from collections.abc import Callable
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final, TypeVar

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind

Piece = TypeVar("Piece")

RECEIVED_FILE: Final = "recv.bag"
"""What the listener wrote."""
SENDER_CAPTURE: Final = "sender.pcap"
RECEIVER_CAPTURE: Final = "receiver.pcap"
SENDER_CAPTURE_LOG: Final = "sender-capture.log"
"""What tcpdump said on its standard error."""
RECEIVER_CAPTURE_LOG: Final = "receiver-capture.log"
PING: Final = "ping.txt"
"""What ping said on its standard output."""
MEDIUM: Final = "medium.txt"
"""What the lab alone knew of the transfer's packets; of fields and benches there is none."""
LATENESS: Final = "lateness.txt"
"""How far a lab that models the air fell behind its model; others leave none."""
TRACK: Final = "track.csv"
"""Where the robots were and how they moved; labs that do not know leave none."""
SENDER_BEFORE: Final = "sender-before.txt"
"""Host state: sections, each a line `==> FILE <==`, as tail writes it, and that file's verbatim text."""
SENDER_AFTER: Final = "sender-after.txt"
RECEIVER_BEFORE: Final = "receiver-before.txt"
RECEIVER_AFTER: Final = "receiver-after.txt"


def fault_note(kind: FaultKind) -> str:
    """Return the file that says how long the cause of a fault lasted, and how often the observer asked."""
    return f"fault-{kind}.txt"


def fault_ping(kind: FaultKind) -> str:
    """Return the file of what the observer's ping said."""
    return f"fault-{kind}-ping.txt"


def fault_watch(kind: FaultKind) -> str:
    """Return the file of when processes lived: seconds since boot, and `up` with their ids, a line each time."""
    return f"fault-{kind}-watch.txt"


def known(read: Callable[[Path], Piece], path: Path) -> Piece | None:
    """Return a piece of evidence, None when it is missing or not what it must be."""
    try:
        return read(path)
    except EvidenceError:
        return None


def content(path: Path) -> bytes:
    """Return the bytes of one piece of evidence.

    Raises:
        EvidenceError: It is missing or cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error


def mapped(path: Path) -> bytes | mmap:
    """Return the bytes of one piece of evidence, mapped into memory; raises `EvidenceError` as `content` does."""
    try:
        with path.open("rb") as file:
            # Nothing cannot be mapped.
            return mmap(file.fileno(), 0, access=ACCESS_READ) if os.fstat(file.fileno()).st_size else b""
    except OSError as error:
        raise _unreadable(path, error) from error


def text(path: Path) -> str:
    """Return a tool's output, bytes that are no UTF-8 replaced; raises `EvidenceError` as `content` does."""
    return content(path).decode(errors="replace")


def _unreadable(path: Path, error: OSError) -> EvidenceError:
    return EvidenceError(
        f"cannot be read: {error.strerror or error}", where=str(path), remedy="repeat the measurement"
    )
