"""Outage of a robot because of a fault, from what its observer wrote: one clock, one file.

The resolution is the observer's interval: a robot that was gone between two answers G apart was gone for G at most,
and for G less two intervals at least.
"""

import re
from collections.abc import Sequence, Set
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Column, Figure, Kind, Measured, columns, of_fault, prefixed
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind
from fieldkit.measure.evidence import ping, reading

_ORDER: Final = (FaultKind.LINK_DOWN, FaultKind.OUT_OF_RANGE, FaultKind.REBOOT, FaultKind.KILL)

SILENT_S: Final = 1.0
"""A robot whose last answer is older than this when the observer ends has not recovered."""

# A gap that long is in every quiet run: a robot that booted, or came back from afar, was gone for longer.
_UNREMARKABLE_INTERVALS: Final = 3

_NUMBER: Final = r"[0-9]{1,9}(?:\.[0-9]{1,9})?"
_NOTE: Final = re.compile(rf"lasted_s (?P<lasted>{_NUMBER}|unknown)\ninterval_s (?P<interval>{_NUMBER})\n")
_SEEN: Final = re.compile(rf"(?P<at>{_NUMBER})(?: up(?P<pids>(?: [0-9]{{1,9}})+))?\Z")


def _observer(kind: FaultKind) -> str:
    """Return what the outage was seen by, which is not the traffic of other steps."""
    return "process" if kind is FaultKind.KILL else "ping"


def declared(kind: FaultKind) -> tuple[Column, ...]:
    """Return the columns of a kind of fault."""
    gone = f"Longest time without an answer around the fault {kind}; empty when it did not recover."
    left = f"What of the outage by {kind} was left when its cause was over; empty when nobody knows."
    back = f"Whether the robot was back within the limit after {kind}."
    least = f"Lower bound of the recovery where the robot was not back when the observer of {kind} ended, else empty."
    place, bound = list(FaultKind).index(kind), of_fault(kind, "recovery_at_least_s")
    returned = Figure(f"{_observer(kind)} back after {kind}", Kind.FLAG, rank=70 + place)
    recovery = Figure(f"{_observer(kind)} recovery after {kind}", Kind.MEDIAN, rank=80 + place, at_least=bound)
    times = columns(
        90,
        (of_fault(kind, "outage_s"), "s", gone),
        (of_fault(kind, "recovery_s"), "s", left, recovery),
        (of_fault(kind, "recovered"), "bool", back, returned),
    )
    return (*times, *columns(110, (bound, "s", least)))


COLUMNS: Final = tuple(column for kind in _ORDER for column in declared(kind))


def note_file(kind: FaultKind) -> str:
    """Return the file that says how long the cause of a fault lasted, and how often the observer asked."""
    return f"fault-{kind}.txt"


def observed_file(kind: FaultKind) -> str:
    """Return the file of what the observer wrote.

    What its ping said; for a process that is killed, seconds since boot, and `up` with its ids, a line each time.
    """
    return f"fault-{kind}-{'watch' if kind is FaultKind.KILL else 'ping'}.txt"


def log_file(kind: FaultKind) -> str:
    """Return the file of what the job that wrote the note said on standard error."""
    return f"fault-{kind}.log"


@dataclass(frozen=True)
class Recovery:
    """Effect of one fault.

    Attributes:
        outage_s: Longest time between two answers, in seconds; None when the robot did not recover.
        recovery_s: What of it was left when the cause was over, never negative; None as `outage_s`, and where nobody
            knows how long the cause lasted.
        recovered: Whether the robot answered when the observer ended.
        recovery_at_least_s: Lower bound of `recovery_s` where it did not, as far as it was observed.
    """

    outage_s: float | None
    recovery_s: float | None
    recovered: bool
    recovery_at_least_s: float | None = None


@dataclass(frozen=True)
class _Note:
    """How long the cause lasted, None where nobody knows, and the time between two questions, in seconds."""

    lasted_s: float | None
    interval_s: float


@dataclass(frozen=True)
class _Answers:
    """Times of the robot's answers and of the observer's end, in seconds on one clock; who was there at both ends."""

    at_s: Sequence[float]
    end_s: float
    survivors: Set[str] = frozenset()


