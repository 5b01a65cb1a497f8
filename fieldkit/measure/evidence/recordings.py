"""Contents of recordings of sensors. Packages add readers for formats by entry points (`plugins.RECORDINGS`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path

from fieldkit.core import plugins
from fieldkit.core.errors import EvidenceError


@dataclass(frozen=True)
class RecordingContents:
    """Contents of a recording.

    Attributes:
        messages: Number of messages.
        started_utc_ns: Time of the first message, nanoseconds since 1970 UTC by the recorder's clock.
        duration_s: Time from the first message to the last, in seconds.
        messages_by_topic: Number of messages per topic.
    """

    messages: int
    started_utc_ns: int
    duration_s: float
    messages_by_topic: Mapping[str, int]


RecordingReader = Callable[[Path], RecordingContents]
"""Function that returns the contents of a recording, and raises the same errors as `read`."""


def read(path: Path) -> RecordingContents:
    """Return the contents of a recording. The suffix of its name determines the format.

    Raises:
        EvidenceError: The file is missing, damaged or without messages, or no package reads its format.
    """
    entry_point = _readers().get(path.suffix)
    if entry_point is None:
        raise EvidenceError("is not a recording in a known format", where=str(path))
    reader: RecordingReader = plugins.load(entry_point)
    return reader(path)


@cache
def _readers() -> Mapping[str, EntryPoint]:
    """Return the entry points of the readers by file name suffix."""
    return {f".{point.name}": point for point in plugins.entry_points(plugins.RECORDINGS)}
