"""The manifest of a trial: a SHA-256 checksum of each file, computed once when the file is stored.

The manifest has the format of the program `sha256sum`.
"""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

from fieldkit.core import files, laptop_files
from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import sanitized
from fieldkit.trial import store
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.store import MANIFEST_FILE

Sums = Mapping[str, str]
"""Checksum of each file by its name relative to the trial's folder."""

_LIMIT_BYTES: Final = 1 << 28
"""Maximum size of a manifest, and of a file whose unchanged lines are counted."""
_HEX_DIGITS: Final = frozenset("0123456789abcdef")

# sha256sum escapes names that contain a line break or backslash, and starts the line with a backslash.
_ESCAPES: Final = (("\\", "\\\\"), ("\n", "\\n"), ("\r", "\\r"))


class Manifest:
    """Checksums of a trial's files, which are updated during the trial. An existing manifest is read first.

    Args:
        folder: The trial's folder.

    Raises:
        EvidenceError: There is a manifest that cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        previous = read(folder) if (folder / MANIFEST_FILE).exists() else {}
        self._top_level = {name: digest for name, digest in previous.items() if "/" not in name}
        self._lines = {attempt: _lines(sums) for attempt, sums in by_attempt(previous).items()}

    def __contains__(self, attempt: str) -> bool:
        """Return True if the evidence of an attempt has checksums; `attempt` is the name of its folder."""
        return attempt in self._lines

    def unchanged_lines(self, name: str) -> int | None:
        """Return the number of lines of a top-level file that have not changed since its checksum was computed.

        Lines that were appended later are not counted. The result is None if the other lines have changed or the file
        cannot be read, and 0 if the file has no checksum.
        """
        return count_unchanged_lines(self._folder / name, self._top_level[name]) if name in self._top_level else 0

    def add(self, attempt: Path) -> None:
        """Add the checksums of a stored attempt. Its evidence is not written again, so this is done once."""
        self._lines[attempt.name] = _lines(_sums(self._folder, attempt))

    def rename(self, attempt: str, name: str) -> None:
        """Rename an attempt's folder in the manifest. Its checksums are not computed again."""
        if attempt in self._lines:
            before, after = (f"{store.REPEATS}/{folder}/" for folder in (attempt, name))
            lines = self._lines.pop(attempt).splitlines(keepends=True)
            self._lines[name] = b"".join(line.replace(before.encode(), after.encode(), 1) for line in lines)
            self._save()

    def write(self) -> None:
        """Write the manifest: checksums of the added attempts, and of the current top-level files.

        The plan does not change during a trial, so its first checksum is kept.
        """
        top_level = {path.name: sha256(path) for path in self._folder.iterdir() if _is_top_level(path)}
        if PLAN_FILE in self._top_level:
            top_level[PLAN_FILE] = self._top_level[PLAN_FILE]
        self._top_level = top_level
        self._save()

    def renew(self, names: Iterable[str]) -> None:
        """Compute the checksums of the top-level files `names` again. Other checksums are not changed."""
        self._top_level |= {name: sha256(self._folder / name) for name in names}
        self._save()

    def renew_positions(self) -> None:
        """Compute the checksums of the position files, which can be added, changed and removed after the trial.

        Other checksums are not changed.
        """
        top_level = {name: digest for name, digest in self._top_level.items() if not is_positions(name)}
        position_names = (
            path.name for path in self._folder.iterdir() if is_positions(path.name) and _is_top_level(path)
        )
        self._top_level = top_level
        self.renew(position_names)

    def _save(self) -> None:
        # The keys of attempts end with a slash, so that all lines are sorted by whole file names.
        parts = {f"{store.REPEATS}/{attempt}/": lines for attempt, lines in self._lines.items()}
        parts |= {name: _line(name, digest) for name, digest in self._top_level.items()}
        files.write(self._folder / MANIFEST_FILE, b"".join(parts[name] for name in sorted(parts)))


