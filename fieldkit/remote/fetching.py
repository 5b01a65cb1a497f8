"""Fetch the evidence of a repeat from a robot: all files of its folder, each checked by its hash."""

import hashlib
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final

from fieldkit.core import files, laptop_files
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, LinkError, RobotError
from fieldkit.core.units import format_bytes
from fieldkit.remote import archive
from fieldkit.remote.script import CALL, call, error_message
from fieldkit.remote.shell import Shell

PIECE_BYTES: Final = 1 << 22
"""Size of the pieces in which large files are fetched, and maximum total size of the small files in the archive."""

ALWAYS_ALLOWED_BYTES: Final = 1 << 30
EXPECTED_TIMES: Final = 4
UNEXPECTED_SHARE: Final = 0.1
"""The total size of large files is limited to the largest of three values: `ALWAYS_ALLOWED_BYTES`, `EXPECTED_TIMES`
times the expected size, and `UNEXPECTED_SHARE` of the free disk. A camera may send more than its profile states, but
must not fill this disk."""

RESERVE_BYTES: Final = 100 << 20
"""Disk space of this machine that evidence must leave free."""

_PIECE_S: Final = 300.0
"""Timeout of a piece: the time that a link with 14 kB/s needs."""
_MIN_HASH_BYTES_PER_S: Final = 2e6
"""Minimum rate of sha256sum on a robot: a tenth of the rate on a Raspberry Pi Zero."""

_MAX_ARCHIVE_BYTES: Final = 2 * PIECE_BYTES
"""Maximum size of the archive: the small files with their headers, and the lists of hashes and of large files."""
_CHUNK_BYTES: Final = 1 << 20
_LIST_CHUNKS: Final = 2
"""Maximum length of the lists of hashes and of sizes, in chunks of 64 KiB."""
_REPORT_S: Final = 5.0  # interval of progress reports

# First words of two error messages of `pack` in the job script.
_NO_FOLDER: Final = "no folder "
_LATE_JOB: Final = "job "
_HASH_LIST: Final = re.compile(r"\.sums-[0-9]{1,10}\Z", re.ASCII)
_SIZE_LIST: Final = re.compile(r"\.large-[0-9]{1,10}\Z", re.ASCII)
_SIZE: Final = re.compile(r"[0-9]{1,15}\Z", re.ASCII)
# At most 97 characters in total, which every tar writes without an extension.
_PART: Final = r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}"
_SAFE_NAME: Final = re.compile(rf"{_PART}(/{_PART})?\Z", re.ASCII)
_SUM_LINE: Final = re.compile(r"([0-9a-f]{64})[ *]{2}(.+)\Z", re.ASCII)


class NoFolderError(RobotError):
    """The robot has no folder of the attempt: it was never created, or it was deleted."""


class LateJobError(RobotError):
    """All evidence was fetched, but a job failed after `jobs.stop` had returned without waiting for the job's end."""


class FetchProgress:
    """Progress of the fetch of large files.

    Args:
        report: Called every few seconds with a text, and the estimated remaining time in seconds.
        is_cancelled: Returns True if the fetch was cancelled.
    """

    def __init__(
        self, report: Callable[[str, float], None] = lambda *_: None, is_cancelled: Callable[[], bool] = lambda: False
    ) -> None:
        self._report = report
        self._is_cancelled = is_cancelled
        self._total_bytes = self._done_bytes = self._received_bytes = 0
        self._start_s = self._reported_s = 0.0

    def begin(self, total_bytes: int) -> None:
        """Start the fetch of files with this total size."""
        self._total_bytes, self._done_bytes, self._received_bytes = total_bytes, 0, 0
        self._start_s = self._reported_s = time.monotonic()

    def add(self, size_bytes: int, *, fetched_before: bool = False) -> None:
        """Add a number of fetched bytes.

        Args:
            size_bytes: The number.
            fetched_before: Whether an earlier call of `fetch` has fetched them.

        Raises:
            LinkError: The fetch was cancelled. Without this error the next piece would open the connection again.
        """
        if self._is_cancelled():
            raise LinkError("the fetch was cancelled")
        self._done_bytes += size_bytes
        if fetched_before:
            return
        self._received_bytes += size_bytes
        now_s = time.monotonic()
        if now_s - self._reported_s >= _REPORT_S:
            self._reported_s = now_s
            remaining_s = (self._total_bytes - self._done_bytes) * (now_s - self._start_s) / self._received_bytes
            self._report(f"{format_bytes(self._done_bytes)} of {format_bytes(self._total_bytes)}", remaining_s)


