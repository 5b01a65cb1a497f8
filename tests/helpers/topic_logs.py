"""Logs of topics while they grow: their records, read without the reader that is under test elsewhere."""

from pathlib import Path

from fieldkit.agent import records


def rows(path: Path) -> list[tuple[int, ...]]:
    """Return kind, nothing, size, sequence, time sent and time here of each record that is whole."""
    content = path.read_bytes()
    assert content.startswith(records.MAGIC)
    begins = range(len(records.MAGIC), len(content) - records.RECORD.size + 1, records.RECORD.size)
    found = (records.RECORD.unpack_from(content, begin) for begin in begins)
    return [one for one in found if one[-1]]
