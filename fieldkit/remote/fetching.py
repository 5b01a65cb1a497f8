"""Evidence brought from a robot: a repeat's folder fetched whole, each file checked by its hash."""

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
from fieldkit.remote.script import CALL, call, complaint
from fieldkit.remote.shell import Shell

PIECE_BYTES: Final = 1 << 22
"""So much is fetched of a large file at a time; so much of small ones the robot packs into one archive."""

ALWAYS_BYTES: Final = 1 << 30
EXPECTED_TIMES: Final = 4
UNEXPECTED_SHARE: Final = 0.1
"""Large files are taken up to the first, so many times what is expected, or such a share of the free disk, whichever
is most: a camera may be a better one than the profile says, but no robot shall fill this machine's disk."""

RESERVE_BYTES: Final = 100 << 20
"""Room that evidence leaves on this machine."""

_PIECE_S: Final = 300.0
"""A link that carries less than 14 kB/s for so long carries no evidence."""
_SUMMED_BYTES_PER_S: Final = 2e6
"""How fast the slowest robot makes sums: a tenth of what sha256sum does on a Raspberry Pi Zero."""

_PACKED_BYTES: Final = 2 * PIECE_BYTES
_CHUNK_BYTES: Final = 1 << 20
_LIST_CHUNKS: Final = 2
"""Of 64 KiB each: as many as sums, or sizes, of all files of a folder may take."""
_TOLD_S: Final = 5.0

_NO_FOLDER: Final = "no folder "
_LATE: Final = "job "
_SUMS: Final = re.compile(r"\.sums-[0-9]{1,10}\Z", re.ASCII)
_LARGE: Final = re.compile(r"\.large-[0-9]{1,10}\Z", re.ASCII)
_SIZE: Final = re.compile(r"[0-9]{1,15}\Z", re.ASCII)
# Together at most 97 characters, which every tar writes without an extension.
_PART: Final = r"[A-Za-z0-9][A-Za-z0-9._-]{0,47}"
_SAFE_NAME: Final = re.compile(rf"{_PART}(/{_PART})?\Z", re.ASCII)
_SUM_LINE: Final = re.compile(r"([0-9a-f]{64})[ *]{2}(.+)\Z", re.ASCII)


class NoFolderError(RobotError):
    """The robot has no folder of the attempt: it never had, or somebody removed it."""


class LateError(RobotError):
    """All evidence came, and a job that `jobs.stop` let go did not end well."""


class FetchProgress:
    """How far the fetching of large files is.

    Args:
        tell: Told at times, in words and with the seconds that the rest takes at the rate so far.
        is_over: Whether somebody gave the fetch up.
    """

    def __init__(
        self, tell: Callable[[str, float], None] = lambda *_: None, is_over: Callable[[], bool] = lambda: False
    ) -> None:
        self._tell = tell
        self._is_over = is_over
        self._total = self._done = self._came = 0
        self._began_s = self._told_s = 0.0

    def begin(self, total_bytes: int) -> None:
        """Begin to fetch files of so many bytes together."""
        self._total, self._done, self._came = total_bytes, 0, 0
        self._began_s = self._told_s = time.monotonic()

    def add(self, size_bytes: int, *, had: bool = False) -> None:
        """Take in that so much is there; `had` if it came by an earlier call.

        Raises:
            LinkError: Somebody gave the fetch up; asking for another piece would connect again.
        """
        if self._is_over():
            raise LinkError("the fetch was given up")
        self._done += size_bytes
        if had:
            return
        self._came += size_bytes
        now_s = time.monotonic()
        if now_s - self._told_s >= _TOLD_S:
            self._told_s = now_s
            left_s = (self._total - self._done) * (now_s - self._began_s) / self._came
            self._tell(f"{format_bytes(self._done)} of {format_bytes(self._total)}", left_s)


def pack_command(folder: str, role: str, interface: str) -> tuple[str, ...]:
    """Return the command that notes the host's state again and sends every file of `folder`."""
    return (*CALL, "pack", folder, role, interface)