def pack_command(folder: str, role: str, interface: str) -> tuple[str, ...]:
    """Return the command that records the state of the host again and sends all files of `folder`."""
    return (*CALL, "pack", folder, role, interface)


def fetch(
    shell: Shell,
    folder: str,
    role: str,
    interface: str,
    destination: Path,
    *,
    expected_bytes: int = 0,
    progress: FetchProgress | None = None,
    forbidden_reason: Callable[[str], str | None] = lambda _: None,
) -> None:
    """Let the robot record its state again, fetch the files of an attempt, and check the hash of each file.

    Small files are sent in one archive, large files piece by piece. Each transfer has a timeout, the total time
    increases with the size, and an interrupted fetch continues from the last piece, also in a later call.

    The robot is not trusted: names are checked against a pattern, files that only the laptop or another robot writes
    are refused, only regular files in at most one level of folders are accepted, and their number and size are
    limited.

    Args:
        shell: The robot.
        folder: The folder, from `jobs.work_folder`.
        role: Role of the robot, the prefix of the files with the state.
        interface: Network interface of the radio.
        destination: The destination folder.
        expected_bytes: Expected total size; see `EXPECTED_TIMES`.
        progress: Receives the progress of large files; None to report no progress.
        forbidden_reason: Returns the reason why this robot must not send a file of this name, or None if it may.

    Raises:
        LinkError: The robot did not answer, or the fetch was cancelled.
        OSError: A file cannot be written on this computer.
        LateJobError: All files were fetched, but a job failed after `jobs.stop` had returned.
        RobotError: It has no such folder, or could not pack its files; files that arrived are kept.
        EvidenceError: The files are incomplete, unsafe or too large, or do not match their hash.
    """
    archive_path = destination / f".{role}.tar"
    try:
        large_sizes, job_error = _fetch_small(
            shell, pack_command(folder, role, interface), archive_path, folder, forbidden_reason
        )
    finally:
        archive_path.unlink(missing_ok=True)
    if large_sizes:
        _require_space(shell, large_sizes, destination, expected_bytes)
        progress = progress or FetchProgress()
        progress.begin(sum(large_sizes.values()))
        for name, size_bytes in large_sizes.items():
            _LargeFile(shell, folder, name, size_bytes).fetch(destination, role, progress)
    if job_error is not None:
        raise job_error


def _fetch_small(
    shell: Shell,
    command: tuple[str, ...],
    archive_path: Path,
    folder: str,
    forbidden_reason: Callable[[str], str | None],
) -> tuple[Mapping[str, int], RobotError | None]:
    """Fetch and unpack the archive of all small files.

    Returns:
        The sizes of the large files by name, and the error of the robot if all files arrived nevertheless; None if
        there was no error.

    Raises the same errors as `fetch`.
    """
    job_error: RobotError | None = None
    try:
        shell.fetch(command, archive_path, deadline=Deadline.after(_PIECE_S), limit_bytes=_MAX_ARCHIVE_BYTES)
    except RobotError as error:
        job_error = _pack_error(error, folder)
    try:
        return _unpack(archive_path, archive_path.parent, shell.robot, forbidden_reason), job_error
    except (EvidenceError, FileNotFoundError) as error:
        if isinstance(job_error, LateJobError):
            # The archive is incomplete, so the error must not report that all files arrived.
            job_error = RobotError(job_error.what, where=job_error.where, remedy=job_error.remedy)
        raise job_error or error from None


