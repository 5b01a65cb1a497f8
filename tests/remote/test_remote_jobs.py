"""Detached jobs: the script that runs on robots, here run in a folder of this machine by a shell without SSH."""

import os
import signal
import subprocess
import tarfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.deadline import Deadline
from fieldkit.errors import EvidenceError, RobotError
from fieldkit.model import Protocol
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Completed
from tests.sshd import free_port, wait_until

FOLDER = jobs.work_folder("trial", "udp-01-1")


class LocalSession:
    """A command that runs in that folder."""

    def __init__(self, argv: Sequence[str], home: Path) -> None:
        self.argv = tuple(argv)
        pipe = subprocess.PIPE
        environment = os.environ | {"HOME": str(home)}
        self.process = subprocess.Popen(argv, cwd=home, stdin=pipe, stdout=pipe, stderr=pipe, env=environment)

    def end(self, *, deadline: Deadline, check: bool = True, stdin: bytes = b"") -> Completed:
        out, err = self.process.communicate(stdin, timeout=deadline.remaining_s)
        if check and self.process.returncode:
            raise RobotError(f"exit code {self.process.returncode}: {err.decode()}", where="here")
        return Completed(self.argv, self.process.returncode, out, err)


class LocalShell:
    """Runs commands in a folder that stands for a robot's home."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.robot = "here"

    def begin(self, argv: Sequence[str], *, deadline: Deadline) -> LocalSession:
        return LocalSession(argv, self.home)

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        return LocalSession(argv, self.home).end(deadline=deadline, check=check, stdin=stdin)

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        done = self.run(argv, deadline=deadline)
        to.write_bytes(done.stdout[:limit_bytes])
        return done

    def close(self) -> None:
        return


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[LocalShell]:
    made = LocalShell(tmp_path)
    jobs.install(made, Deadline.after(10))
    evidence.begin(made, FOLDER, "sender", "lo")
    yield made
    evidence.end_jobs(made, FOLDER)
    assert jobs.left(made, Deadline.after(10)) == ()


def job(*argv: str, name: str = "job", limit_s: float = 30.0) -> Job:
    return Job(folder=FOLDER, name=name, argv=argv, limit_s=limit_s, log=f"{name}.log")


def leader(shell: LocalShell, name: str = "job") -> int:
    return int((shell.home / FOLDER / ".jobs" / name / "pid").read_text(encoding="ascii").split()[0])


def group_is_gone(pid: int) -> bool:
    """Return whether no process of the group runs; an orphan that waits to be reaped has ended."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = path.read_text(encoding="utf-8").rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(group) == pid and state != "Z":
            return False
    return True


def test_a_job_keeps_streams_command_and_exit_code(shell: LocalShell) -> None:
    (shell.home / FOLDER / "in.txt").write_text("data", encoding="utf-8")
    one = replace(job("sh", "-c", "cat; echo note >&2; exit 7"), stdin="in.txt", stdout="out.txt")
    assert jobs.run(shell, one) == 7
    assert (shell.home / FOLDER / "out.txt").read_text(encoding="utf-8") == "data"
    assert (shell.home / FOLDER / "job.log").read_text(encoding="utf-8") == "note\n"
    assert jobs.begin_wait(shell, one, 1).end(30) == 7


def test_start_returns_when_the_log_says_ready(shell: LocalShell) -> None:
    one = replace(job("sh", "-c", "sleep 0.2; echo now listening on x >&2; sleep 60"), ready="log:listening on")
    jobs.start(shell, one)
    assert "listening on" in (shell.home / FOLDER / "job.log").read_text(encoding="utf-8")
    assert jobs.stop(shell, one, signal="TERM") == 128 + signal.SIGTERM


@pytest.mark.parametrize("protocol", Protocol)
def test_start_returns_when_the_port_is_bound(shell: LocalShell, protocol: Protocol) -> None:
    port = free_port()
    udp = ("-u",) if protocol is Protocol.UDP else ()
    one = replace(job("nc.traditional", *udp, "-l", "-p", str(port)), ready=jobs.bound(protocol, port))
    jobs.start(shell, one)
    table = Path(f"/proc/net/{protocol}").read_text(encoding="ascii")
    assert f":{port:04X} " in table
    jobs.stop(shell, one, signal="TERM")


