"""Stored attempts with one source of evidence changed at random, and what may follow from a change."""

import random
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from fieldkit.core.columns import Value
from fieldkit.core.model import Protocol, RepeatId
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates, store
from fieldkit.trial.gates import Judged
from fieldkit.trial.plan import Plan
from tests.helpers.paths import DATA

ATTEMPTS = tuple(
    (trial, protocol) for trial in sorted((DATA / "fieldkit" / "evidence").iterdir()) for protocol in Protocol
)
"""Trials and protocols of the attempts that are changed; each has a `repeats/PROTOCOL-01`."""

OF_THE_TESTBED = ("track.csv", "link.csv", "lateness.txt", "*medium.txt")
"""Written by the emulator, whose word on itself has no second source."""

TOLERANCES: Mapping[str, float] = {
    # One reply may be 20 ms late (measure.transfers.ping_checks), one packet 0.1 s early (steps.kinds.capture).
    "rtt_gap_s": 1.0,
    "rtt_*_s": 0.021,
    "paper_delay_s": 0.021,
    "paper_transfer_s": 10.0,
    "*delay*": 0.11,
    "*one_way*": 0.11,
    "*transfer_s": 0.11,
}
"""How far a column may move without a word, by its name without that of its step."""


@dataclass(frozen=True)
class Stored:
    """A stored attempt and what it measures."""

    plan: Plan
    repeat: RepeatId
    folder: Path
    judged: Judged

    def files(self) -> list[str]:
        """Names of the files that robots wrote, in order."""
        names = sorted(path.name for path in self.folder.iterdir())
        return [name for name in names if not any(fnmatch(name, pattern) for pattern in OF_THE_TESTBED)]

    def changed(self, name: str, content: bytes | None, place: Path) -> Judged:
        """Return the judgement if a file has this content; None removes it."""
        for path in self.folder.iterdir():
            (place / path.name).symlink_to(path)
        (place / name).unlink(missing_ok=True)
        if content is not None:
            (place / name).write_bytes(content)
        return gates.judge(self.plan, self.repeat, AttemptEvidence(place))

    def wrong(self, judged: Judged) -> dict[str, tuple[Value | None, Value]]:
        """Return the columns that moved although the attempt is valid: the value before, and after."""
        if judged.problems:
            return {}
        before = self.judged.measured.values
        return {
            name: (before.get(name), value)
            for name, value in judged.measured.values.items()
            if not _near(name, before.get(name), value)
        }


def stored(trial: Path, protocol: Protocol) -> Stored:
    plan, repeat = store.read_plan(trial), RepeatId(protocol, 1)
    folder = trial / "repeats" / f"{protocol}-01"
    return Stored(plan, repeat, folder, gates.judge(plan, repeat, AttemptEvidence(folder)))


def _near(name: str, before: Value | None, after: Value) -> bool:
    if before == after:
        return True
    plain = name.rpartition(".")[2]
    tolerance = next((most for pattern, most in TOLERANCES.items() if fnmatch(plain, pattern)), None)
    if tolerance is None or isinstance(before, str | None) or isinstance(after, str):
        return False
    return abs(float(before) - float(after)) <= tolerance


def changes(attempt: Stored, other: Stored, draw: random.Random) -> Iterator[tuple[str, str, bytes | None]]:
    """Yield changes without end: what was done, the file, and its new content."""
    names = attempt.files()
    while True:
        name = draw.choice(names)
        content = (attempt.folder / name).read_bytes()
        kind = draw.choice([*_KINDS])
        if kind in {"delete", "copy"}:
            alike = [path for path in _alike(attempt, other, name) if path.read_bytes() != content]
            yield kind, name, None if kind == "delete" or not alike else draw.choice(alike).read_bytes()
        elif content and (new := _KINDS[kind](content, draw)) != content:
            yield kind, name, new


def _alike(attempt: Stored, other: Stored, name: str) -> list[Path]:
    ending = name.rpartition(".")[2]
    paths = (path for folder in (attempt.folder, other.folder) for path in sorted(folder.iterdir()))
    return [path for path in paths if path.suffix == f".{ending}"]


def flip(content: bytes, draw: random.Random) -> bytes:
    at = draw.randrange(len(content))
    return content[:at] + bytes([content[at] ^ 1 << draw.randrange(8)]) + content[at + 1 :]


def truncate(content: bytes, draw: random.Random) -> bytes:
    return content[: draw.randrange(len(content))]


def scale(content: bytes, draw: random.Random) -> bytes:
    """One number of a text times 2, 10, a half or none."""
    numbers = list(re.finditer(rb"(?<![\w.])\d+(?:\.\d+)?(?![\w.])", content))
    if not numbers:
        return content
    chosen = draw.choice(numbers)
    digits = len(chosen[0].partition(b".")[2])
    new = f"{float(chosen[0]) * draw.choice((2, 10, 0.5, 0)):.{digits}f}".encode()
    return content[: chosen.start()] + new + content[chosen.end() :]


def scale_field(content: bytes, draw: random.Random) -> bytes:
    """Every number of one JSON key, or every `time=`, times 2 or a half."""
    keys = sorted(set(re.findall(rb'"(\w+)":\s*\d', content))) or [b"time"]
    key, factor = draw.choice(keys), draw.choice((2, 0.5, 1.3))

    def scaled(match: re.Match[bytes]) -> bytes:
        digits = len(match[2].partition(b".")[2])
        return match[1] + f"{float(match[2]) * factor:.{digits}f}".encode()

    return re.sub(rb'("?' + re.escape(key) + rb'"?[:=]\s*)(\d+(?:\.\d+)?)', scaled, content)


def shift(content: bytes, draw: random.Random) -> bytes:
    """Every time since 1970 in a text an hour, or 50 ms, later."""
    step = draw.choice((3600, -3600, 0.05, 1.5))

    def shifted(match: re.Match[bytes]) -> bytes:
        digits = len(match[0].partition(b".")[2])
        return f"{float(match[0]) + step:.{digits}f}".encode()

    return re.sub(rb"(?<![\w.])1[78]\d{8}(?:\.\d+)?(?![\w.])", shifted, content)


def drop_lines(content: bytes, draw: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    first = draw.randrange(len(lines))
    return b"".join(lines[:first] + lines[first + draw.randint(1, max(1, len(lines) // 3)) :])


def repeat_line(content: bytes, draw: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    at = draw.randrange(len(lines))
    return b"".join([*lines[: at + 1], *lines[at:]])


_KINDS: Mapping[str, Callable[[bytes, random.Random], bytes]] = {
    "delete": flip,
    "copy": flip,
    "flip": flip,
    "truncate": truncate,
    "scale": scale,
    "scale field": scale_field,
    "shift": shift,
    "drop lines": drop_lines,
    "repeat line": repeat_line,
}
