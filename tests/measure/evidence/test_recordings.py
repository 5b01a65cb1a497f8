"""Recordings: the suffix of a file selects its reader."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core import plugins
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import recordings
from fieldkit.measure.evidence.recordings import RecordingContents
from fieldkit.measure.positions import position_files
from fieldkit.measure.positions.position_sources import PositionSource
from tests.helpers.outside_packages import write_package

READER = """\
from fieldkit.measure.evidence.recordings import RecordingContents

def read(path):
    return RecordingContents(len(path.read_text()), 0, 1.0, {})
"""


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "more_recordings.py").write_text(READER, encoding="utf-8")
    write_package(tmp_path, "more-recordings", f"[{plugins.RECORDINGS}]\nscans = more_recordings:read\n")
    monkeypatch.syspath_prepend(tmp_path)
    recordings._readers.cache_clear()
    yield
    recordings._readers.cache_clear()


def test_a_package_adds_a_format(tmp_path: Path) -> None:
    path = tmp_path / "run.scans"
    path.write_text("abc", encoding="utf-8")
    assert recordings.read(path) == RecordingContents(3, 0, 1.0, {})


@pytest.mark.parametrize("name", ["send.bin", "recording"])
def test_a_file_in_another_format_is_rejected(tmp_path: Path, name: str) -> None:
    with pytest.raises(EvidenceError, match="is not a recording in a known format"):
        recordings.read(tmp_path / name)
    with pytest.raises(EvidenceError, match="is not a recording in a known format"):
        position_files.read_topic(tmp_path / name, PositionSource(topic="/odom"))
