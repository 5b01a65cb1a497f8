"""A lease: orders on the robot, their renewals, and errors of the link and the program."""

from collections.abc import Sequence
from threading import Event
from typing import cast

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, LockLostError, RobotError
from fieldkit.motion.steps.lease import LeaseKeeper, orders_file
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Completed, Shell

JOB = Job(folder="f", name="up.fly", argv=(), limit_s=1.0, log="up.fly.log")
SHORT_S = 0.05


class RecordingShell:
    """A shell that records each written line, and fails for a number of calls."""

    robot = "r"

    def __init__(self) -> None:
        self.commands: list[Sequence[str]] = []
        self.failures_left = 0
        self.has_many_calls = Event()

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        self.commands.append(argv)
        if len(self.commands) >= 5:
            self.has_many_calls.set()
        if self.failures_left > 0:
            self.failures_left -= 1
            raise LinkError("is out of range", where=self.robot, remedy="wait")
        return Completed(tuple(argv), 0, b"output", b"")

    @property
    def lines(self) -> list[str]:
        return [command[-2] for command in self.commands]


def keeper(shell: RecordingShell, silent_lease_s: float | None = None) -> LeaseKeeper:
    return LeaseKeeper(
        cast("Shell", shell),
        JOB,
        output_file="log",
        order="stay",
        lease_s=SHORT_S,
        renewals=2,
        silent_lease_s=silent_lease_s,
    )


def test_order_is_renewed_over_interrupted_link_until_context_is_left() -> None:
    shell = RecordingShell()
    with keeper(shell) as lease:
        assert lease.output == b"output"
        shell.failures_left = 2
        assert shell.has_many_calls.wait(60)
        lease.give_order("go")
    count = len(shell.lines)
    numbers, orders, seconds = zip(*(line.split() for line in shell.lines), strict=True)
    assert sorted(map(int, numbers)) == list(range(1, count + 1))
    assert orders[:5] == ("stay",) * 5
    assert orders[-1] == "go"
    assert set(seconds) == {"0.05"}
    assert {tuple(command[-3::2]) for command in shell.commands} == {("f/up.fly.orders", "f/log")}
    assert orders_file("up.fly") == "up.fly.orders"


def test_silent_lease_lasts_longer_and_is_not_renewed() -> None:
    shell = RecordingShell()
    with keeper(shell, silent_lease_s=90.0) as lease:
        lease.give_order("go")
        assert not any(renewal_threads(lease))
    assert shell.lines == ["1 stay 90", "2 go 90"]


def renewal_threads(lease: LeaseKeeper) -> list[bool]:
    """Return a list that is True for a thread of renewals that is alive."""
    lease._thread.join(60)
    return [lease._thread.is_alive()]


def test_order_that_cannot_be_written_is_an_error() -> None:
    shell = RecordingShell()
    with keeper(shell, silent_lease_s=90.0) as lease:
        shell.failures_left = 1
        with pytest.raises(LinkError):
            lease.give_order("go")
        lease.renew()
    assert shell.lines[-1] == "3 go 90"


def test_unreachable_robot_at_start_is_an_error() -> None:
    shell = RecordingShell()
    shell.failures_left = 1
    with pytest.raises(LinkError), keeper(shell):
        pytest.fail("the lease was entered")


class ExitedProgram(RecordingShell):
    """A shell whose program has exited at the third query."""

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        result = super().run(argv, deadline=deadline)
        stderr = b"bash: warning: no locale\n7\n" if len(self.commands) > 2 else b"bash: warning: no locale\n"
        return Completed(result.argv, 0, result.stdout, stderr)


def test_body_is_aborted_when_the_program_exits() -> None:
    stop = Event()

    def wait() -> None:
        assert stop.wait(60)
        raise LinkError("the connection broke", where="r", remedy="wait")

    with keeper(ExitedProgram()) as lease:
        assert lease.end_reason == ""
        with (
            pytest.raises(RobotError, match="ended with exit code 7") as error_info,
            lease.run_while_leased(stop.set),
        ):
            wait()
        assert "the connection broke" in str(error_info.value.__cause__)
        with pytest.raises(RobotError, match="ended with exit code 7"), lease.run_while_leased(stop.set):
            pass
        with pytest.raises(LockLostError), lease.run_while_leased(stop.set):
            raise LockLostError("aborted", where="r", remedy="ask")


def test_error_of_body_is_raised_while_program_runs() -> None:
    with keeper(RecordingShell()) as lease, pytest.raises(LinkError), lease.run_while_leased(pytest.fail):
        raise LinkError("the connection broke", where="r", remedy="wait")
