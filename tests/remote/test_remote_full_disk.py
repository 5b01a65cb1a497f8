"""A full disk of a robot is rejected before an attempt, or reported later. The home is a small file system."""

import os
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LockLostError, RobotError
from fieldkit.core.events import Event, Note
from fieldkit.core.model import Role
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.jobs import Job
from fieldkit.trial.running import locks
from fieldkit.trial.running.locks import Holder, locked
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import USERLANDS_OF_LONG_TESTS, LocalSession, LocalShell, userland_path

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial", "udp-01-1")
NO_SPACE = "No space left on device"
_FEW_PAGES = 8


class SmallShell(LocalShell):
    """A robot whose home is mounted in the mount namespace of the process `holder` only."""

    holder = 0

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> LocalSession:
        enter = ("nsenter", "-t", str(self.holder), "-m", "sh", "-c", 'cd "$HOME" && exec "$@"', "sh")
        return super().begin((*enter, *argv), deadline=deadline, until=until)


@pytest.fixture(params=USERLANDS_OF_LONG_TESTS)
def shell(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[SmallShell]:
    home = tmp_path / "home"
    home.mkdir()
    small_shell = SmallShell(home, userland_path(request.param, tmp_path / "bin"))
    script = 'mount -t tmpfs -o size=2m tmpfs "$1" && echo mounted && exec cat'
    argv = ("unshare", "--mount", "--propagation", "private", "sh", "-c", script, "sh", str(home))
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"mounted\n"
        small_shell.holder = holder.pid
        jobs.install(small_shell, Deadline.after(30))
        yield small_shell
        small_shell.run(("rm", "-f", ".fieldkit/fill"), deadline=Deadline.after(30))
        assert jobs.abort(small_shell, "test", Deadline.after(30)).jobs == ()


def fill(shell: SmallShell) -> None:
    shell.run(("sh", "-c", "cat /dev/zero >.fieldkit/fill"), deadline=Deadline.after(30), check=False)


def job(*argv: str) -> Job:
    return Job(folder=FOLDER, name="job", argv=argv, limit_s=100, log="job.log")


def test_disk_too_small_for_the_evidence_is_rejected_first(shell: SmallShell) -> None:
    with pytest.raises(RobotError, match=r"\d{4} KiB of disk are free, 102400 KiB are needed") as error_info:
        evidence.begin(shell, FOLDER, "sender", "lo")
    assert "remove old trials" in error_info.value.remedy
    assert shell.run(("ls", ".fieldkit/trial"), deadline=Deadline.after(30), check=False).exit_code != 0


def test_host_state_that_does_not_fit_is_reported_and_can_be_repeated(shell: SmallShell) -> None:
    shell.run(("mkdir", "-p", f"{FOLDER}/.jobs"), deadline=Deadline.after(30))
    fill(shell)
    with pytest.raises(RobotError, match=NO_SPACE):
        evidence.begin(shell, FOLDER, "sender", "lo", required_kib=0)
    shell.run(("rm", ".fieldkit/fill"), deadline=Deadline.after(30))
    evidence.begin(shell, FOLDER, "sender", "lo", required_kib=100)
    state = shell.run(("cat", f"{FOLDER}/sender-before.txt"), deadline=Deadline.after(30)).stdout
    assert b"==> /proc/net/snmp <==" in state


def test_job_whose_identity_cannot_be_recorded_does_not_start(shell: SmallShell) -> None:
    evidence.begin(shell, FOLDER, "sender", "lo", required_kib=100)
    fill(shell)
    for call in (jobs.run, jobs.start):
        with pytest.raises(RobotError, match=NO_SPACE):
            call(shell, replace(job("touch", "started"), name=call.__name__, ready_s=3))
    assert shell.run(("ls", f"{FOLDER}/started"), deadline=Deadline.after(30), check=False).exit_code != 0


def test_evidence_that_does_not_fit_is_reported(shell: SmallShell, tmp_path: Path) -> None:
    evidence.begin(shell, FOLDER, "sender", "lo", required_kib=100)
    jobs.run(shell, replace(job("cat", "/dev/zero"), stdout="recv.bag"))
    into = tmp_path / "local"
    into.mkdir()
    with pytest.raises(RobotError, match=NO_SPACE):
        fetching.fetch(shell, FOLDER, "sender", "lo", into)
    assert not list(into.iterdir())


def test_lock_that_does_not_fit_is_reported(shell: SmallShell) -> None:
    fill(shell)
    with pytest.raises(RobotError, match=NO_SPACE), locked({Role.SENDER: shell}, Holder("a", "b", "c"), sink=print):
        raise AssertionError("the lock is held")


def test_lock_that_cannot_be_renewed_is_reported_and_kept(shell: SmallShell) -> None:
    anna, bert = Holder("a", "anna@one", "a"), Holder("b", "bert@two", "b")
    with locked({Role.SENDER: shell}, anna, sink=print):
        evidence.begin(shell, FOLDER, "sender", "lo", required_kib=100, token="a")
        shell.run(("sh", "-c", ADVANCE_LOCK_TIMES), deadline=Deadline.after(30))
        fill(shell)
        with pytest.raises(RobotError, match=NO_SPACE):
            evidence.begin(shell, FOLDER, "sender", "lo", required_kib=0, token="a")
        shell.run(("rm", ".fieldkit/fill"), deadline=Deadline.after(30))
        with pytest.raises(RobotError, match="anna@one locked it"), locked({Role.SENDER: shell}, bert, sink=print):
            raise AssertionError("the lock is held twice")
        evidence.begin(shell, FOLDER, "sender", "lo", required_kib=0, token="a")


# The lock starts at boot, because the machine may have booted less than half of the duration of the lock ago.
ADVANCE_LOCK_TIMES = """read -r kind token boot from to since until who what <.fieldkit/lock.1
times="0 $((2 * from)) $since $until"
echo "$kind $token $boot $times $who $what" >.fieldkit/lock.1"""


def is_full(shell: SmallShell) -> bool:
    """Return True if hardly a page is free; a test write might keep the last page allocated."""
    return os.statvfs(f"/proc/{shell.holder}/root{shell.home}").f_bavail < _FEW_PAGES


def test_job_that_fills_the_disk_is_stopped_by_abort_of_any_version(shell: SmallShell) -> None:
    anna = Holder("a", "anna@one", "a")
    with locked({Role.SENDER: shell}, anna, sink=print):
        evidence.begin(shell, FOLDER, "sender", "lo", required_kib=100, token="a")
        jobs.start(shell, job("sh", "-c", "cat /dev/zero >hole; exec sleep 100"))
        wait_until(lambda: is_full(shell), Deadline.after(30))
        fill(shell)
        shell.run(("sh", "-c", "mv .fieldkit/job-*.sh .fieldkit/job-older.sh"), deadline=Deadline.after(30))
        (aborted,) = locks.abort({"robot": shell}, "bert@two").values()
        assert len(aborted.jobs) == 1
        assert aborted.error is not None
        assert NO_SPACE in aborted.error.what
        assert "remove old trials" in aborted.error.remedy
        shell.run(("sh", "-c", f"rm -f .fieldkit/fill {FOLDER}/hole"), deadline=Deadline.after(30))
        (aborted,) = locks.abort({"robot": shell}, "bert@two").values()
        assert (aborted.locked, aborted.jobs, aborted.error) == (True, (), None)
        jobs.install(shell, Deadline.after(30))
        with pytest.raises(LockLostError, match="aborted by bert@two"):
            evidence.begin(shell, FOLDER, "sender", "lo", required_kib=0, token="a")


def test_lock_that_cannot_be_released_is_reported_and_not_awaited(shell: SmallShell) -> None:
    events: list[Event] = []
    with locked({Role.SENDER: shell}, Holder("a", "anna@one", "a"), sink=events.append):
        fill(shell)
    (note,) = events
    assert isinstance(note, Note)
    assert NO_SPACE in note.text
    assert locks.read_lock(shell) is not None
    shell.run(("rm", ".fieldkit/fill"), deadline=Deadline.after(30))
    assert jobs.abort(shell, "bert@two", Deadline.after(30)).locked
