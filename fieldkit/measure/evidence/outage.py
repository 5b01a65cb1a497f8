"""Outage of a robot caused by an injected fault, computed from the file of an observer.

The observer is the sender, or the receiver if the sender has the fault; it pings the robot with the fault. If a
process is killed, the observer is the robot itself, which polls the process; a poll that finds the process running
counts as an answer.

All times are by the observer's clock, and the resolution is the interval of pings or polls: if two consecutive
answers are a time G apart, the outage lasted at most G, and at least G minus two intervals.

The cause of a fault is the injected action, such as a link that is taken down; its duration is recorded in a note
file. The outage is the time in which the observer receives no answer.
"""

import re
from collections.abc import Sequence, Set
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Measured, fault_column_name, step_prefixed
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind
from fieldkit.measure.evidence import ping, reading
from fieldkit.measure.evidence.outage_columns import fault_columns

MIN_SILENCE_S: Final = 1.0
"""A robot has not recovered if its last answer is at least this old at the end of the observation."""

# Gaps up to this length also occur without a fault. A reboot, or an excursion out of radio range, takes longer.
_MAX_NORMAL_GAP_INTERVALS: Final = 3

_NUMBER: Final = r"[0-9]{1,9}(?:\.[0-9]{1,9})?"
_NOTE: Final = re.compile(rf"lasted_s (?P<lasted>{_NUMBER}|unknown)\ninterval_s (?P<interval>{_NUMBER})\n")
_WATCH_LINE: Final = re.compile(rf"(?P<at>{_NUMBER})(?: up(?P<pids>(?: [0-9]{{1,9}})+))?\Z")


def note_file(kind: FaultKind) -> str:
    """Return the name of the file with the duration of a fault's cause and the interval of its observer."""
    return f"fault-{kind}.txt"


def observed_file(kind: FaultKind) -> str:
    """Return the name of the observer's file.

    It contains the output of ping. For a killed process, it has a line per observation: the seconds since boot and,
    if the process runs, `up` and the process IDs.
    """
    return f"fault-{kind}-{'watch' if kind is FaultKind.KILL else 'ping'}.txt"


def log_file(kind: FaultKind) -> str:
    """Return the name of the file with the standard error of the job that injected the fault."""
    return f"fault-{kind}.log"


@dataclass(frozen=True)
class Recovery:
    """Effect of one fault.

    Attributes:
        outage_s: Longest time between two answers, in seconds, 0 for a single answer; None if the robot did not
            recover.
        recovery_s: Part of the outage after the end of the cause, never negative; None if `outage_s` is None or the
            duration of the cause is unknown.
        recovered: True if the last answer is less than `MIN_SILENCE_S` before the end of the observation.
        recovery_at_least_s: Lower bound of `recovery_s` if the robot did not recover; None if it recovered, or if
            the duration of the cause is unknown.
    """

    outage_s: float | None
    recovery_s: float | None
    recovered: bool
    recovery_at_least_s: float | None = None


@dataclass(frozen=True)
class _Note:
    """Duration of the cause (None if unknown) and interval of the observer, in seconds."""

    cause_s: float | None
    interval_s: float


@dataclass(frozen=True)
class _Answers:
    """Times of the answers and end of the observation by the observer's clock; process IDs that did not change.

    For a killed process, the answers are the observations in which it was running, and the unchanged process IDs are
    those in both the first and the last answer; there are none for other faults.
    """

    at_s: Sequence[float]
    end_s: float
    unchanged_pids: Set[str] = frozenset()


