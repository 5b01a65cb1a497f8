"""The manifest of a trial: a sum over each of its files, made when the file was kept and never again.

Its format is that of `sha256sum`.
"""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from fieldkit.core import files, laptop_files
from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import harmless
from fieldkit.measure.positions import accounts
from fieldkit.trial import store
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.store import MANIFEST_FILE

Sums = Mapping[str, str]
"""Sum of each file by its name below the trial's folder."""

_TOLD: Final = 5
_LIMIT_BYTES: Final = 1 << 28
_HEX_DIGITS: Final = frozenset("0123456789abcdef")

# As sha256sum writes names that do not fit into a line; the line then begins with a backslash.
_ESCAPES: Final = (("\\", "\\\\"), ("\n", "\\n"), ("\r", "\\r"))


class Manifest:
    """Sums over a trial's files, kept up while the trial grows; opened on a folder with a past, it knows that too.

    Args:
        folder: The trial's folder.

    Raises:
        EvidenceError: There is a manifest that cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        was = read(folder) if (folder / MANIFEST_FILE).exists() else {}
        self._own = {name: digest for name, digest in was.items() if "/" not in name}
        self._lines = {attempt: _lines(sums) for attempt, sums in _by_attempt(was).items()}

    def __contains__(self, attempt: str) -> bool:
        """Return whether the evidence of an attempt was summed before; `attempt` is its folder's name."""
        return attempt in self._lines

    def whole_lines(self, name: str) -> int | None:
        """Return how many lines one of the trial's own files had when it was summed, None where they are others now.

        A file that only grows may have more by now. One that was never summed had none.
        """
        return _whole_lines(self._folder / name, self._own[name]) if name in self._own else 0

    def add(self, attempt: Path) -> None:
        """Take in the evidence of an attempt that was kept; nothing writes it twice, so it is summed once."""
        self._lines[attempt.name] = _lines(_sums(self._folder, attempt))

    def rename(self, attempt: str, name: str) -> None:
        """Keep the sums of an attempt whose folder has another name now, which are not made again."""
        if attempt in self._lines:
            before, after = (f"{store.REPEATS}/{one}/" for one in (attempt, name))
            lines = self._lines.pop(attempt).splitlines(keepends=True)
            self._lines[name] = b"".join(line.replace(before.encode(), after.encode(), 1) for line in lines)
            self._save()

    def write(self) -> None:
        """Write the manifest: the evidence taken in, and the trial's own files as they stand now.

        The plan never changes, so its first sum stays.
        """
        own = {path.name: _sha256(path) for path in self._folder.iterdir() if _is_own(path)}
        if PLAN_FILE in self._own:
            own[PLAN_FILE] = self._own[PLAN_FILE]
        self._own = own
        self._save()

    def renew(self, names: Iterable[str]) -> None:
        """Sum some of the trial's own files anew, which are made of the others; all other sums stay."""
        self._own |= {name: _sha256(self._folder / name) for name in names}
        self._save()

    def renew_positions(self) -> None:
        """Sum anew what tells where robots were, given after the trial; all other sums stay."""
        own = {name: digest for name, digest in self._own.items() if not is_positions(name)}
        given = (path.name for path in self._folder.iterdir() if is_positions(path.name) and _is_own(path))
        self._own = own
        self.renew(given)

    def _save(self) -> None:
        # As sorted by whole names: the names of an attempt's files go on with a slash.
        parts = {f"{store.REPEATS}/{attempt}/": lines for attempt, lines in self._lines.items()}
        parts |= {name: _line(name, digest) for name, digest in self._own.items()}
        files.write(self._folder / MANIFEST_FILE, b"".join(parts[name] for name in sorted(parts)))


