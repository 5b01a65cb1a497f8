"""A repeat's folder on the robot: made before, discarded after; its jobs ended."""

from collections.abc import Collection
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.remote.command import printable
from fieldkit.remote.script import CALL, HOME, REPLY_S, call, demand, word
from fieldkit.remote.shell import Shell

MIN_FREE_KIB: Final = 100 * 1024


def begin_command(
    folder: str,
    role: str,
    interface: str,
    *,
    old: str | None = None,
    token: str | None = None,
    need_kib: int = MIN_FREE_KIB,
) -> tuple[str, ...]:
    """Return the command that makes `folder` with the host's state in it; see `begin`."""
    lock = "-" if token is None else word(token)
    return (*CALL, "begin", folder, role, interface, str(need_kib), lock, *([old] if old else []))


def begin(
    shell: Shell,
    folder: str,
    role: str,
    interface: str,
    *,
    old: str | None = None,
    token: str | None = None,
    need_kib: int = MIN_FREE_KIB,
) -> str:
    """Make the attempt's folder with the host's state in it; repeated, it changes nothing.

    Args:
        shell: The robot.
        folder: From `jobs.work_folder`.
        role: Names the state's files.
        interface: The radio's.
        old: A folder to remove.
        token: The trial's lock, which is renewed.
        need_kib: Free disk that the evidence needs.

    Returns:
        Which boot of the robot it is, as `boot` tells it.

    Raises:
        LinkError: The robot did not answer.
        LockLostError: The lock was broken, or taken over after it had expired.
        RobotError: Its disk has less free than needed, or cannot be written.
    """
    command = begin_command(folder, role, interface, old=old, token=token, need_kib=need_kib)
    done = shell.run(command, deadline=Deadline.after(REPLY_S), check=False)
    demand(shell, done)
    return printable(done.stdout)


def boot(shell: Shell) -> str:
    """Return which boot of the robot it is, by the kernel's identification of it.

    Raises:
        LinkError: The robot did not answer.
        RobotError: It does not say.
    """
    done = shell.run(("cat", "/proc/sys/kernel/random/boot_id"), deadline=Deadline.after(REPLY_S))
    return printable(done.stdout)


def end_jobs(shell: Shell, folder: str) -> None:
    """End every job of the attempt that still runs; none starts there afterwards. Errors as `begin`."""
    call(shell, "end", folder, deadline=Deadline.after(2 * REPLY_S))


def end_all(shell: Shell, trial: str) -> None:
    """End every job of `trial` that still runs; errors as `begin`."""
    call(shell, "halt", f"{HOME}/{trial}", deadline=Deadline.after(2 * REPLY_S))


def discard_attempt(shell: Shell, folder: str) -> None:
    """Remove an attempt's folder from the robot; errors as `begin`."""
    call(shell, "drop", folder, deadline=Deadline.after(REPLY_S))


def discard(shell: Shell, trial: str, *, but: Collection[str] = ()) -> None:
    """Remove everything of `trial` from the robot but for these attempts' folders; errors as `begin`."""
    if but:
        kept = (folder.rpartition("/")[2] for folder in but)
        call(shell, "tidy", f"{HOME}/{trial}", *kept, deadline=Deadline.after(REPLY_S))
    else:
        call(shell, "drop", f"{HOME}/{trial}", deadline=Deadline.after(REPLY_S))
