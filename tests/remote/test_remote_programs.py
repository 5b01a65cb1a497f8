"""A program of the lab on a robot: whole, with its right to execute, and gone with the folder of its attempt."""

import hashlib
from pathlib import Path

import pytest

from fieldkit.core.errors import RobotError
from fieldkit.remote import programs
from tests.helpers.userlands import USERLANDS, LocalShell, path_of

CONTENT = bytes(range(256)) * 1000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.mark.parametrize("userland", USERLANDS)
def test_a_copy_is_whole_and_private_and_may_be_made_again(tmp_path: Path, userland: str) -> None:
    shell = LocalShell(tmp_path, path_of(userland, tmp_path / "bin"))
    at = programs.path("a.run", "the probe's $1")
    for executable, mode in ((True, 0o700), (False, 0o600)):
        programs.place(shell, "folder", at, CONTENT, SHA256, executable=executable)
        copy = tmp_path / "folder" / at
        assert copy.read_bytes() == CONTENT
        assert copy.stat().st_mode & 0o777 == mode
    assert [path.name for path in copy.parent.iterdir()] == [copy.name], "nothing else is left"
    hidden = (tmp_path / "folder").iterdir()
    assert all(path.name.startswith(".") for path in hidden), "the copy is no evidence, and is not fetched"


def test_a_copy_that_is_not_whole_is_refused(tmp_path: Path) -> None:
    at = programs.path("run", "probe")
    with pytest.raises(RobotError, match="the copy is not whole"):
        programs.place(LocalShell(tmp_path), "folder", at, CONTENT[:-1], SHA256, executable=True)
    assert not (tmp_path / "folder" / at).exists()


def test_a_robot_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "folder").write_bytes(b"")
    with pytest.raises(RobotError, match="ended with exit code"):
        programs.place(LocalShell(tmp_path), "folder", programs.path("run", "a"), CONTENT, SHA256, executable=True)
