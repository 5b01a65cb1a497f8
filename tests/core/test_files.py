import os
from pathlib import Path

import pytest

from fieldkit.core import files


def test_write_keeps_the_old_file_and_its_mode_on_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "trial.csv"
    files.write(path, b"older")
    path.chmod(0o640)
    files.write(path, b"old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fieldkit.core.files.os.fsync", full)
    with pytest.raises(OSError, match="No space") as caught:
        files.write(path, b"new")
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert path.stat().st_mode & 0o7777 == 0o640
    assert list(tmp_path.iterdir()) == [path]


def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    os.mkfifo(path)
    with pytest.raises(OSError, match="it is a pipe"):
        files.write(path, b"page")
    assert path.is_fifo()
    assert list(tmp_path.iterdir()) == [path]


def test_free_bytes_of_a_missing_folder_are_those_of_its_parent_s_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert files.nearest_existing(Path("trials/campaign_lawn")) == tmp_path
    assert files.free_bytes(Path("trials")) > 0
