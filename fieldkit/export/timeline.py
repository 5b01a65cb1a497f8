"""The timeline of a trial as messages of an MCAP file, from its journal and raw evidence.

Laptop, sender and receiver have separate clocks; the metadata of a channel contain its clock. Only the times of
recorded positions are converted: to the laptop's clock.
"""

import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Final

from fieldkit.core import geometry
from fieldkit.core.errors import EvidenceError, shell_command
from fieldkit.core.model import FINAL_STATUSES, Role, Status, Vector
from fieldkit.export import robot_messages, schemas
from fieldkit.export.mcap import Channel, Json, Message
from fieldkit.export.schemas import Level
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import track
from fieldkit.measure.positions import position_sources, recorded_positions
from fieldkit.measure.positions.samples import WGS84, Samples
from fieldkit.trial import journal, rows, store
from fieldkit.trial.journal import Attempt, JournalEntry
from fieldkit.trial.plan import Plan

_Evidence = Callable[[Attempt], AttemptEvidence]
"""Function that returns the evidence of an attempt. It keeps the evidence of the last `_OPEN_ATTEMPTS` attempts."""

_OPEN_ATTEMPTS: Final = 2
"""Number of attempts whose evidence is in memory."""
_LAPTOP: Final = "laptop"
_LEVELS: Final = {Status.VOID: Level.WARNING, Status.FAILED: Level.ERROR}

_LOG: Final = Channel("/trial/log", schemas.LOG, _LAPTOP, "Status of each attempt from the journal.")
_PLACES: Final = Channel(
    "/tf", schemas.TRANSFORMS, _LAPTOP, "Positions of the robots, recorded or planned: metres east, north, up."
)


def about(plan: Plan) -> dict[str, str]:
    """Return the metadata of a trial for the file."""
    return {
        "trial": plan.trial,
        "procedure": plan.procedure.name,
        "scenario": plan.procedure.scenario,
        "topology": plan.topology,
        "backend": plan.backend,
        "distance": plan.distance,
        "notes": plan.notes,
        "schema_version": str(plan.schema_version),
        "code_sha256": plan.code_sha256,
        **{role: member.name for role, member in plan.cast.items()},
    }


def messages(folder: Path, plan: Plan) -> Iterator[Message]:
    """Return the messages of a trial, in the order of their times. Differences between its clocks are ignored.

    The streams advance through the attempts together, so that few attempts are in memory at a time, and each attempt
    is read once.

    Args:
        folder: The trial's folder.
        plan: Plan of the trial.

    Raises:
        EvidenceError: No attempt has ended, or the journal is damaged.
    """
    entries = journal.history(folder, plan)
    attempts = journal.ended_attempts(entries)
    if not attempts:
        raise EvidenceError(
            "no repeat has ended yet", where=str(folder), remedy=shell_command("fieldkit", "resume", folder)
        )
    # Planned and measured positions have different origins, so a file has only one kind.
    folders = (folder, *(store.attempt_folder(folder, attempt.folder) for attempt in attempts))
    has_positions = any(
        (position_folder / name).exists()
        for position_folder in folders
        for name in (track.FILE, position_sources.FILE)
    )
    ended_ns = {(entry.repeat, entry.attempt): entry.utc_ns for entry in entries if entry.status in FINAL_STATUSES}

    @lru_cache(maxsize=_OPEN_ATTEMPTS)
    def evidence(attempt: Attempt) -> AttemptEvidence:
        return AttemptEvidence(store.attempt_folder(folder, attempt.folder))

    streams = (
        _laptop(plan, evidence, entries, planned=not has_positions),
        _robots(plan, evidence, attempts),
        _tracks(plan, evidence, [(attempt, ended_ns[attempt.repeat, attempt.number]) for attempt in attempts]),
    )
    return heapq.merge(*streams, key=attrgetter("time_ns"))


