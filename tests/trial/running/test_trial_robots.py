"""Parallel operations on robots: fetching evidence, lost links, reboots, and Ctrl-C."""

import os
import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.core.model import Role
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.shell import Completed
from fieldkit.trial import hosts
from fieldkit.trial.running.robots import Robots
from tests.helpers.casts import plain_plan
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import LocalShell


class SlowRobot(LocalShell):
    """A robot whose evidence is only fetched completely when its connection is closed."""

    def __init__(self, home: Path, fetching: Callable[[], None]) -> None:
        super().__init__(home)
        self.fetching = fetching
        self.is_closed = threading.Event()

    def fetch(self, argv: object, to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        to.write_bytes(b"the beginning of a tar")
        self.fetching()
        assert self.is_closed.wait(deadline.remaining_s)
        return Completed((), 0, b"", b"")

    def close(self) -> None:
        self.is_closed.set()


def slow_testbed(home: Path) -> IdleTestbed:
    """Return a testbed of slow robots; the operator presses Ctrl-C while both are sending evidence."""
    barrier = threading.Barrier(2, action=lambda: os.kill(os.getpid(), signal.SIGINT))
    return IdleTestbed(
        {role: SlowRobot(home, lambda: (barrier.wait(60), None)[1]) for role in (Role.SENDER, Role.RECEIVER)}
    )


def test_ctrl_c_closes_connections_and_waits_for_writers_of_evidence(tmp_path: Path) -> None:
    destination = tmp_path / "into"
    destination.mkdir()
    robots = Robots(plain_plan(), slow_testbed(tmp_path))
    threads_before = set(threading.enumerate())
    with pytest.raises(KeyboardInterrupt):
        robots.fetch("x", destination, ended_normally=True)
    robots.close_connections()
    stored_folder = destination.rename(tmp_path / "kept")
    wait_until(lambda: threads_before.issuperset(threading.enumerate()), Deadline.after(60))
    assert list(stored_folder.iterdir()) == [], "partially fetched files are removed before the attempt is stored"
    assert not destination.exists()


class UnreachableRobot(LocalShell):
    """A robot whose link always fails while it sends evidence."""

    def fetch(self, argv: object, to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        raise LinkError("the connection broke", where="turtlebot-1")


@pytest.mark.emulated
def test_evidence_that_cannot_be_fetched_is_not_deleted_from_the_robot(tmp_path: Path) -> None:
    plan, shells = plain_plan(), {}
    attempts = {name: jobs.work_folder(plan.trial, name) for name in ("udp-01-1", "udp-01-2")}
    for role, kind in ((Role.SENDER, UnreachableRobot), (Role.RECEIVER, LocalShell)):
        (home := tmp_path / role).mkdir()
        shells[role] = kind(home)
        jobs.install(shells[role], Deadline.after(60))
        for remote in attempts.values():
            evidence.begin(shells[role], remote, role, "lo", required_kib=0)
    robots = Robots(plan, IdleTestbed(shells))
    destination = tmp_path / "into"
    destination.mkdir()
    assert robots.fetch(attempts["udp-01-1"], destination, ended_normally=True) == [
        "turtlebot-1: the connection broke"
    ]
    assert {path.name for path in destination.iterdir()} == {
        "receiver-before.txt",
        "receiver-after.txt",
        "receiver-sources-before.txt",
        "receiver-sources-after.txt",
        "sender-unfetched.txt",
    }
    assert robots.unfetched.by_robot() == {"turtlebot-1": [attempts["udp-01-1"]]}
    robots.delete_remote(attempts["udp-01-1"])
    robots.delete_remote()
    remaining = {role: sorted(path.name for path in (tmp_path / role / ".fieldkit").glob("*/*")) for role in shells}
    assert remaining == {Role.SENDER: ["udp-01-1"], Role.RECEIVER: []}


class RebootedRobot(LocalShell):
    """A robot that lost power after the start of an attempt, and with it all data of the attempt."""

    boots = 0

    def run(self, argv: Sequence[str], *, deadline: Deadline, check: bool = True, stdin: bytes = b"") -> Completed:
        if "begin" in argv or "boot_id" in argv[-1]:
            self.boots += 1
            return Completed(tuple(argv), 0, f"boot-{self.boots}\n".encode(), b"")
        return Completed(tuple(argv), 125, b"", b"job.sh: no folder x\n")

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        raise RobotError("no job in .jobs/capture", where="turtlebot-1")


def test_a_void_attempt_reports_that_its_robot_rebooted(tmp_path: Path) -> None:
    robots = Robots(
        plain_plan(), IdleTestbed({role: RebootedRobot(tmp_path) for role in (Role.SENDER, Role.RECEIVER)})
    )
    robots.begin("x", old=None)
    output_text = robots.fetch("x", tmp_path, ended_normally=False)
    reasons = [f"{name}: the robot rebooted during the repeat" for name in ("turtlebot-2", "turtlebot-1")]
    assert sorted(output_text) == sorted(reasons)
    remaining_reasons = hosts.drop_effects_of_reboots(
        ["turtlebot-1: no job in .jobs/capture", "scan.bag: there is no bag", *output_text]
    )
    assert sorted(remaining_reasons) == sorted(["scan.bag: there is no bag", *reasons])


class InterruptedRobot(LocalShell):
    """A robot whose connection is closed after the first segment of a large file."""

    def __init__(self, home: Path) -> None:
        super().__init__(home)
        self.on_command: Callable[[], None] = lambda: None
        self.pieces = 0

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        completed = super().fetch(argv, to, deadline=deadline, limit_bytes=limit_bytes)
        if argv[2] == "piece":
            self.pieces += 1
            self.on_command()
        return completed


@pytest.mark.emulated
def test_no_segment_is_requested_after_the_connection_was_closed(tmp_path: Path) -> None:
    plan = plain_plan()
    remote, shells = jobs.work_folder(plan.trial, "udp-01-1"), {}
    for role in (Role.SENDER, Role.RECEIVER):
        (home := tmp_path / role).mkdir()
        shells[role] = InterruptedRobot(home)
        jobs.install(shells[role], Deadline.after(60))
        evidence.begin(shells[role], remote, role, "lo", required_kib=0)
    (tmp_path / Role.SENDER / remote / "scan.bag").write_bytes(bytes(3 * fetching.PIECE_BYTES))
    robots = Robots(plan, IdleTestbed(shells))
    shells[Role.SENDER].on_command = robots.close_connections
    destination = tmp_path / "into"
    destination.mkdir()
    assert robots.fetch(remote, destination, ended_normally=True) == ["the fetch was cancelled"]
    assert shells[Role.SENDER].pieces == 1
    shells[Role.SENDER].on_command = lambda: None
    for path in destination.glob("*.txt"):
        path.unlink()
    assert robots.fetch(remote, destination, ended_normally=True) == []
    assert shells[Role.SENDER].pieces == 3, "fetching resumes at the same segment"


@pytest.mark.emulated
def test_completely_fetched_evidence_is_deleted_even_if_a_job_failed(tmp_path: Path) -> None:
    plan = plain_plan()
    remote, shells = jobs.work_folder(plan.trial, "udp-01-1"), {}
    for role in (Role.SENDER, Role.RECEIVER):
        (home := tmp_path / role).mkdir()
        shells[role] = LocalShell(home)
        jobs.install(shells[role], Deadline.after(60))
        evidence.begin(shells[role], remote, role, "lo", required_kib=0)
    job = tmp_path / Role.SENDER / remote / ".jobs" / "capture"
    job.mkdir()
    for name, text in {"leaves": "", "pid": "1 1 x", "exit": "3"}.items():
        (job / name).write_text(f"{text}\n", encoding="ascii")
    robots = Robots(plan, IdleTestbed(shells))
    destination = tmp_path / "into"
    destination.mkdir()
    (output_text,) = robots.fetch(remote, destination, ended_normally=True)
    assert output_text.endswith("job capture ended with exit code 3")
    assert "exit code 1" not in output_text, "the message is from the robot"
    assert robots.unfetched.by_robot() == {}