def fetch(
    shell: Shell,
    folder: str,
    role: str,
    interface: str,
    into: Path,
    *,
    expected_bytes: int = 0,
    progress: FetchProgress | None = None,
    foreign: Callable[[str], str | None] = lambda _: None,
) -> None:
    """Let the robot note its state again, copy its files of a repeat into `into` and check each against its hash.

    What is small comes as one archive, what is large piece by piece: the time for each is bounded, the time for all
    grows with their size, and what was cut goes on where it was, also in another call.

    The robot is not trusted: names are checked against a pattern, files that only the laptop or another robot writes
    are refused, only plain files are taken, in one level of folders at most, and their number and size are bounded.

    Args:
        shell: The robot.
        folder: From `jobs.work_folder`.
        role: Names the state's files.
        interface: The radio's.
        into: Where the files go.
        expected_bytes: About how much there is; see `EXPECTED_TIMES`.
        progress: Told how far the large files are.
        foreign: Returns why a file of this name is none of this robot's, None if it may be.

    Raises:
        LinkError: The robot did not answer.
        LateError: All came, but a job that `jobs.stop` let go did not end well.
        RobotError: It has no such folder, or could not pack its files; what came is kept then.
        EvidenceError: What it sent is not whole, not safe, fails its hash, or is more than is expected or fits here.
    """
    packed = into / f".{role}.tar"
    try:
        large, late = _fetch_small(shell, pack_command(folder, role, interface), packed, folder, foreign)
    finally:
        packed.unlink(missing_ok=True)
    if large:
        _demand_room(shell, large, into, expected_bytes)
        progress = progress or FetchProgress()
        progress.begin(sum(large.values()))
        for name, size_bytes in large.items():
            _LargeFile(shell, folder, name, size_bytes).fetch(into, role, progress)
    if late is not None:
        raise late


def _fetch_small(
    shell: Shell, command: tuple[str, ...], packed: Path, folder: str, foreign: Callable[[str], str | None]
) -> tuple[Mapping[str, int], RobotError | None]:
    """Fetch all small files beside their archive.

    Returns:
        The sizes of the large ones by name, and what the robot complained of though all came.
    """
    late: RobotError | None = None
    try:
        shell.fetch(command, packed, deadline=Deadline.after(_PIECE_S), limit_bytes=_PACKED_BYTES)
    except RobotError as error:
        late = _in_its_words(error, folder)
    try:
        return _unpack(packed, packed.parent, shell.robot, foreign), late
    except (EvidenceError, FileNotFoundError) as error:
        if isinstance(late, LateError):
            late = RobotError(late.what, where=late.where, remedy=late.remedy)  # it did not come whole
        raise late or error from None


def _in_its_words(error: RobotError, folder: str) -> RobotError:
    """Return why the robot could not pack a folder, as it says itself."""
    said = complaint(error.what.encode())
    if said.startswith(_NO_FOLDER):
        return NoFolderError(f"it no longer has {said.removeprefix('no ')}", where=error.where)
    if said.startswith(_LATE):
        return LateError(said, where=error.where, remedy=f"look into {folder} on the robot")
    return RobotError(said, where=error.where, remedy=f"look into {folder} on the robot") if said else error


def _demand_room(shell: Shell, large: Mapping[str, int], into: Path, expected_bytes: int) -> None:
    """Refuse what is more than this machine has room for, or far more than the trial was to leave."""
    waiting = sum(large.values())
    free = files.free_bytes(into)
    limit = max(ALWAYS_BYTES, EXPECTED_TIMES * expected_bytes, UNEXPECTED_SHARE * free)
    room = free - RESERVE_BYTES + sum(part.stat().st_size for part in into.glob(".*.part"))
    if waiting > limit:
        why = f"at most {format_bytes(limit)} are taken where {format_bytes(expected_bytes)} are expected"
    elif waiting > room:
        why = f"{format_bytes(max(0, room))} are free here"
    else:
        return
    raise EvidenceError(
        f"{format_bytes(waiting)} wait there ({', '.join(large)}), and {why}: they stay on the robot",
        where=shell.robot,
    )


