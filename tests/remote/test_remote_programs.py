"""A copied program on a robot is complete and executable, and is stored in a hidden folder of its attempt."""

import hashlib
from pathlib import Path

import pytest

from fieldkit.core.errors import RobotError
from fieldkit.remote import programs
from tests.helpers.userlands import USERLANDS, LocalShell, userland_path

CONTENT = bytes(range(256)) * 1000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.mark.parametrize("userland", USERLANDS)
def test_copy_is_complete_private_and_idempotent(tmp_path: Path, userland: str) -> None:
    shell = LocalShell(tmp_path, userland_path(userland, tmp_path / "bin"))
    copy_path = programs.path("a.run", "the probe's $1")
    for executable, mode in ((True, 0o700), (False, 0o600)):
        programs.copy(shell, "folder", copy_path, CONTENT, SHA256, executable=executable)
        copy = tmp_path / "folder" / copy_path
        assert copy.read_bytes() == CONTENT
        assert copy.stat().st_mode & 0o777 == mode
    assert [path.name for path in copy.parent.iterdir()] == [copy.name], "no other file remains"
    entries = (tmp_path / "folder").iterdir()
    assert all(path.name.startswith(".") for path in entries), "the copy is not evidence, and is not fetched"


def test_incomplete_copy_is_rejected(tmp_path: Path) -> None:
    copy_path = programs.path("run", "probe")
    with pytest.raises(RobotError, match="the copy is incomplete"):
        programs.copy(LocalShell(tmp_path), "folder", copy_path, CONTENT[:-1], SHA256, executable=True)
    assert not (tmp_path / "folder" / copy_path).exists()


def test_read_only_robot_is_reported(tmp_path: Path) -> None:
    (tmp_path / "folder").write_bytes(b"")
    with pytest.raises(RobotError, match="ended with exit code"):
        programs.copy(LocalShell(tmp_path), "folder", programs.path("run", "a"), CONTENT, SHA256, executable=True)
