"""Named locks: exactly one process holds a lock and no files remain, despite other users, crashes and contention."""

import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core import runtime
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.runtime import NameHeldError
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until

NAME = "trial-0123abcd"


@pytest.fixture(autouse=True)
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a temporary base folder with a short path, as `base_folder` requires."""
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="rt") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield Path(folder)


def private_folder(base: Path) -> Path:
    return base / f"fieldkit-{os.geteuid()}"


def test_a_lock_is_exclusive_and_leaves_no_file(base: Path) -> None:
    with runtime.hold_lock(NAME):
        assert private_folder(base).stat().st_mode & 0o777 == 0o700
        with runtime.hold_lock("another"):
            assert len(list(private_folder(base).iterdir())) == 2
        with pytest.raises(NameHeldError), runtime.hold_lock(NAME):
            raise AssertionError("the lock is held twice")
    assert list(base.iterdir()) == []
    with runtime.hold_lock(NAME):
        pass


def test_a_file_left_by_kill_9_is_not_locked_and_is_removed(base: Path) -> None:
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        with runtime.hold_lock(NAME), runtime.hold_lock("another"):
            os.write(writer, b"+")
            signal.pause()
    os.read(reader, 1)
    with pytest.raises(NameHeldError), runtime.hold_lock(NAME):
        raise AssertionError("the other process holds it")
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    os.close(reader)
    os.close(writer)
    assert len(list(private_folder(base).iterdir())) == 2, "a killed process leaves its files"
    with runtime.hold_lock(NAME):
        assert [path.name for path in private_folder(base).iterdir()] == [f"{NAME}.lock"]
    assert list(base.iterdir()) == []


def test_one_of_many_processes_gets_the_lock(base: Path) -> None:
    start_pipe, hold_pipe = os.pipe(), os.pipe()
    children = []
    for _ in range(12):
        pid = os.fork()
        if pid == 0:
            exit_code = 2
            try:
                os.close(start_pipe[1])
                os.close(hold_pipe[1])
                os.read(start_pipe[0], 1)  # blocks until the pipe is closed
                with runtime.hold_lock(NAME):
                    os.read(hold_pipe[0], 1)
                exit_code = 0
            except NameHeldError:
                exit_code = 1
            finally:
                os._exit(exit_code)
        children.append(pid)
    os.close(start_pipe[1])
    exit_codes: dict[int, int] = {}

    def are_all_but_one_refused() -> bool:
        for pid in set(children) - exit_codes.keys():
            ended_pid, status = os.waitpid(pid, os.WNOHANG)
            exit_codes.update({pid: os.waitstatus_to_exitcode(status)} if ended_pid else {})
        return len(exit_codes) >= len(children) - 1

    wait_until(are_all_but_one_refused, Deadline.after(60))
    assert list(exit_codes.values()) == [1] * 11
    os.close(hold_pipe[1])
    (holder,) = set(children) - exit_codes.keys()
    assert os.waitstatus_to_exitcode(os.waitpid(holder, 0)[1]) == 0
    os.close(start_pipe[0])
    os.close(hold_pipe[0])
    assert list(base.iterdir()) == []


def test_concurrent_processes_can_lock_while_others_remove_stale_files(base: Path) -> None:
    children = []
    for number in range(4):
        pid = os.fork()
        if pid == 0:
            exit_code = 1
            try:
                for _ in range(100):
                    with runtime.hold_lock(f"own-{number}"):
                        pass
                exit_code = 0
            finally:
                os._exit(exit_code)
        children.append(pid)
    assert [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in children] == [0] * 4
    assert list(base.iterdir()) == []


@pytest.mark.parametrize("kind", ["open to others", "of another user", "link", "file", "link to nothing"])
def test_a_path_that_another_user_controls_is_refused_and_unchanged(base: Path, tmp_path: Path, kind: str) -> None:
    path, victim = private_folder(base), tmp_path / "victim"
    victim.mkdir(mode=0o700)
    match kind:
        case "open to others":
            path.mkdir()
            path.chmod(0o777)
        case "of another user":
            path.mkdir(mode=0o700)
            try:
                os.chown(path, 54321, 54321)
            except PermissionError:
                pytest.skip("only root gives a folder away")
        case "link":
            path.symlink_to(victim)
        case "file":
            path.touch(mode=0o600)
        case _:
            path.symlink_to(tmp_path / "nothing")
    with pytest.raises(ConfigurationError) as error_info, runtime.hold_lock(NAME):
        raise AssertionError("a lock is held in a folder where others can write")
    assert not isinstance(error_info.value, NameHeldError)
    assert "XDG_RUNTIME_DIR" in error_info.value.remedy
    assert list(victim.iterdir()) == []
    assert not (tmp_path / "nothing").exists()


def test_a_link_in_place_of_the_lock_file_is_not_followed(base: Path, tmp_path: Path) -> None:
    private_folder(base).mkdir(mode=0o700)
    (private_folder(base) / f"{NAME}.lock").symlink_to(tmp_path / "made")
    with pytest.raises(ConfigurationError), runtime.hold_lock(NAME):
        raise AssertionError("a lock is held through a link")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("fault", ["is not there", "others write there", "is relative", "is too long"])
def test_a_runtime_folder_that_is_not_private_is_not_used(
    base: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    assert runtime.base_folder() == base
    folder = {"is not there": base / "none", "is relative": Path(), "is too long": base / ("x" * 60)}.get(fault, base)
    if fault == "is too long":
        folder.mkdir(mode=0o700)
    if fault == "others write there":
        base.chmod(0o777)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    assert runtime.base_folder() != folder


def test_no_abstract_sockets_are_used() -> None:
    """Any user can bind the name of an abstract socket first (unix(7))."""
    sources = [path for package in ("fieldkit", "sim_backends") for path in (ROOT / package).rglob("*.py")]
    assert len(sources) > 300
    assert [path for path in sources if 'bind(f"\\0' in path.read_text(encoding="utf-8")] == []
    assert [path for path in sources if '"\\0fieldkit' in path.read_text(encoding="utf-8")] == []