def _pack_error(error: RobotError, folder: str) -> RobotError:
    """Return the error that the job script reported when it packed a folder."""
    message = error_message(error.what.encode())
    if message.startswith(_NO_FOLDER):
        return NoFolderError(f"it no longer has {message.removeprefix('no ')}", where=error.where)
    if message.startswith(_LATE_JOB):
        return LateJobError(message, where=error.where, remedy=f"inspect {folder} on the robot")
    return RobotError(message, where=error.where, remedy=f"inspect {folder} on the robot") if message else error


def _require_space(shell: Shell, large_sizes: Mapping[str, int], destination: Path, expected_bytes: int) -> None:
    """Raise `EvidenceError` if large files do not fit on this disk, or are much larger than expected."""
    total_bytes = sum(large_sizes.values())
    free_bytes = files.free_bytes(destination)
    limit_bytes = max(ALWAYS_ALLOWED_BYTES, EXPECTED_TIMES * expected_bytes, UNEXPECTED_SHARE * free_bytes)
    available_bytes = free_bytes - RESERVE_BYTES + sum(part.stat().st_size for part in destination.glob(".*.part"))
    if total_bytes > limit_bytes:
        reason = f"at most {format_bytes(limit_bytes)} are fetched if {format_bytes(expected_bytes)} are expected"
    elif total_bytes > available_bytes:
        reason = f"{format_bytes(max(0, available_bytes))} are free here"
    else:
        return
    raise EvidenceError(
        f"{format_bytes(total_bytes)} must be fetched ({', '.join(large_sizes)}), but {reason}; "
        "the files stay on the robot",
        where=shell.robot,
    )


@dataclass(frozen=True)
class _LargeFile:
    """A large file in a folder on a robot."""

    shell: Shell
    folder: str
    name: str
    size_bytes: int

    def fetch(self, destination: Path, role: str, progress: FetchProgress) -> None:
        """Fetch the file piece by piece, after the pieces of an earlier call, and check its hash.

        Raises the same errors as the function `fetch`.
        """
        part, piece = destination / f".{role}.{self.name.replace('/', '+')}.part", destination / f".{role}.piece"
        digest = hashlib.sha256()
        with part.open("ab+") as file:
            fetched_bytes = min(file.tell(), self.size_bytes) // PIECE_BYTES * PIECE_BYTES
            file.truncate(fetched_bytes)
            file.seek(0)
            while chunk := file.read(_CHUNK_BYTES):
                digest.update(chunk)
            progress.add(fetched_bytes, fetched_before=True)
            try:
                for start in range(fetched_bytes, self.size_bytes, PIECE_BYTES):
                    content = self._piece(start, piece)
                    digest.update(content)
                    file.write(content)
                    progress.add(len(content))
            finally:
                piece.unlink(missing_ok=True)
        if self._remote_hash() != digest.hexdigest():
            part.unlink()  # pieces of an earlier call may be wrong, so all are fetched again
            raise EvidenceError(f"hash differs: {self.name}", where=self.shell.robot)
        path = _target_path(destination, self.name, self.shell.robot)
        try:
            # Reserve the name first, because the files of another robot are fetched at the same time.
            path.open("xb").close()
        except FileExistsError as error:
            raise _duplicate_error(self.name, self.shell.robot) from error
        part.rename(path)

    def _piece(self, start: int, path: Path) -> bytes:
        number, expected_bytes = start // PIECE_BYTES, min(PIECE_BYTES, self.size_bytes - start)
        command = (*CALL, "piece", self.folder, self.name, str(number), str(PIECE_BYTES))
        self.shell.fetch(command, path, deadline=Deadline.after(_PIECE_S), limit_bytes=PIECE_BYTES)
        content = path.read_bytes()
        if len(content) < expected_bytes:
            what = f"sent {len(content)} bytes of {self.name} from byte {start} on, instead of {expected_bytes}"
            raise EvidenceError(what, where=self.shell.robot)
        return content[:expected_bytes]

    def _remote_hash(self) -> str | None:
        deadline = Deadline.after(_PIECE_S + self.size_bytes / _MIN_HASH_BYTES_PER_S)
        return _parse_hashes(call(self.shell, "sum", self.folder, self.name, deadline=deadline)).get(self.name)


