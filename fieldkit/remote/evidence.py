"""A repeat's folder on the robot: made before, fetched whole and checked by hash after."""

import hashlib
import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.remote import archive
from fieldkit.remote.script import HOME, REPLY_S, SCRIPT_PATH, call, demand, word
from fieldkit.remote.shell import Shell

MAX_BYTES: Final = 1 << 30
MIN_FREE_KIB: Final = 100 * 1024

_FETCH_S: Final = 300.0
_SUMS_CHUNKS: Final = 2
"""Of 64 KiB each: as many as the sums of all files of an archive may take."""

_SUMS: Final = re.compile(r"\.sums-[0-9]{1,10}\Z", re.ASCII)
# Together at most 97 characters, which every tar writes without an extension.
_PART: Final = r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}"
_SAFE_NAME: Final = re.compile(rf"{_PART}(/{_PART})?\Z", re.ASCII)
_SUM_LINE: Final = re.compile(r"([0-9a-f]{64})[ *]{2}(.+)\Z", re.ASCII)


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
    return ("sh", SCRIPT_PATH, "begin", folder, role, interface, str(need_kib), lock, *([old] if old else []))


def pack_command(folder: str, role: str, interface: str) -> tuple[str, ...]:
    """Return the command that notes the host's state again and sends every file of `folder`."""
    return ("sh", SCRIPT_PATH, "pack", folder, role, interface)


def begin(
    shell: Shell,
    folder: str,
    role: str,
    interface: str,
    *,
    old: str | None = None,
    token: str | None = None,
    need_kib: int = MIN_FREE_KIB,
) -> None:
    """Make the attempt's folder with the host's state in it; repeated, it changes nothing.

    Args:
        shell: The robot.
        folder: From `jobs.work_folder`.
        role: Names the state's files.
        interface: The radio's.
        old: A folder to remove.
        token: The trial's lock, which is renewed.
        need_kib: Free disk that the evidence needs.

    Raises:
        LinkError: The robot did not answer.
        LockLostError: The lock was broken, or taken over after it had expired.
        RobotError: Its disk has less free than needed, or cannot be written.
    """
    command = begin_command(folder, role, interface, old=old, token=token, need_kib=need_kib)
    demand(shell, shell.run(command, deadline=Deadline.after(REPLY_S), check=False))


def end_jobs(shell: Shell, folder: str) -> None:
    """End every job of the attempt that still runs; none starts there afterwards. Errors as `begin`."""
    call(shell, "end", folder, deadline=Deadline.after(2 * REPLY_S))


def end_all(shell: Shell, trial: str) -> None:
    """End every job of `trial` that still runs; errors as `begin`."""
    call(shell, "halt", f"{HOME}/{trial}", deadline=Deadline.after(2 * REPLY_S))


def fetch(shell: Shell, folder: str, role: str, interface: str, into: Path) -> None:
    """Let the robot note its state again, copy its files of a repeat into `into` and check each against its hash.

    The robot is not trusted: names are checked against a pattern, only plain files are taken, in one level of folders
    at most, and their number and size are bounded.

    Raises:
        LinkError: The robot did not answer.
        RobotError: It could not pack them, or a job that `jobs.stop` let go did not end well; what came is kept then.
        EvidenceError: What it sent is not whole, not safe, or fails its hash.
    """
    packed = into / f".{role}.tar"
    try:
        command = pack_command(folder, role, interface)
        try:
            shell.fetch(command, packed, deadline=Deadline.after(_FETCH_S), limit_bytes=MAX_BYTES)
        except RobotError:
            with suppress(EvidenceError, FileNotFoundError):  # there may be nothing whole, and the robot says why
                _unpack(packed, into, shell.robot)
            raise
        _unpack(packed, into, shell.robot)
    finally:
        packed.unlink(missing_ok=True)


def discard(shell: Shell, trial: str) -> None:
    """Remove everything of `trial` from the robot; errors as `begin`."""
    call(shell, "drop", f"{HOME}/{trial}", deadline=Deadline.after(REPLY_S))


def _unpack(packed: Path, into: Path, robot: str) -> None:
    sums: dict[str, str] = {}
    received: dict[str, str] = {}
    with packed.open("rb") as file:
        for member in archive.members(file, robot):
            if _SUMS.match(member.name) and not sums:
                sums = _parse_sums(b"".join(islice(member.chunks, _SUMS_CHUNKS)))
            elif not _SAFE_NAME.match(member.name):
                raise EvidenceError(f"sent {member.name!r}, which is no plain file of a repeat", where=robot)
            else:
                received[member.name] = _write(member, into, robot)
    wrong = sorted(name for name in sums.keys() | received.keys() if sums.get(name) != received.get(name))
    if wrong or not received:
        raise EvidenceError(f"hash differs or file missing: {', '.join(wrong) or 'all files'}", where=robot)


def _write(member: archive.TarMember, into: Path, robot: str) -> str:
    """Write a file that is not there yet; return its hash."""
    path = into / member.name
    try:
        path.parent.mkdir(exist_ok=True)
        file = path.open("xb")
    except (FileExistsError, NotADirectoryError) as error:
        raise EvidenceError(f"sent {member.name}, which it or the other robot sent before", where=robot) from error
    digest = hashlib.sha256()
    with file:
        for chunk in member.chunks:
            digest.update(chunk)
            file.write(chunk)
    return digest.hexdigest()


def _parse_sums(content: bytes) -> dict[str, str]:
    matches = map(_SUM_LINE.match, content.decode("ascii", "replace").splitlines())
    return {match[2]: match[1] for match in matches if match}