def _laptop(plan: Plan, evidence: _Evidence, entries: list[JournalEntry], *, planned: bool) -> Iterator[Message]:
    """Yield the journal's entries, the planned places at the start of each attempt, and its numbers at the end."""
    ended = iter(journal.ended_attempts(entries))
    for line, entry in enumerate(entries, start=1):
        if entry.status is Status.PLANNED:
            continue
        yield Message(_LOG, entry.utc_ns, _log_message(entry, line))
        if entry.status is Status.RUNNING:
            yield from _places(plan, entry.utc_ns) if planned else ()
        elif entry.status is not Status.MEASURED:  # the attempt has ended
            attempt = next(ended)
            yield _numbers(plan, attempt, evidence(attempt), entry.utc_ns)


def _log_message(entry: JournalEntry, line: int) -> Json:
    level = _LEVELS.get(entry.status, Level.INFO)
    text = ": ".join(filter(None, (f"attempt {entry.attempt} {entry.status}", entry.reason)))
    return schemas.log(entry.utc_ns, level, text, name=str(entry.repeat), file=journal.JOURNAL_FILE, line=line)


def _places(plan: Plan, t_ns: int) -> Iterator[Message]:
    for role, position_m in geometry.positions_m(plan.placement).items():
        if role in plan.cast:
            yield _place(plan, role, t_ns, position_m)


def _tracks(plan: Plan, evidence: _Evidence, attempts: Iterable[tuple[Attempt, int]]) -> Iterator[Message]:
    """Yield the positions of robots, attempt by attempt.

    These are the recorded positions of a robot or, if it has none, its positions from the testbed.
    """
    for attempt, ended_ns in attempts:
        samples_by_role = recorded_positions.readable_samples(evidence(attempt))
        # A position from before the start of the attempt is reported at the start.
        attempt_messages = [
            _place(plan, point.role, max(point.utc_ns, attempt.started_utc_ns), point.position_m)
            for point in evidence(attempt).read_or_none(track.read, track.FILE) or ()
            if point.position_m is not None and point.role in plan.cast.keys() - samples_by_role.keys()
        ]
        for role in filter(samples_by_role.__contains__, plan.cast):
            attempt_messages += _sampled(plan, role, samples_by_role[role], attempt.started_utc_ns, ended_ns)
        yield from sorted(attempt_messages, key=attrgetter("time_ns"))


def _sampled(plan: Plan, role: Role, samples: Samples, started_ns: int, ended_ns: int) -> Iterator[Message]:
    """Yield the sampled positions of a robot during an attempt.

    Positions in a local frame are omitted if their height is unknown.
    """
    first = max(int(samples.times_ns.searchsorted(started_ns, side="right")) - 1, 0)
    last = int(samples.times_ns.searchsorted(ended_ns, side="right"))
    for at_ns, place in zip(samples.times_ns[first:last].tolist(), samples.values[first:last].tolist(), strict=True):
        if samples.frame == WGS84 or math.isfinite(place[2]):
            yield _place(plan, role, max(at_ns, started_ns), place, samples.frame.removeprefix("frame "))


def _place(plan: Plan, role: Role, t_ns: int, place: Vector, frame: str = "field") -> Message:
    name = plan.cast[role].name
    if frame == WGS84:
        channel = Channel(f"/{role}/location", schemas.LOCATION, _LAPTOP, "Geographic position of the robot.")
        return Message(channel, t_ns, schemas.location(t_ns, name, place))
    return Message(_PLACES, t_ns, schemas.transform(t_ns, name, place, frame))


def _numbers(plan: Plan, attempt: Attempt, evidence: AttemptEvidence, t_ns: int) -> Message:
    meaning = "Measured numbers of each attempt, at the end of the attempt."
    channel = Channel(f"/repeat/{attempt.repeat.protocol}", schemas.repeat_schema(plan.table), _LAPTOP, meaning)
    row = rows.measure_row(plan, attempt, evidence)
    return Message(channel, t_ns, schemas.repeat(t_ns, attempt.folder, row, plan.table))


def _robots(plan: Plan, evidence: _Evidence, attempts: Iterable[Attempt]) -> Iterator[Message]:
    """Yield the messages of the robots' recordings, attempt by attempt."""
    for attempt in attempts:
        record = robot_messages.read(plan, attempt, evidence(attempt))
        yield from (Message(_LOG, attempt.started_utc_ns, omission) for omission in robot_messages.omissions(record))
        yield from robot_messages.messages(record)