def _unpack(
    archive_path: Path, destination: Path, robot: str, forbidden_reason: Callable[[str], str | None]
) -> Mapping[str, int]:
    """Unpack an archive of small files, check them, and return the sizes of the large files by name.

    Raises:
        EvidenceError: A file is not allowed, is missing or does not match its hash, or the archive is damaged.
    """
    hashes: dict[str, str] = {}
    large_sizes: dict[str, int] = {}
    received_hashes: dict[str, str] = {}
    with archive_path.open("rb") as file:
        for member in archive.members(file, robot):
            if _HASH_LIST.match(member.name) and not hashes:
                hashes = _parse_hashes(b"".join(islice(member.chunks, _LIST_CHUNKS)))
            elif _SIZE_LIST.match(member.name) and not large_sizes:
                large_sizes = _parse_sizes(b"".join(islice(member.chunks, _LIST_CHUNKS)), robot)
                for name in large_sizes:
                    _require_allowed_name(name, robot, forbidden_reason)
            elif not _SAFE_NAME.match(member.name):
                raise EvidenceError(
                    f"sent {member.name!r}, which is not a regular file with a valid name", where=robot
                )
            else:
                _require_allowed_name(member.name, robot, forbidden_reason)
                received_hashes[member.name] = _write(member, destination, robot)
    differing_names = sorted(
        name for name in hashes.keys() | received_hashes.keys() if hashes.get(name) != received_hashes.get(name)
    )
    if differing_names or not received_hashes:
        raise EvidenceError(f"hash differs or file missing: {', '.join(differing_names) or 'all files'}", where=robot)
    return large_sizes


def _require_allowed_name(name: str, robot: str, forbidden_reason: Callable[[str], str | None]) -> None:
    """Check that this name is not reserved for a file that the laptop or another robot writes.

    Raises:
        EvidenceError: The name is reserved.
    """
    reason = (
        "only the laptop writes a file of this name" if laptop_files.is_reserved(name) else forbidden_reason(name)
    )
    if reason:
        raise EvidenceError(
            f"sent {name}: {reason}", where=robot, remedy=f"find out what writes {name} on the robot, and rename it"
        )


def _write(member: archive.TarMember, destination: Path, robot: str) -> str:
    """Write a member to a new file; return its hash. Raises `EvidenceError` if the file exists."""
    try:
        file = _target_path(destination, member.name, robot).open("xb")
    except FileExistsError as error:
        raise _duplicate_error(member.name, robot) from error
    digest = hashlib.sha256()
    with file:
        for chunk in member.chunks:
            digest.update(chunk)
            file.write(chunk)
    return digest.hexdigest()


def _target_path(destination: Path, name: str, robot: str) -> Path:
    """Return the path for a file of this name; its folder is created.

    Raises:
        EvidenceError: A file that was sent before has the name of this folder.
    """
    path = destination / name
    try:
        path.parent.mkdir(exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise _duplicate_error(name, robot) from error
    return path


def _duplicate_error(name: str, robot: str) -> EvidenceError:
    return EvidenceError(f"sent {name}, which it or another robot sent before", where=robot)


def _parse_hashes(content: bytes) -> dict[str, str]:
    matches = map(_SUM_LINE.match, content.decode("ascii", "replace").splitlines())
    return {match[2]: match[1] for match in matches if match}


def _parse_sizes(content: bytes, robot: str) -> dict[str, int]:
    lines = content.decode("ascii", "replace").splitlines()
    sizes = {name: size for size, _, name in (line.partition(" ") for line in lines)}
    for name, size in sizes.items():
        if not _SAFE_NAME.match(name) or not _SIZE.match(size):
            raise EvidenceError(
                f"lists {name!r} of {size!r} bytes, which is not a regular file with a valid name and size",
                where=robot,
            )
    if len(sizes) > archive.MAX_FILES:
        raise EvidenceError(f"lists more than {archive.MAX_FILES} files", where=robot)
    return {name: int(size) for name, size in sizes.items()}