def read(folder: Path) -> Sums:
    """Return the checksums in a trial's manifest.

    Raises:
        EvidenceError: There is no manifest, or it cannot be read.
    """
    path = folder / MANIFEST_FILE
    try:
        return dict(map(_parse, files.read(path, _LIMIT_BYTES).split(b"\n")[:-1]))
    except FileNotFoundError as error:
        raise EvidenceError(
            "no readable manifest", where=str(path), remedy="name the folder of a trial that ran at least one repeat"
        ) from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"not a line of a manifest: {str(error)[:60]}"
        raise EvidenceError(
            f"no readable manifest: {reason}", where=str(path), remedy="restore the file from a copy"
        ) from error


def is_positions(name: str) -> bool:
    """Return True if a top-level file of a trial contains positions of robots."""
    return name == laptop_files.POSITIONS or name.startswith(store.POSITIONS)


def count_unchanged_lines(path: Path, digest: str) -> int | None:
    """Return the number of lines at the start of a file that have this checksum.

    None if no lines have it, or the file cannot be read.
    """
    hasher, count = hashlib.sha256(), 0
    try:
        lines = files.read(path, _LIMIT_BYTES).splitlines(keepends=True)
    except OSError:
        return None
    for count, line in enumerate(lines, start=1):
        hasher.update(line)
        if hasher.hexdigest() == digest:
            return count
    return None


def by_attempt(sums: Sums) -> dict[str, dict[str, str]]:
    """Return the checksums of the evidence of each attempt, by the name of its folder."""
    sums_by_attempt: dict[str, dict[str, str]] = {}
    for name, digest in sums.items():
        top_folder, _, path = name.partition("/")
        attempt, _, file = path.partition("/")
        if top_folder == store.REPEATS and file:
            sums_by_attempt.setdefault(attempt, {})[name] = digest
    return sums_by_attempt


def _sums(folder: Path, attempt: Path) -> Sums:
    return {relative_name(folder, path): sha256(path) for path in plain_files(attempt)}


def plain_files(folder: Path) -> Iterator[Path]:
    """Yield the plain files at any depth below a folder, except hidden ones and those in hidden folders.

    Hidden files are incomplete, or were created by a desktop.
    """
    for where, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        paths = (Path(where, name) for name in names if not name.startswith("."))
        yield from (path for path in paths if not files.unexpected_type(path))


def relative_name(folder: Path, path: Path) -> str:
    """Return the name of a file in a manifest: its path below the trial's folder."""
    return path.relative_to(folder).as_posix()


def _is_top_level(path: Path) -> bool:
    return path.name != MANIFEST_FILE and not path.name.startswith(".") and path.is_file() and not path.is_symlink()


def _lines(sums: Sums) -> bytes:
    return b"".join(_line(name, digest) for name, digest in sorted(sums.items()))


def _line(name: str, digest: str) -> bytes:
    escaped = name
    for char, escape in _ESCAPES:
        escaped = escaped.replace(char, escape)
    # chr(92) is a backslash.
    return os.fsencode(f"{'' if escaped == name else chr(92)}{digest}  {escaped}\n")


def _parse(line: bytes) -> tuple[str, str]:
    text = os.fsdecode(line)
    is_escaped = text.startswith("\\")
    digest, separator, name = text.removeprefix("\\").partition("  ")
    if not separator or len(digest) != 64 or not _HEX_DIGITS.issuperset(digest):
        raise ValueError(sanitized(text))
    return _unescaped(name) if is_escaped else name, digest


def _unescaped(name: str) -> str:
    chars = {escape[1]: char for char, escape in _ESCAPES}
    parts = iter(name)
    # After a backslash, `next` takes the character that is escaped.
    return "".join(chars.get(next(parts, ""), "?") if char == "\\" else char for char in parts)


def sha256(path: Path) -> str:
    """Return the checksum of a plain file; raises OSError if the file cannot be read or is of another type."""
    with os.fdopen(files.open_plain(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
