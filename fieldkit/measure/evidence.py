"""The names of the files that make up the evidence of one repeat, and how they are read."""

from pathlib import Path
from typing import Final

from fieldkit.errors import EvidenceError

RECEIVED_FILE: Final = "recv.bag"
"""What the listener wrote."""
SENDER_CAPTURE: Final = "sender.pcap"
RECEIVER_CAPTURE: Final = "receiver.pcap"
SENDER_CAPTURE_LOG: Final = "sender-capture.log"
"""What tcpdump said on its standard error."""
RECEIVER_CAPTURE_LOG: Final = "receiver-capture.log"
PING: Final = "ping.txt"
"""What ping said on its standard output."""
SENDER_BEFORE: Final = "sender-before.txt"
"""Host state: sections, each a line `==> FILE <==`, as tail writes it, and that file's verbatim text."""
SENDER_AFTER: Final = "sender-after.txt"
RECEIVER_BEFORE: Final = "receiver-before.txt"
RECEIVER_AFTER: Final = "receiver-after.txt"


def content(path: Path) -> bytes:
    """Return the bytes of one piece of evidence.

    Raises:
        EvidenceError: It is missing or cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise EvidenceError(
            f"cannot be read: {error.strerror or error}", where=str(path), remedy="repeat the measurement"
        ) from error


def text(path: Path) -> str:
    """Return a tool's output, bytes that are no UTF-8 replaced; raises `EvidenceError` as `content` does."""
    return content(path).decode(errors="replace")
