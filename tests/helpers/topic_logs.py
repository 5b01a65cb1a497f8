"""Parser of topic logs that are still being written, independent of the reader under test."""

from pathlib import Path

from fieldkit.agent.messaging import records


def rows(path: Path) -> list[tuple[int, ...]]:
    """Fields of each complete record: kind, padding, size, sequence number, send time and local time."""
    content = path.read_bytes()
    assert content.startswith(records.MAGIC)
    offsets = range(len(records.MAGIC), len(content) - records.RECORD.size + 1, records.RECORD.size)
    complete_records = (records.RECORD.unpack_from(content, offset) for offset in offsets)
    return [record for record in complete_records if record[-1]]
