"""Locks on robots: only one trial uses a robot at a time.

A lock contains its holder. It is released at the end of the trial, or expires.
"""

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
from fieldkit.core.threads import run_parallel
from fieldkit.remote import jobs
from fieldkit.remote.jobs import REPLY_S, AbortResult
from fieldkit.remote.script import call, word
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Shells

TTL_S: Final = 3600
"""Lifetime of a lock that is not renewed. `evidence.begin` renews it after half of this time. The lifetime is longer
than an attempt, and longer than it takes to carry robots to another place."""

_LOCK_STATE: Final = re.compile(rb"(?P<token>\S+) (?P<remaining_s>[0-9]{1,11}) (?P<user>\S+) (?P<purpose>\S+)\n")


@dataclass(frozen=True)
class Holder:
    """Holder of a lock on robots. At most 80 letters, digits and characters of `._@-` of each text are used.

    Attributes:
        token: ID of the run of fieldkit (`Plan.session`). A holder with the same token can lock its robots again.
        user: `user@laptop`, see `runtime.user_at_host`.
        purpose: Purpose of the lock, for example the name of the trial.
    """

    token: str
    user: str
    purpose: str


@contextmanager
def locked_exclusively(shells: Shells, holder: Holder, *, sink: Sink) -> Iterator[None]:
    """Lock all robots while the body runs. Only one process on this machine can use the holder's token at a time.

    Raises:
        ConfigurationError: Another process uses the token. It would use the same locks and release them.
        FieldkitError: For the same reasons as `locked`.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(runtime.hold_lock(f"trial-{word(holder.token)}"))
        except NameHeldError as error:
            raise ConfigurationError(
                "another fieldkit process runs this trial, or another trial of its session",
                where=holder.purpose,
                remedy="wait until it has ended, or stop it",
            ) from error
        stack.enter_context(locked(shells, holder, sink=sink))
        yield


@contextmanager
def locked(shells: Shells, holder: Holder, *, sink: Sink, ttl_s: int = TTL_S) -> Iterator[None]:
    """Lock all robots, and unlock them after the body. If a robot cannot be locked, the others are unlocked again.

    Robots are contacted in parallel, but locked in the order of their names. If two trials need the same robots, one
    of them therefore locks all robots. After Ctrl-C, the program does not wait for robots that cannot be reached.

    Args:
        shells: The robots.
        holder: The holder of the locks.
        sink: Receives a note for each robot that could not be unlocked. Its lock expires.
        ttl_s: Lifetime of a lock that is not renewed, in seconds.

    Raises:
        LinkError: A robot did not answer.
        RobotError: Another holder has locked a robot. The message contains the holder, start and end of the lock,
            and a remedy.
    """
    contacted: list[Shell] = []
    sorted_shells = sorted(shells.values(), key=lambda shell: shell.robot)
    run_parallel(
        lambda shell: jobs.install(shell, Deadline.after(REPLY_S)),
        sorted_shells,
        on_interrupt=lambda: _close_all(sorted_shells),
    )
    try:
        for shell in sorted_shells:
            contacted.append(shell)  # before the request, because its answer may be lost
            words = (word(holder.token), str(ttl_s), word(holder.user), word(holder.purpose))
            call(shell, "lock", *words, deadline=Deadline.after(REPLY_S))
        yield
    except BaseException as error:
        if not isinstance(error, Exception):
            _close_all(contacted)
        raise
    finally:
        if contacted:
            run_parallel(lambda shell: _unlock(shell, holder, sink), contacted)


@dataclass(frozen=True)
class LockState:
    """A valid lock.

    Attributes:
        holder: Holder of the lock.
        remaining_s: Time in seconds until the lock expires.
    """

    holder: Holder
    remaining_s: float


def read_lock(shell: Shell) -> LockState | None:
    """Return the lock of a robot on which the job script is installed, or None if the robot is not locked.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The robot could not read its lock.
    """
    match = _LOCK_STATE.match(call(shell, "holder", deadline=Deadline.after(REPLY_S)))
    if match is None:
        return None
    token, user, purpose = (word(match[name].decode(errors="replace")) for name in ("token", "user", "purpose"))
    return LockState(Holder(token, user, purpose), float(match["remaining_s"]))


def require_lock(shell: Shell, token: str) -> None:
    """Check that this trial still holds the lock of a robot on which the job script is installed.

    Raises:
        LinkError: The robot did not answer.
        LockLostError: The trial was aborted, or the lock expired and another holder locked the robot.
        RobotError: The robot could not read its lock.
    """
    # `renew` fails if the lock was lost. 0 is the time in seconds for which the lock must last at least.
    call(shell, "renew", word(token), "0", deadline=Deadline.after(REPLY_S))


def _close_all(shells: Iterable[Shell]) -> None:
    for shell in shells:
        shell.close()


def _unlock(shell: Shell, holder: Holder, sink: Sink) -> None:
    try:
        call(shell, "unlock", word(holder.token), deadline=Deadline.after(REPLY_S))
    except FieldkitError as error:
        sink(Note(f"{shell.robot} stays locked until its lock expires: {error.what}"))


def abort(robots: Mapping[str, Shell | FieldkitError], user: str) -> Mapping[str, AbortResult]:
    """Remove the lock of every robot and stop all of its jobs, of any trial; return the result for each robot.

    Args:
        robots: The robots, from `Backend.persistent_shells`.
        user: Name that is shown to the users whose trials are aborted, see `runtime.user_at_host`.
    """
    return dict(zip(robots, run_parallel(lambda name: _abort(robots[name], user), robots), strict=True))


def _abort(robot: Shell | FieldkitError, user: str) -> AbortResult:
    if isinstance(robot, FieldkitError):
        return AbortResult(error=robot)
    try:
        return jobs.abort(robot, word(user), Deadline.after(4 * REPLY_S))
    except FieldkitError as error:
        return AbortResult(error=error)