def read(folder: Path, kind: FaultKind, name: str = "") -> Recovery:
    """Return what the fault of this kind did, of the step of this name.

    Raises:
        EvidenceError: A file is missing or not whole, or the fault left no mark in it.
    """
    note = _note(folder / prefixed(name, note_file(kind)))
    path = folder / prefixed(name, observed_file(kind))
    answers = _watched(path) if kind is FaultKind.KILL else _pinged(path, note)
    if not answers.at_s:
        raise EvidenceError("the robot was not there before the fault", where=path.name)
    silent_s = answers.end_s - answers.at_s[-1]
    if silent_s >= SILENT_S:
        bound_s = None if note.lasted_s is None else max(0.0, silent_s - note.lasted_s)
        return Recovery(outage_s=None, recovery_s=None, recovered=False, recovery_at_least_s=bound_s)
    outage_s = max((after - before for before, after in pairwise(answers.at_s)), default=0.0)
    if answers.survivors or (kind is not FaultKind.KILL and outage_s < _least_s(note)):
        raise EvidenceError("the fault left no mark: what it should befall was there all the time", where=path.name)
    recovery_s = None if note.lasted_s is None else max(0.0, outage_s - note.lasted_s)
    return Recovery(outage_s=outage_s, recovery_s=recovery_s, recovered=True)


def cause_lasted_s(path: Path) -> float | None:
    """Return how long the cause of a fault lasted, by its note; None if that is unknown.

    Raises:
        EvidenceError: The note is missing or not whole.
    """
    return _note(path).lasted_s


def _least_s(note: _Note) -> float:
    """Return the shortest outage that a fault can have been; an operator's answers come late."""
    return max((note.lasted_s or 0.0) / 2, _UNREMARKABLE_INTERVALS * note.interval_s)


def _note(path: Path) -> _Note:
    match = _NOTE.match(reading.text(path))
    if match is None:
        raise EvidenceError("does not say how long the fault lasted", where=path.name)
    lasted = match["lasted"]
    return _Note(None if lasted == "unknown" else float(lasted), float(match["interval"]))


def _pinged(path: Path, note: _Note) -> _Answers:
    found = ping.read(path)
    if found.transmitted is None:
        raise EvidenceError("ping was cut short, its summary is missing", where=path.name)
    stamps_ns = [reply.at_utc_ns for reply in found.answers if reply.at_utc_ns is not None]
    numbers = [reply.seq for reply in found.answers]
    if len(stamps_ns) == len(numbers):
        at_s = [stamp_ns / 1e9 for stamp_ns in stamps_ns]
    else:  # busybox has no stamps, but asks as regularly
        at_s = [number * note.interval_s for number in numbers]
    unanswered = found.transmitted - (max(numbers, default=0) - found.first_seq + 1)
    return _Answers(sorted(at_s), max(at_s, default=0.0) + unanswered * note.interval_s)


def _watched(path: Path) -> _Answers:
    seen = [match for line in reading.text(path).split("\n") if (match := _SEEN.match(line))]
    up = [match for match in seen if match["pids"] is not None]
    survivors = set(up[0]["pids"].split()) & set(up[-1]["pids"].split()) if up else set()
    return _Answers([float(match["at"]) for match in up], float(seen[-1]["at"]) if seen else 0.0, survivors)


def measure(kind: FaultKind, found: Recovery | None) -> Measured:
    """Return the columns of a kind of fault; None where the evidence does not tell."""
    if found is None:
        return Measured.nothing(declared(kind), "what was observed is not at hand")
    gone = {of_fault(kind, "outage_s"): found.outage_s, of_fault(kind, "recovered"): found.recovered}
    left = {of_fault(kind, "recovery_s"): found.recovery_s}
    bound = {of_fault(kind, "recovery_at_least_s"): found.recovery_at_least_s}
    return (
        Measured.of(gone, "the robot did not recover")
        | Measured.of(left, "the time of the cause is unknown, or the robot did not recover")
        | Measured.of(bound, "the robot recovered, or the time of the cause is unknown")
    )