@dataclass(frozen=True)
class _LargeFile:
    """A large file on a robot, in a folder there."""

    shell: Shell
    folder: str
    name: str
    size_bytes: int

    def fetch(self, into: Path, role: str, progress: FetchProgress) -> None:
        """Fetch it piece by piece, from where an earlier call was cut, and check it against its hash."""
        part, piece = into / f".{role}.{self.name.replace('/', '+')}.part", into / f".{role}.piece"
        digest = hashlib.sha256()
        with part.open("ab+") as file:
            have = min(file.tell(), self.size_bytes) // PIECE_BYTES * PIECE_BYTES
            file.truncate(have)
            file.seek(0)
            while chunk := file.read(_CHUNK_BYTES):
                digest.update(chunk)
            progress.add(have, had=True)
            try:
                for start in range(have, self.size_bytes, PIECE_BYTES):
                    content = self._piece(start, piece)
                    digest.update(content)
                    file.write(content)
                    progress.add(len(content))
            finally:
                piece.unlink(missing_ok=True)
        if self._sum() != digest.hexdigest():
            part.unlink()  # what an earlier call fetched may be what is wrong
            raise EvidenceError(f"hash differs: {self.name}", where=self.shell.robot)
        path = _place(into, self.name, self.shell.robot)
        try:
            # The name is taken before it is used: the other robot is fetched at the same time.
            path.open("xb").close()
        except FileExistsError as error:
            raise _sent_before(self.name, self.shell.robot) from error
        part.rename(path)

    def _piece(self, start: int, to: Path) -> bytes:
        number, wanted = start // PIECE_BYTES, min(PIECE_BYTES, self.size_bytes - start)
        command = (*CALL, "piece", self.folder, self.name, str(number), str(PIECE_BYTES))
        self.shell.fetch(command, to, deadline=Deadline.after(_PIECE_S), limit_bytes=PIECE_BYTES)
        content = to.read_bytes()
        if len(content) < wanted:
            said = f"sent {len(content)} bytes of {self.name} from {start} on, where there were {wanted}"
            raise EvidenceError(said, where=self.shell.robot)
        return content[:wanted]

    def _sum(self) -> str | None:
        deadline = Deadline.after(_PIECE_S + self.size_bytes / _SUMMED_BYTES_PER_S)
        return _parse_sums(call(self.shell, "sum", self.folder, self.name, deadline=deadline)).get(self.name)


def _unpack(packed: Path, into: Path, robot: str, foreign: Callable[[str], str | None]) -> Mapping[str, int]:
    """Unpack an archive of small files, check them, and return the sizes of the large ones by name."""
    sums: dict[str, str] = {}
    large: dict[str, int] = {}
    received: dict[str, str] = {}
    with packed.open("rb") as file:
        for member in archive.members(file, robot):
            if _SUMS.match(member.name) and not sums:
                sums = _parse_sums(b"".join(islice(member.chunks, _LIST_CHUNKS)))
            elif _LARGE.match(member.name) and not large:
                large = _parse_sizes(b"".join(islice(member.chunks, _LIST_CHUNKS)), robot)
                for name in large:
                    _demand_own(name, robot, foreign)
            elif not _SAFE_NAME.match(member.name):
                raise EvidenceError(f"sent {member.name!r}, which is no plain file of a repeat", where=robot)
            else:
                _demand_own(member.name, robot, foreign)
                received[member.name] = _write(member, into, robot)
    wrong = sorted(name for name in sums.keys() | received.keys() if sums.get(name) != received.get(name))
    if wrong or not received:
        raise EvidenceError(f"hash differs or file missing: {', '.join(wrong) or 'all files'}", where=robot)
    return large


def _demand_own(name: str, robot: str, foreign: Callable[[str], str | None]) -> None:
    """Refuse a file that the laptop writes, or another robot.

    Raises:
        EvidenceError: It is one.
    """
    why = "only the laptop writes a file of this name" if laptop_files.reserved(name) else foreign(name)
    if why:
        raise EvidenceError(
            f"sent {name}: {why}", where=robot, remedy=f"find out what writes {name} on the robot, and rename it"
        )


def _write(member: archive.TarMember, into: Path, robot: str) -> str:
    """Write a file that is not there yet; return its hash."""
    try:
        file = _place(into, member.name, robot).open("xb")
    except FileExistsError as error:
        raise _sent_before(member.name, robot) from error
    digest = hashlib.sha256()
    with file:
        for chunk in member.chunks:
            digest.update(chunk)
            file.write(chunk)
    return digest.hexdigest()


def _place(into: Path, name: str, robot: str) -> Path:
    """Return where a file of this name goes, its folder made."""
    path = into / name
    try:
        path.parent.mkdir(exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise _sent_before(name, robot) from error
    return path


def _sent_before(name: str, robot: str) -> EvidenceError:
    return EvidenceError(f"sent {name}, which it or the other robot sent before", where=robot)


def _parse_sums(content: bytes) -> dict[str, str]:
    matches = map(_SUM_LINE.match, content.decode("ascii", "replace").splitlines())
    return {match[2]: match[1] for match in matches if match}


def _parse_sizes(content: bytes, robot: str) -> dict[str, int]:
    lines = content.decode("ascii", "replace").splitlines()
    found = {name: size for size, _, name in (line.partition(" ") for line in lines)}
    for name, size in found.items():
        if not _SAFE_NAME.match(name) or not _SIZE.match(size):
            raise EvidenceError(f"lists {name!r} of {size!r} bytes, which is no plain file of a repeat", where=robot)
    if len(found) > archive.MAX_FILES:
        raise EvidenceError(f"lists more than {archive.MAX_FILES} files", where=robot)
    return {name: int(size) for name, size in found.items()}
