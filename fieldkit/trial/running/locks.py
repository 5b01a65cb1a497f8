"""Locks on robots: one trial at a time, told to everyone else, given back at its end or by their expiry."""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final

from fieldkit.core import runtime
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Note, Sink
from fieldkit.core.runtime import NameHeldError
from fieldkit.core.threads import together
from fieldkit.remote import jobs
from fieldkit.remote.jobs import REPLY_S, Aborted
from fieldkit.remote.script import call, word
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Shells

TTL_S: Final = 3600
"""How long a lock lasts that nobody renews; `evidence.begin` does at half of it. Longer than any attempt or walk."""

_HELD: Final = re.compile(rb"(?P<token>\S+) (?P<left>[0-9]{1,11}) (?P<who>\S+) (?P<what>\S+)\n")


@dataclass(frozen=True)
class Holder:
    """Holder of robots, and its purpose; letters, digits and `._@-` of each are kept, at most 80.

    Attributes:
        token: Tells this trial from any other; the same token takes its own lock again.
        who: `user@laptop`, see `runtime.me`.
        what: The trial.
    """

    token: str
    who: str
    what: str


@contextmanager
def held(shells: Shells, holder: Holder, *, sink: Sink) -> Iterator[None]:
    """Hold every robot, or none, while the body runs, as the only fieldkit of this machine with the holder's token.

    Raises:
        ConfigurationError: Another one has the token: it would take the robots for its own, and so give them back.
        FieldkitError: As `taken`.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(runtime.held(f"trial-{word(holder.token)}"))
        except NameHeldError as error:
            raise ConfigurationError(
                "another fieldkit runs this trial, or one that was begun with it",
                where=holder.what,
                remedy="wait until it has ended, or end it",
            ) from error
        stack.enter_context(taken(shells, holder, sink=sink))
        yield


@contextmanager
def taken(shells: Shells, holder: Holder, *, sink: Sink, ttl_s: int = TTL_S) -> Iterator[None]:
    """Take every robot, or none, and give them back after the body.

    Robots are reached side by side, and taken in the order of their names, so that of two trials which want the same
    one gets them. After Ctrl-C no link that was lost is awaited any more.

    Args:
        shells: The robots.
        holder: Who takes them.
        sink: Told of a robot that could not be given back; its lock expires by itself.
        ttl_s: Seconds until a lock expires that is not renewed.

    Raises:
        LinkError: A robot did not answer.
        RobotError: Somebody else holds one; says who, since when, until when, and what to do.
    """
    touched: list[Shell] = []
    in_order = sorted(shells.values(), key=lambda one: one.robot)
    together(lambda shell: jobs.install(shell, Deadline.after(REPLY_S)), in_order, hang_up=lambda: _hang_up(in_order))
    try:
        for shell in in_order:
            touched.append(shell)  # before it answers: the answer may be lost where the lock was taken
            words = (word(holder.token), str(ttl_s), word(holder.who), word(holder.what))
            call(shell, "lock", *words, deadline=Deadline.after(REPLY_S))
        yield
    except BaseException as error:
        if not isinstance(error, Exception):
            _hang_up(touched)
        raise
    finally:
        if touched:
            together(lambda shell: _give_back(shell, holder, sink), touched)


@dataclass(frozen=True)
class Held:
    """A lock that holds.

    Attributes:
        holder: Who has the robot.
        left_s: Seconds until the lock expires.
    """

    holder: Holder
    left_s: float


def holder(shell: Shell) -> Held | None:
    """Return who holds a robot that has the job script, None if nobody does.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The robot could not tell.
    """
    said = _HELD.match(call(shell, "holder", deadline=Deadline.after(REPLY_S)))
    if said is None:
        return None
    token, who, what = (word(said[name].decode(errors="replace")) for name in ("token", "who", "what"))
    return Held(Holder(token, who, what), float(said["left"]))


def demand(shell: Shell, token: str) -> None:
    """Go on only if a robot that has the job script is still held by us.

    Raises:
        LinkError: The robot did not answer.
        LockLostError: Somebody aborted the trial, or took the robot when its lock had expired.
        RobotError: The robot could not tell.
    """
    call(shell, "renew", word(token), "0", deadline=Deadline.after(REPLY_S))


def _hang_up(shells: Iterable[Shell]) -> None:
    for shell in shells:
        shell.close()


def _give_back(shell: Shell, holder: Holder, sink: Sink) -> None:
    try:
        call(shell, "unlock", word(holder.token), deadline=Deadline.after(REPLY_S))
    except FieldkitError as error:
        sink(Note(f"{shell.robot} stays locked until its lock expires: {error.what}"))


def abort(robots: Mapping[str, Shell | FieldkitError], who: str) -> Mapping[str, Aborted]:
    """Break the lock of every robot and end every job on it, of any trial; return what became of each.

    Args:
        robots: From `Backend.standing`.
        who: Told to those whose trial ends, see `runtime.me`.
    """
    return dict(zip(robots, together(lambda name: _abort(robots[name], who), robots), strict=True))


def _abort(robot: Shell | FieldkitError, who: str) -> Aborted:
    if isinstance(robot, FieldkitError):
        return Aborted(error=robot)
    try:
        return jobs.abort(robot, word(who), Deadline.after(4 * REPLY_S))
    except FieldkitError as error:
        return Aborted(error=error)