def read(folder: Path, kind: FaultKind, name: str = "") -> Recovery:
    """Return the effect of a fault.

    Args:
        folder: The attempt's folder.
        kind: Kind of the fault.
        name: Name of the step; empty if the step has no name.

    Raises:
        EvidenceError: A file is missing or incomplete, or shows no effect of the fault.
    """
    note = _read_note(folder / step_prefixed(name, note_file(kind)))
    path = folder / step_prefixed(name, observed_file(kind))
    answers = _process_answers(path) if kind is FaultKind.KILL else _ping_answers(path, note)
    if not answers.at_s:
        raise EvidenceError("the robot or process did not answer before the fault", where=path.name)
    silence_s = answers.end_s - answers.at_s[-1]
    if silence_s >= MIN_SILENCE_S:
        bound_s = None if note.cause_s is None else max(0.0, silence_s - note.cause_s)
        return Recovery(outage_s=None, recovery_s=None, recovered=False, recovery_at_least_s=bound_s)
    outage_s = max((after - before for before, after in pairwise(answers.at_s)), default=0.0)
    if answers.unchanged_pids or (kind is not FaultKind.KILL and outage_s < _min_outage_s(note)):
        raise EvidenceError("the fault had no effect: its target answered during the whole fault", where=path.name)
    recovery_s = None if note.cause_s is None else max(0.0, outage_s - note.cause_s)
    return Recovery(outage_s=outage_s, recovery_s=recovery_s, recovered=True)


def cause_duration_s(path: Path) -> float | None:
    """Return the duration of the cause of a fault from its note, in seconds; None if unknown.

    Raises:
        EvidenceError: The note is missing or incomplete.
    """
    return _read_note(path).cause_s


def _min_outage_s(note: _Note) -> float:
    """Return the shortest plausible outage in seconds.

    An operator who causes the fault by hand may act late, so the outage may be as short as half of the recorded
    duration of the cause.
    """
    return max((note.cause_s or 0.0) / 2, _MAX_NORMAL_GAP_INTERVALS * note.interval_s)


def _read_note(path: Path) -> _Note:
    match = _NOTE.match(reading.text(path))
    if match is None:
        raise EvidenceError("does not contain the duration of the fault", where=path.name)
    duration = match["lasted"]
    return _Note(None if duration == "unknown" else float(duration), float(match["interval"]))


def _ping_answers(path: Path, note: _Note) -> _Answers:
    """Return the answers in the output of the observer's ping.

    Raises:
        EvidenceError: The output is missing or has no summary.
    """
    output = ping.read(path)
    if output.transmitted is None:
        raise EvidenceError("ping was stopped before its summary", where=path.name)
    stamps_ns = [reply.at_utc_ns for reply in output.answers if reply.at_utc_ns is not None]
    numbers = [reply.seq for reply in output.answers]
    if len(stamps_ns) == len(numbers):
        at_s = [stamp_ns / 1e9 for stamp_ns in stamps_ns]
    else:  # busybox prints no time stamps, but sends requests at the same intervals
        at_s = [number * note.interval_s for number in numbers]
    unanswered = output.transmitted - (max(numbers, default=0) - output.first_seq + 1)
    return _Answers(sorted(at_s), max(at_s, default=0.0) + unanswered * note.interval_s)


def _process_answers(path: Path) -> _Answers:
    matches = [match for line in reading.text(path).split("\n") if (match := _WATCH_LINE.match(line))]
    up = [match for match in matches if match["pids"] is not None]
    unchanged_pids = set(up[0]["pids"].split()) & set(up[-1]["pids"].split()) if up else set()
    return _Answers(
        [float(match["at"]) for match in up], float(matches[-1]["at"]) if matches else 0.0, unchanged_pids
    )


def measure(kind: FaultKind, effect: Recovery | None) -> Measured:
    """Return the columns of a kind of fault. `effect` is None if the evidence is not available."""
    if effect is None:
        return Measured.all_missing(fault_columns(kind), "the observation is not available")
    outage = {
        fault_column_name(kind, "outage_s"): effect.outage_s,
        fault_column_name(kind, "recovered"): effect.recovered,
    }
    recovery = {fault_column_name(kind, "recovery_s"): effect.recovery_s}
    bound = {fault_column_name(kind, "recovery_at_least_s"): effect.recovery_at_least_s}
    return (
        Measured.from_optional(outage, "the robot did not recover")
        | Measured.from_optional(recovery, "the duration of the cause is unknown, or the robot did not recover")
        | Measured.from_optional(bound, "the robot recovered, or the duration of the cause is unknown")
    )
