"""Create the folder of an attempt on a robot, stop the jobs of the attempt, and delete the folder."""

from collections.abc import Collection, Sequence
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.remote.command import printable, quote
from fieldkit.remote.script import CALL, HOME, REPLY_S, call, require_success, word
from fieldkit.remote.shell import Shell

MIN_FREE_KIB: Final = 100 * 1024
"""Free disk space that an attempt needs, unless its caller requires another amount."""


def begin_command(
    folder: str,
    role: str,
    interface: str,
    *,
    old_folder: str | None = None,
    token: str | None = None,
    required_kib: int = MIN_FREE_KIB,
    sources: Sequence[Sequence[str]] = (),
) -> tuple[str, ...]:
    """Return the command that creates `folder` and records the state of the host in it; see `begin`."""
    lock = "-" if token is None else word(token)
    # The script reads its arguments by position, so an empty word stands for a missing `old_folder` before sources.
    optional_words = (old_folder or "", *map(quote, sources)) if sources else ((old_folder,) if old_folder else ())
    return (*CALL, "begin", folder, role, interface, str(required_kib), lock, *optional_words)


def begin(
    shell: Shell,
    folder: str,
    role: str,
    interface: str,
    *,
    old_folder: str | None = None,
    token: str | None = None,
    required_kib: int = MIN_FREE_KIB,
    sources: Sequence[Sequence[str]] = (),
) -> str:
    """Create the attempt's folder and record the state of the host in it; idempotent.

    Args:
        shell: The robot.
        folder: The folder, from `jobs.work_folder`.
        role: Role of the robot, the prefix of the files with the state.
        interface: Network interface of the radio.
        old_folder: Folder of an earlier attempt, which is deleted; None to delete nothing.
        token: Token of the trial's lock, which is renewed; None to renew no lock.
        required_kib: Required free disk space in KiB.
        sources: Telemetry sources that the robot queries until its evidence is fetched. Each is a sequence: the name
            of the source, then the arguments of the shell function `poll` (telemetry.sh), starting with ADDRESS.

    Returns:
        The boot ID of the robot, as returned by `boot_id`.

    Raises:
        LinkError: The robot did not answer.
        LockLostError: The lock was broken, or taken over after it had expired.
        RobotError: The robot's disk has too little free space or is not writable.
    """
    command = begin_command(
        folder, role, interface, old_folder=old_folder, token=token, required_kib=required_kib, sources=sources
    )
    result = shell.run(command, deadline=Deadline.after(REPLY_S), check=False)
    require_success(shell, result)
    return printable(result.stdout)


def boot_id(shell: Shell) -> str:
    """Return the boot ID of the robot's kernel.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The boot ID cannot be read.
    """
    result = shell.run(("cat", "/proc/sys/kernel/random/boot_id"), deadline=Deadline.after(REPLY_S))
    return printable(result.stdout)


def end_jobs(shell: Shell, folder: str) -> None:
    """Stop all running jobs of the attempt, and prevent the start of further jobs.

    Raises the same errors as `begin`.
    """
    call(shell, "end", folder, deadline=Deadline.after(2 * REPLY_S))


def end_all(shell: Shell, trial: str) -> None:
    """Stop all running jobs of `trial`. Raises the same errors as `begin`."""
    call(shell, "halt", f"{HOME}/{trial}", deadline=Deadline.after(2 * REPLY_S))


def discard_attempt(shell: Shell, folder: str) -> None:
    """Delete an attempt's folder on the robot. Raises the same errors as `begin`."""
    call(shell, "drop", folder, deadline=Deadline.after(REPLY_S))


def discard(shell: Shell, trial: str, *, kept_folders: Collection[str] = ()) -> None:
    """Delete all files of `trial` on the robot, except `kept_folders` of attempts.

    Raises the same errors as `begin`.
    """
    if kept_folders:
        names = (folder.rpartition("/")[2] for folder in kept_folders)
        call(shell, "tidy", f"{HOME}/{trial}", *names, deadline=Deadline.after(REPLY_S))
    else:
        call(shell, "drop", f"{HOME}/{trial}", deadline=Deadline.after(REPLY_S))
