"""Stored attempts with a random change in one evidence file, and the permitted consequences of the change."""

import random
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from fieldkit.core.columns import Value
from fieldkit.core.model import Protocol, RepeatId
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates
from fieldkit.trial.gates import EvidenceVerdict
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans
from tests.helpers.paths import DATA

ATTEMPTS = tuple(
    (trial, protocol) for trial in sorted((DATA / "fieldkit" / "evidence").iterdir()) for protocol in Protocol
)
"""Trials and protocols of the attempts to change; each has a folder `repeats/PROTOCOL-01`."""

_PCAP_HEADER_BYTES = 24
_PCAP_RECORD = struct.Struct("<IIII")

TESTBED_FILES = ("track.csv", "link.csv", "lateness.txt", "*medium.txt")
"""Files that the emulator writes. No second source exists to verify them."""

TOLERANCES: Mapping[str, float] = {
    # One packet may be 0.1 s early (steps.kinds.capture), because no other source has the time at which a robot
    # captured it.
    "rtt_gap_s": 1.0,
    "rtt_*_s": 0.021,
    "paper_delay_s": 0.021,
    "paper_transfer_s": 10.0,
    # The offset and its error follow from the second fastest packets, which differ little from the fastest.
    "clock_offset*_s": 1e-4,
    "one_way_error_s": 1e-4,
    "*delay*": 0.11,
    "*one_way*": 0.11,
    "*jitter*": 0.11,
    "*variation*": 0.11,
    "*stall_s": 0.11,
    "completion_s": 0.11,
    "*transfer_s": 0.11,
    # For rates, the tolerance is the change of the transfer time, in seconds.
    "throughput_bit_s": 0.11,
    "goodput_bit_s": 0.11,
}
"""Maximum change of a column that may stay undetected, by a pattern of its name without the step name."""


@dataclass(frozen=True)
class StoredAttempt:
    """A stored attempt and its measured values."""

    plan: Plan
    repeat: RepeatId
    folder: Path
    verdict: EvidenceVerdict

    def files(self) -> list[str]:
        """Sorted names of the files that robots wrote."""
        names = sorted(path.name for path in self.folder.iterdir())
        return [name for name in names if not any(fnmatch(name, pattern) for pattern in TESTBED_FILES)]

    def judge_changed(self, name: str, content: bytes | None, folder: Path) -> EvidenceVerdict:
        """The verdict if one file has different content; None removes the file."""
        for path in self.folder.iterdir():
            (folder / path.name).symlink_to(path)
        (folder / name).unlink(missing_ok=True)
        if content is not None:
            (folder / name).write_bytes(content)
        return gates.judge(self.plan, self.repeat, AttemptEvidence(folder))

    def undetected_changes(self, verdict: EvidenceVerdict) -> dict[str, tuple[Value | None, Value]]:
        """The values before and after the change, of columns that changed although the attempt is still valid."""
        if verdict.problems:
            return {}
        before = self.verdict.measured.values
        return {
            name: (before.get(name), value)
            for name, value in verdict.measured.values.items()
            if not _within_tolerance(name, before, verdict.measured.values)
        }


def load_attempt(trial: Path, protocol: Protocol) -> StoredAttempt:
    plan, repeat = plans.read_plan(trial), RepeatId(protocol, 1)
    folder = trial / "repeats" / f"{protocol}-01"
    return StoredAttempt(plan, repeat, folder, gates.judge(plan, repeat, AttemptEvidence(folder)))


def _within_tolerance(name: str, before: Mapping[str, Value], after: Mapping[str, Value]) -> bool:
    old, new = before.get(name), after[name]
    flow, _, short_name = name.rpartition(".")
    if old == new or short_name.endswith("_withheld"):  # the reason why other columns are empty
        return True
    if old is None and fnmatch(short_name, "one_way_*") and short_name != "one_way_error_s":
        return True  # one late packet may raise a mean or a percentile above ten times its error
    tolerance = next((limit for pattern, limit in TOLERANCES.items() if fnmatch(short_name, pattern)), None)
    if tolerance is None or isinstance(old, str | None) or isinstance(new, str):
        return False
    if short_name.endswith("_bit_s"):
        bits = 8 * float(before[f"{flow}.received_bytes" if flow else "received_bytes"])
        return abs(bits / float(old) - bits / float(new)) <= tolerance
    if short_name == "clock_offset_s" and abs(float(new)) > float(after[f"{name.removesuffix('_s')}_error_s"]):
        return False  # the robots share one clock, so the true offset is 0
    return abs(float(old) - float(new)) <= tolerance