def read(folder: Path) -> Sums:
    """Return what a trial's manifest says.

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
        why = error.strerror if isinstance(error, OSError) else f"this is no line of one: {str(error)[:60]}"
        raise EvidenceError(
            f"no readable manifest: {why}", where=str(path), remedy="restore the file from a copy"
        ) from error


def verify(folder: Path) -> list[str]:
    """Compare a trial's files with its manifest.

    Returns:
        One sentence per difference, sorted by file; empty when all agree.

    Raises:
        EvidenceError: There is no manifest, or it cannot be read.
    """
    listed = read(folder)
    found = {str(path.relative_to(folder)): what for path, what in store.unexpected_files(folder)}
    present = {_name(folder, path): path for path in _plain_files(folder)}
    present.pop(MANIFEST_FILE, None)
    return _told(_compared(listed.keys() - found.keys(), listed, present) | found)


def differences(folder: Path, attempts: Iterable[str] | None = None) -> Mapping[str, str]:
    """Return how the evidence of attempts differs from what was once summed, by file; those never summed do not.

    Args:
        folder: The trial's folder; one without a manifest has no sums.
        attempts: Names of the attempts' folders, None for all, and for plan and journal, which say what they are, and
            for what tells where robots were.

    Raises:
        EvidenceError: The manifest cannot be read.
    """
    if not (folder / MANIFEST_FILE).exists():
        return {}
    sums = read(folder)
    summed = _by_attempt(sums)
    own = _own_differences(folder, sums) if attempts is None else {}
    asked = summed.keys() if attempts is None else summed.keys() & set(attempts)

    def compare(attempt: str) -> dict[str, str]:
        present = {_name(folder, path): path for path in _plain_files(store.attempt_folder(folder, attempt))}
        return _compared(summed[attempt].keys(), summed[attempt], present)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return own | {name: what for found in pool.map(compare, asked) for name, what in found.items()}


def _own_differences(folder: Path, sums: Sums) -> dict[str, str]:
    """Return how the plan and the journals differ; journals may have grown since they were summed."""
    changed = {PLAN_FILE: PLAN_FILE in sums and _sha256(folder / PLAN_FILE) != sums[PLAN_FILE]}
    for name in (JOURNAL_FILE, laptop_files.MOTION):
        changed[name] = name in sums and _whole_lines(folder / name, sums[name]) is None
    for name in filter(is_positions, sums.keys() | {path.name for path in folder.iterdir()}):
        changed[name] = not (folder / name).is_file() or _sha256(folder / name) != sums.get(name)
    return {name: "changed" for name, has in changed.items() if has}


def is_positions(name: str) -> bool:
    """Return whether a trial's own file tells where robots were."""
    return name == accounts.FILE or name.startswith(store.POSITIONS)


def _whole_lines(path: Path, digest: str) -> int | None:
    """Return after how many lines a file has this sum, None where it never has."""
    found, count = hashlib.sha256(), 0
    try:
        lines = files.read(path, _LIMIT_BYTES).splitlines(keepends=True)
    except OSError:
        return None
    for count, line in enumerate(lines, start=1):
        found.update(line)
        if found.hexdigest() == digest:
            return count
    return None


def few(problems: Mapping[str, str]) -> str:
    """Return some differences in words, and how many there are beside them."""
    told = _told(problems)
    more = len(told) - _TOLD
    return "; ".join(told[:_TOLD]) + (f"; and {more} more: fieldkit verify lists them" if more > 0 else "")


def _compared(names: Iterable[str], listed: Sums, present: Mapping[str, Path]) -> dict[str, str]:
    wanted = set(names)
    problems = dict.fromkeys(wanted - present.keys(), "missing")
    problems |= dict.fromkeys(present.keys() - listed.keys(), "not in the manifest")
    problems |= {name: "changed" for name in wanted & present.keys() if _sha256(present[name]) != listed[name]}
    return problems


def _told(problems: Mapping[str, str]) -> list[str]:
    return [f"{harmless(name).replace(chr(10), '?')}: {what}" for name, what in sorted(problems.items())]


def _by_attempt(sums: Sums) -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for name, digest in sums.items():
        place, _, rest = name.partition("/")
        attempt, _, file = rest.partition("/")
        if place == store.REPEATS and file:
            found.setdefault(attempt, {})[name] = digest
    return found


def _sums(folder: Path, attempt: Path) -> Sums:
    return {_name(folder, path): _sha256(path) for path in _plain_files(attempt)}


def _plain_files(folder: Path) -> Iterator[Path]:
    """Yield the plain files at any depth below a folder, but for hidden ones: what is half done, or a desktop's."""
    for where, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        paths = (Path(where, name) for name in names if not name.startswith("."))
        yield from (path for path in paths if not files.foreign(path))


def _name(folder: Path, path: Path) -> str:
    return path.relative_to(folder).as_posix()


def _is_own(path: Path) -> bool:
    return path.name != MANIFEST_FILE and not path.name.startswith(".") and path.is_file() and not path.is_symlink()


def _lines(sums: Sums) -> bytes:
    return b"".join(_line(name, digest) for name, digest in sorted(sums.items()))


def _line(name: str, digest: str) -> bytes:
    written = name
    for char, escape in _ESCAPES:
        written = written.replace(char, escape)
    return os.fsencode(f"{'' if written == name else chr(92)}{digest}  {written}\n")


def _parse(line: bytes) -> tuple[str, str]:
    text = os.fsdecode(line)
    is_escaped = text.startswith("\\")
    digest, separator, name = text.removeprefix("\\").partition("  ")
    if not separator or len(digest) != 64 or not _HEX_DIGITS.issuperset(digest):
        raise ValueError(harmless(text))
    return _unescaped(name) if is_escaped else name, digest


def _unescaped(name: str) -> str:
    plain = {escape[1]: char for char, escape in _ESCAPES}
    parts = iter(name)
    return "".join(plain.get(next(parts, ""), "?") if char == "\\" else char for char in parts)


def _sha256(path: Path) -> str:
    with os.fdopen(files.open_plain(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
