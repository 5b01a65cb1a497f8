import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from fieldkit.core import files


def test_write_keeps_the_old_file_and_its_mode_on_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "trial.csv"
    files.write(path, b"older")
    path.chmod(0o640)
    files.write(path, b"old")

    def raise_disk_full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fieldkit.core.files.os.fsync", raise_disk_full)
    with pytest.raises(OSError, match="No space") as error_info:
        files.write(path, b"new")
    assert error_info.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert path.stat().st_mode & 0o7777 == 0o640
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["first ends first", "last ends first"])
def test_each_of_two_writers_replaces_a_file_with_complete_content(tmp_path: Path, order: tuple[int, int]) -> None:
    path = tmp_path / "report.html"
    path.write_bytes(b"old")
    stacks = [ExitStack() for _ in order]
    writers = [stack.enter_context(files.replacing(path)) for stack in stacks]
    for number, writer in enumerate(writers):
        writer.write(b"%d begins" % number)
        writer.flush()
    for number in order:
        writers[number].write(b" and ends")
        stacks[number].close()
        assert path.read_bytes() == b"%d begins and ends" % number
    assert list(tmp_path.iterdir()) == [path]


def test_the_temporary_file_of_a_killed_process_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    script = "import os, signal, sys; from pathlib import Path; from fieldkit.core import files\n"
    script += "with files.replacing(Path(sys.argv[1])) as file: file.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    completed = subprocess.run([sys.executable, "-c", script, str(path)], check=False, timeout=60)
    assert completed.returncode == -signal.SIGKILL
    (temporary_file,) = tmp_path.iterdir()
    files.write(path, b"page")
    assert not temporary_file.exists()
    assert list(tmp_path.iterdir()) == [path]


def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    os.mkfifo(path)
    with pytest.raises(OSError, match="it is a pipe"):
        files.write(path, b"page")
    assert path.is_fifo()
    assert list(tmp_path.iterdir()) == [path]


def test_free_bytes_of_a_missing_folder_are_those_of_the_disk_of_its_parent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert files.nearest_existing(Path("trials/campaign_lawn")) == tmp_path
    assert files.free_bytes(Path("trials")) > 0
