"""A repeat's folder on the robot: made before, fetched whole and checked by hash after."""

import hashlib
import re
import tarfile
from pathlib import Path
from typing import Final

from fieldkit.deadline import Deadline
from fieldkit.errors import EvidenceError
from fieldkit.remote.jobs import HOME, REPLY_S, SCRIPT_PATH
from fieldkit.remote.shell import Shell

MAX_BYTES: Final = 1 << 30
SUMS: Final = ".sums"

_FETCH_S: Final = 300.0
_SAFE_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}\Z", re.ASCII)
_SUM_LINE: Final = re.compile(r"([0-9a-f]{64})[ *]{2}(.+)\Z", re.ASCII)


def begin_command(folder: str, role: str, interface: str, *, old: str | None = None) -> tuple[str, ...]:
    """Return the command that makes `folder` with the host's state in it, and removes the folder `old`."""
    return ("sh", SCRIPT_PATH, "begin", folder, role, interface, *([old] if old else []))


def pack_command(folder: str, role: str, interface: str) -> tuple[str, ...]:
    """Return the command that notes the host's state again and sends every file of `folder`."""
    return ("sh", SCRIPT_PATH, "pack", folder, role, interface)


def begin(shell: Shell, folder: str, role: str, interface: str, *, old: str | None = None) -> None:
    """Make the repeat's folder with the host's state in it, and remove the folder `old`; errors as `Shell.run`."""
    shell.run(begin_command(folder, role, interface, old=old), deadline=Deadline.after(REPLY_S))


def end_jobs(shell: Shell, folder: str) -> None:
    """End every job of the repeat that still runs; errors as `Shell.run`."""
    shell.run(("sh", SCRIPT_PATH, "end", folder), deadline=Deadline.after(2 * REPLY_S))


def fetch(shell: Shell, folder: str, role: str, interface: str, into: Path) -> None:
    """Let the robot note its state again, copy its files of a repeat into `into` and check each against its hash.

    The robot is not trusted: names are checked against a pattern, only regular files are taken, the size is bounded.

    Raises:
        LinkError: The robot did not answer.
        EvidenceError: What it sent is not whole, not safe, or fails its hash.
    """
    archive = into / f".{role}.tar"
    try:
        shell.fetch(
            pack_command(folder, role, interface),
            archive,
            deadline=Deadline.after(_FETCH_S),
            limit_bytes=MAX_BYTES,
        )
        _unpack(archive, into, shell.robot)
    finally:
        archive.unlink(missing_ok=True)


def discard(shell: Shell, trial: str) -> None:
    """Remove everything of `trial` from the robot; errors as `Shell.run`."""
    shell.run(("rm", "-rf", "--", f"{HOME}/{trial}"), deadline=Deadline.after(REPLY_S))


def _unpack(archive: Path, into: Path, robot: str) -> None:
    sums: dict[str, str] = {}
    received: dict[str, str] = {}
    try:
        with tarfile.open(archive, mode="r:") as tar:
            for member in tar:
                source = tar.extractfile(member) if member.isreg() else None
                if source is not None and member.name == SUMS:
                    sums = _parse_sums(source.read())
                    continue
                if source is None or not _SAFE_NAME.match(member.name):
                    raise EvidenceError(f"sent {member.name!r}, which is no plain file of a repeat", where=robot)
                content = source.read()
                if (into / member.name).exists():
                    raise EvidenceError(f"sent {member.name}, which the other robot sent too", where=robot)
                (into / member.name).write_bytes(content)
                received[member.name] = hashlib.sha256(content).hexdigest()
    except tarfile.TarError as error:
        raise EvidenceError(f"its files arrived damaged: {error}", where=robot) from error
    wrong = sorted(name for name in sums.keys() | received.keys() if sums.get(name) != received.get(name))
    if wrong or not received:
        raise EvidenceError(f"hash differs or file missing: {', '.join(wrong) or 'all files'}", where=robot)


def _parse_sums(content: bytes) -> dict[str, str]:
    matches = map(_SUM_LINE.match, content.decode("ascii", "replace").splitlines())
    return {match[2]: match[1] for match in matches if match}