def test_a_job_that_ends_before_it_is_ready_is_an_error_with_its_log(shell: LocalShell) -> None:
    one = replace(job("sh", "-c", "echo no such device >&2; exit 1"), ready="log:listening on")
    with pytest.raises(RobotError, match="no such device"):
        jobs.start(shell, one)


def test_sigint_reaches_the_command_although_it_runs_detached(shell: LocalShell) -> None:
    # A program started with & from a script would ignore SIGINT (field notes); rosbag needs it to close its bag.
    script = "trap 'echo closed; exit 5' INT; echo up; while :; do sleep 0.05; done"
    one = replace(job("sh", "-c", script), ready="log:up")
    jobs.start(shell, one)
    assert jobs.stop(shell, one, signal="INT") == 5
    assert "closed" in (shell.home / FOLDER / "job.log").read_text(encoding="utf-8")


def test_a_job_that_ignores_its_signal_is_killed_with_its_children(shell: LocalShell) -> None:
    script = "trap '' INT TERM; sleep 300 & echo up; while :; do sleep 0.05; done"
    one = replace(job("sh", "-c", script), ready="log:up")
    jobs.start(shell, one)
    pid = leader(shell)
    assert jobs.stop(shell, one, signal="INT", grace_s=1) == jobs.KILLED
    wait_until(lambda: group_is_gone(pid), Deadline.after(5))


def test_what_a_command_leaves_behind_ends_with_it(shell: LocalShell) -> None:
    one = job("sh", "-c", "sleep 300 & exit 0")
    assert jobs.run(shell, one) == 0
    pid = leader(shell)
    wait_until(lambda: group_is_gone(pid), Deadline.after(5))


def test_the_robot_itself_ends_a_job_at_its_limit(shell: LocalShell) -> None:
    one = job("sh", "-c", "trap 'exit 9' INT; while :; do sleep 0.02; done", limit_s=0.3)
    assert jobs.run(shell, one) == 9


def test_a_begun_job_tells_its_end_only_when_it_is_asked(shell: LocalShell) -> None:
    pending = jobs.begin(shell, job("sh", "-c", "exit 3"))
    ended = shell.home / FOLDER / ".jobs" / "job" / "exit"
    wait_until(lambda: ended.exists() and ended.read_text(encoding="ascii") == "3\n", Deadline.after(10))
    assert isinstance(pending.session, LocalSession)
    with pytest.raises(subprocess.TimeoutExpired):
        pending.session.process.wait(0.2)
    assert pending.end(10) == 3


def test_wait_gives_up_after_its_time(shell: LocalShell) -> None:
    one = job("sleep", "60")
    jobs.start(shell, one)
    assert jobs.begin_wait(shell, one, 1).end(30) == jobs.STILL_RUNNING
    jobs.stop(shell, one, signal="TERM")


def test_wait_ends_when_a_job_is_killed_from_outside(shell: LocalShell) -> None:
    one = job("sleep", "60")
    jobs.start(shell, one)
    killer = threading.Timer(0.2, lambda: os.killpg(leader(shell), signal.SIGKILL))
    killer.start()
    assert jobs.begin_wait(shell, one, 20).end(30) == jobs.KILLED
    killer.join()


def test_an_ended_job_is_left_alone_by_stop(shell: LocalShell) -> None:
    one = job("true")
    assert jobs.run(shell, one) == 0
    assert jobs.stop(shell, one) == 0


def test_a_recycled_pid_is_not_signalled(shell: LocalShell) -> None:
    """A job is ended by identity: pid, start time and boot, never by number alone."""
    one = job("sleep", "60")
    jobs.start(shell, one)
    with subprocess.Popen(("sleep", "60"), start_new_session=True) as stranger:
        record = shell.home / FOLDER / ".jobs" / "job" / "pid"
        true_record = record.read_text(encoding="ascii")
        _, ticks, boot = true_record.split()
        record.write_text(f"{stranger.pid} {int(ticks) - 1} {boot}\n", encoding="ascii")
        assert jobs.stop(shell, one, signal="KILL") == jobs.KILLED
        assert stranger.poll() is None
        stranger.kill()
        record.write_text(true_record, encoding="ascii")
    jobs.stop(shell, one, signal="TERM")


def test_a_job_name_is_used_once(shell: LocalShell) -> None:
    assert jobs.run(shell, job("true")) == 0
    with pytest.raises(RobotError, match="started before"):
        jobs.run(shell, job("true"))


def test_an_unknown_job_is_an_error(shell: LocalShell) -> None:
    with pytest.raises(RobotError, match="no job in"):
        jobs.stop(shell, job("true", name="never"))


