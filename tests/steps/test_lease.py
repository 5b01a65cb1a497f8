"""A lease: what is written on the robot, how often, and what becomes of it where the link is cut."""

from collections.abc import Sequence
from threading import Event
from typing import cast

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, LockLostError, RobotError
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Completed, Shell
from fieldkit.steps.lease import LeaseKeeper, orders_file

JOB = Job(folder="f", name="up.fly", argv=(), limit_s=1.0, log="up.fly.log")
SOON_S = 0.05


class Link:
    """A shell that notes each line that is written, and is broken for a while."""

    robot = "r"

    def __init__(self) -> None:
        self.words: list[Sequence[str]] = []
        self.broken = 0
        self.many = Event()

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        self.words.append(argv)
        if len(self.words) >= 5:
            self.many.set()
        if self.broken > 0:
            self.broken -= 1
            raise LinkError("is out of range", where=self.robot, remedy="wait")
        return Completed(tuple(argv), 0, b"said", b"")

    @property
    def lines(self) -> list[str]:
        return [words[-2] for words in self.words]


def held(link: Link, unheard_s: float | None = None) -> LeaseKeeper:
    shell = cast("Shell", link)
    return LeaseKeeper(shell, JOB, says="log", order="stay", lease_s=SOON_S, renewals=2, unheard_s=unheard_s)


def test_an_order_is_renewed_over_a_link_that_breaks_until_the_context_is_left() -> None:
    link = Link()
    with held(link) as lease:
        assert lease.said == b"said"
        link.broken = 2
        assert link.many.wait(60)
        lease.order("go")
    count = len(link.lines)
    numbers, orders, seconds = zip(*(line.split() for line in link.lines), strict=True)
    assert sorted(map(int, numbers)) == list(range(1, count + 1))
    assert orders[:5] == ("stay",) * 5
    assert orders[-1] == "go"
    assert set(seconds) == {"0.05"}
    assert {tuple(words[-3::2]) for words in link.words} == {("f/up.fly.orders", "f/log")}
    assert orders_file("up.fly") == "up.fly.orders"


def test_where_nothing_may_be_sent_an_order_holds_longer_and_is_not_renewed() -> None:
    link = Link()
    with held(link, unheard_s=90.0) as lease:
        lease.order("go")
        assert not any(thread_renews(lease))
    assert link.lines == ["1 stay 90", "2 go 90"]


def thread_renews(lease: LeaseKeeper) -> list[bool]:
    lease._thread.join(60)
    return [lease._thread.is_alive()]


def test_an_order_that_is_not_taken_is_an_error() -> None:
    link = Link()
    with held(link, unheard_s=90.0) as lease:
        link.broken = 1
        with pytest.raises(LinkError):
            lease.order("go")
        lease.look()
    assert link.lines[-1] == "3 go 90"


def test_who_cannot_be_reached_at_first_is_an_error() -> None:
    link = Link()
    link.broken = 1
    with pytest.raises(LinkError), held(link):
        pytest.fail("nobody has a lease")


class Ending(Link):
    """A shell whose program has ended when it is looked at for the third time."""

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        done = super().run(argv, deadline=deadline)
        said = b"bash: warning: no locale\n7\n" if len(self.words) > 2 else b"bash: warning: no locale\n"
        return Completed(done.argv, 0, done.stdout, said)


def test_a_body_ends_with_the_program_and_says_why() -> None:
    ended = Event()

    def wait() -> None:
        assert ended.wait(60)
        raise LinkError("it broke off", where="r", remedy="wait")

    with held(Ending()) as lease:
        assert lease.over == ""
        with pytest.raises(RobotError, match="ended with exit code 7") as caught, lease.outlasting(ended.set):
            wait()
        assert "it broke off" in str(caught.value.__cause__)
        with pytest.raises(RobotError, match="ended with exit code 7"), lease.outlasting(ended.set):
            pass
        with pytest.raises(LockLostError), lease.outlasting(ended.set):
            raise LockLostError("aborted", where="r", remedy="ask")


def test_a_body_that_fails_by_itself_says_why_itself() -> None:
    with held(Link()) as lease, pytest.raises(LinkError), lease.outlasting(pytest.fail):
        raise LinkError("it broke off", where="r", remedy="wait")