def changes(
    attempt: StoredAttempt, other: StoredAttempt, draw: random.Random
) -> Iterator[tuple[str, str, bytes | None]]:
    """Yield an endless sequence of changes: the kind of change, the file, and its new content."""
    names = attempt.files()
    while True:
        name = draw.choice(names)
        content = (attempt.folder / name).read_bytes()
        kind = draw.choice([*_KINDS])
        if kind in {"delete", "copy"}:
            candidates = [path for path in _same_suffix_files(attempt, other, name) if path.read_bytes() != content]
            yield kind, name, None if kind == "delete" or not candidates else draw.choice(candidates).read_bytes()
        elif content and (new := _KINDS[kind](content, draw)) != content:
            yield kind, name, new


def _same_suffix_files(attempt: StoredAttempt, other: StoredAttempt, name: str) -> list[Path]:
    extension = name.rpartition(".")[2]
    paths = (path for folder in (attempt.folder, other.folder) for path in sorted(folder.iterdir()))
    return [path for path in paths if path.suffix == f".{extension}"]


def with_wrong_time(capture: bytes, index: int, microseconds: int) -> bytes:
    """A little-endian pcap file in which the time of one packet is changed; `index` is modulo the packet count."""
    changed, position = bytearray(capture), _record_at(capture, index)
    seconds, fraction, *lengths = _PCAP_RECORD.unpack_from(capture, position)
    time = divmod(10**6 * seconds + fraction + microseconds, 10**6)
    _PCAP_RECORD.pack_into(changed, position, *time, *lengths)
    return bytes(changed)


def with_changed_bit(capture: bytes, index: int, bit: int) -> bytes:
    """A little-endian pcap file in which one bit of a packet is changed; arguments as for `with_wrong_time`."""
    changed = bytearray(capture)
    changed[_record_at(capture, index) + _PCAP_RECORD.size + bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def _record_at(capture: bytes, index: int) -> int:
    positions, position = [], _PCAP_HEADER_BYTES
    while position < len(capture):
        positions.append(position)
        position += _PCAP_RECORD.size + _PCAP_RECORD.unpack_from(capture, position)[2]
    return positions[index % len(positions)]


def flip(content: bytes, draw: random.Random) -> bytes:
    position = draw.randrange(len(content))
    return content[:position] + bytes([content[position] ^ 1 << draw.randrange(8)]) + content[position + 1 :]


def truncate(content: bytes, draw: random.Random) -> bytes:
    return content[: draw.randrange(len(content))]


def scale(content: bytes, draw: random.Random) -> bytes:
    """Multiply one number of a text by 2, 10, 0.5 or 0."""
    numbers = list(re.finditer(rb"(?<![\w.])\d+(?:\.\d+)?(?![\w.])", content))
    if not numbers:
        return content
    number = draw.choice(numbers)
    digits = len(number[0].partition(b".")[2])
    new = f"{float(number[0]) * draw.choice((2, 10, 0.5, 0)):.{digits}f}".encode()
    return content[: number.start()] + new + content[number.end() :]


def scale_field(content: bytes, draw: random.Random) -> bytes:
    """Multiply all numbers of one JSON key, or all `time=` values, by 2, 0.5 or 1.3."""
    keys = sorted(set(re.findall(rb'"(\w+)":\s*\d', content))) or [b"time"]
    key, factor = draw.choice(keys), draw.choice((2, 0.5, 1.3))

    def scale_match(match: re.Match[bytes]) -> bytes:
        digits = len(match[2].partition(b".")[2])
        return match[1] + f"{float(match[2]) * factor:.{digits}f}".encode()

    return re.sub(rb'("?' + re.escape(key) + rb'"?[:=]\s*)(\d+(?:\.\d+)?)', scale_match, content)


def shift(content: bytes, draw: random.Random) -> bytes:
    """Shift all UTC timestamps in a text by up to an hour."""
    step = draw.choice((3600, -3600, 0.05, 1.5))

    def shift_match(match: re.Match[bytes]) -> bytes:
        digits = len(match[0].partition(b".")[2])
        return f"{float(match[0]) + step:.{digits}f}".encode()

    return re.sub(rb"(?<![\w.])1[78]\d{8}(?:\.\d+)?(?![\w.])", shift_match, content)


def drop_lines(content: bytes, draw: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    first = draw.randrange(len(lines))
    return b"".join(lines[:first] + lines[first + draw.randint(1, max(1, len(lines) // 3)) :])


def repeat_line(content: bytes, draw: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    index = draw.randrange(len(lines))
    return b"".join([*lines[: index + 1], *lines[index:]])


_KINDS: Mapping[str, Callable[[bytes, random.Random], bytes]] = {
    # `changes` implements these two kinds itself and does not call their functions.
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