def test_jobs_left_over_are_listed_and_ended(shell: LocalShell) -> None:
    jobs.start(shell, job("sleep", "60"))
    (line,) = jobs.left(shell, Deadline.after(10))
    assert line.endswith("sleep 60")
    evidence.end_jobs(shell, FOLDER)
    assert jobs.left(shell, Deadline.after(10)) == ()


def test_stop_waits_until_a_file_has_stopped_growing(shell: LocalShell) -> None:
    script = "echo up; i=0; while [ $i -lt 20 ]; do echo $i >>out; i=$((i + 1)); sleep 0.01; done; sleep 60"
    one = replace(job("sh", "-c", script), ready="log:up")
    jobs.start(shell, one)
    jobs.stop(shell, one, signal="TERM", settle="out")
    assert (shell.home / FOLDER / "out").read_text(encoding="ascii").split()[-1] == "19"


def test_a_folder_is_fetched_whole_with_the_hosts_state_before_and_after(shell: LocalShell, tmp_path: Path) -> None:
    jobs.run(shell, replace(job("printf", "abc"), stdout="scan.bag"))
    into = tmp_path / "local"
    into.mkdir()
    evidence.fetch(shell, FOLDER, "sender", "lo", into)
    assert sorted(path.name for path in into.iterdir()) == [
        "job.log",
        "scan.bag",
        "sender-after.txt",
        "sender-before.txt",
    ]
    assert (into / "scan.bag").read_bytes() == b"abc"
    assert "==> /proc/net/snmp <==\n" in (into / "sender-before.txt").read_text(encoding="utf-8")


class Liar(LocalShell):
    """A robot that sends whatever archive it likes."""

    def __init__(self, home: Path, members: dict[str, bytes], *, link: str = "") -> None:
        super().__init__(home)
        self.archive = home / "lie.tar"
        with tarfile.open(self.archive, "w") as tar:
            for name, content in members.items():
                path = home / "member"
                path.write_bytes(content)
                tar.add(path, arcname=name)
            if link:
                (home / "link").symlink_to("/etc/passwd")
                tar.add(home / "link", arcname=link)

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        to.write_bytes(self.archive.read_bytes())
        return Completed(tuple(argv), 0, b"", b"")


EMPTY_SUM = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


@pytest.mark.parametrize(
    ("members", "link", "said"),
    [
        ({"../evil": b""}, "", "no plain file"),
        ({"/etc/evil": b""}, "", "no plain file"),
        ({".hidden": b""}, "", "no plain file"),
        ({"a\nb": b""}, "", "no plain file"),
        ({"a/b": b""}, "", "no plain file"),
        ({}, "scan.bag", "no plain file"),
        ({"scan.bag": b""}, "", "hash differs"),
        ({"scan.bag": b"x", ".sums": f"{EMPTY_SUM}  scan.bag\n".encode()}, "", "hash differs"),
        ({".sums": f"{EMPTY_SUM}  scan.bag\n".encode()}, "", "hash differs or file missing: scan.bag"),
        ({}, "", "file missing"),
    ],
)
def test_what_a_robot_sends_cannot_leave_the_folder_or_pass_unchecked(
    tmp_path: Path, members: dict[str, bytes], link: str, said: str
) -> None:
    home, into = tmp_path / "home", tmp_path / "into"
    home.mkdir()
    into.mkdir()
    with pytest.raises(EvidenceError, match=said):
        evidence.fetch(Liar(home, members, link=link), FOLDER, "sender", "lo", into)
    assert {path.name for path in tmp_path.iterdir()} == {"home", "into"}
    assert not list(into.glob(".*"))


def test_an_archive_cut_short_is_refused(tmp_path: Path) -> None:
    liar = Liar(tmp_path, {"scan.bag": b"x" * 5000})
    liar.archive.write_bytes(liar.archive.read_bytes()[:2000])
    with pytest.raises(EvidenceError):
        evidence.fetch(liar, FOLDER, "sender", "lo", tmp_path)


def test_the_script_is_installed_under_the_hash_of_its_content(shell: LocalShell) -> None:
    before = time.time_ns()
    jobs.install(shell, Deadline.after(10))
    path = shell.home / jobs.SCRIPT_PATH
    assert path.read_bytes() == jobs._SCRIPT
    assert path.stat().st_mtime_ns >= before - 60 * 10**9
