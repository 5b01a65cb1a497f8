"""The first part of a report: description of the trials, warnings for readers who quote numbers, and provenance.

A cell contains the repeats under one condition, and their estimates.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.comparable import mixtures
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.wording import cautions, status_counts
from fieldkit.core.columns import plain_name
from fieldkit.core.model import Status
from fieldkit.core.units import format_count
from fieldkit.report import wording
from fieldkit.report.trial_folders import Evidence

_MAX_LIMITATIONS: Final = 20
"""Maximum number of warnings about evidence that is not available (`Evidence.limitations`)."""
_MAX_REASONS: Final = 50
"""Maximum number of different reasons in one warning."""


@dataclass(frozen=True)
class Caution:
    """A warning for a reader who quotes a number.

    Attributes:
        text: A sentence.
        reasons: Reasons, each with its count; a page shows them collapsed.
    """

    text: str
    reasons: Sequence[str] = ()


def paragraph(cells: Sequence[Cell], evidence: Evidence, sweep: Mapping[str, str]) -> str:
    """Return a paragraph about the trials or the sweep: procedures or factors, times, distances, protocols, attempts.

    Args:
        cells: Conditions.
        evidence: The table and the available evidence.
        sweep: Columns of the flow and the factors of a sweep, each with the column that contains its values as the
            user typed them; empty for trials.
    """
    repeats = evidence.repeats
    trials = format_count(len(set(repeats.texts["trial"].tolist())), "trial")
    subject = f"{trials} of {wording.join_names(_values(cells, 'procedure'))}"
    if sweep:
        flow, *factors = sweep
        settings = format_count(len(set(repeats.keys(factors))), "setting")
        subject = f"{settings} of {_factor_names(sweep)}; {wording.join_names(sorted(set(repeats.texts[flow])))}"
    return (
        f"{subject}{_start_text(repeats)}: {_distances(cells)}; "
        f"{wording.join_words([name.upper() for name in _values(cells, 'protocol')])}; "
        f"{_topologies(cells)}{wording.join_words(_values(cells, 'backend'))} robots. "
        f"{format_count(len(repeats), 'attempt')}: {status_counts(Counter(repeats.texts['status']))}. "
        "All figures use only the valid ones."
    )


def warnings(cells: Sequence[Cell], evidence: Evidence) -> Iterator[Caution]:
    """Yield the warnings for a reader who quotes numbers."""
    repeats = evidence.repeats
    for status in (Status.VOID, Status.FAILED):
        if (rows := repeats.texts["status"] == status).any():
            reasons = _count_reasons(repeats.texts["reason"][rows].tolist())
            yield Caution(f"{format_count(int(rows.sum()), 'attempt')} {status}.", reasons)
    if invalid_cells := [cell for cell in cells if not cell.n_valid]:
        differing = wording.differing(cells)
        places = [wording.condition(cell, differing=differing) for cell in invalid_cells]
        yield Caution(f"No valid repeat in {format_count(len(invalid_cells), 'condition')}.", places)
    for caution in cautions(cells):
        yield Caution(f"{caution}.".replace(" %", "\N{NO-BREAK SPACE}%"))
    if single_count := sum(cell.n_valid == 1 for cell in cells):
        total = format_count(len(cells), "condition")
        yield Caution(
            f"A single valid repeat in {single_count} of {total}, so only figures that are true or false have an "
            "interval there."
        )
    valid = repeats.where(repeats.texts["status"] == Status.VALID)
    columns = [texts for name, texts in valid.texts.items() if plain_name(name) == "one_way_withheld"]
    withheld_reasons = [reasons for reasons in zip(*columns, strict=True) if any(reasons)]
    if withheld_reasons:
        reasons = _count_reasons([reason for row_reasons in withheld_reasons for reason in row_reasons if reason])
        count = format_count(len(withheld_reasons), "valid repeat")
        yield Caution(f"One-way delay withheld, completely or partly, in {count}.", reasons)
    if marked_reasons := [reason for reason in valid.texts.get("marks_reason", ()) if reason]:
        count = format_count(len(marked_reasons), "valid repeat")
        yield Caution(
            f"{count} marked: conditions of the robots can explain differences.", _count_reasons(marked_reasons)
        )
    yield from map(Caution, mixtures(repeats))
    if (version_count := len(np.unique(repeats.numbers["schema_version"]))) > 1:
        yield Caution(
            f"{version_count} versions of the tables: columns that an older version lacks are missing unless tables "
            "are rebuilt."
        )
    yield from map(Caution, evidence.limitations[:_MAX_LIMITATIONS])
    if (more_count := len(evidence.limitations) - _MAX_LIMITATIONS) > 0:
        yield Caution(
            f"Not shown: {format_count(more_count, 'further note')} of this kind; fieldkit verify lists them for a "
            "trial."
        )


def _values(cells: Sequence[Cell], name: str) -> list[str]:
    return sorted({wording.text(cell, name) or "unknown" for cell in cells})


def _topologies(cells: Sequence[Cell]) -> str:
    topologies = sorted({name for cell in cells if (name := wording.text(cell, "topology"))})
    return f"{wording.join_words(topologies)}; " if topologies else ""


def _distances(cells: Sequence[Cell]) -> str:
    placed_cells = sorted((cell for cell in cells if cell.key["distance_m"] is not None), key=wording.metres)
    if not placed_cells:
        return "distances unknown"
    ends = list(dict.fromkeys(wording.distance(cell) for cell in (placed_cells[0], placed_cells[-1])))
    return " to ".join(ends)


def _start_text(repeats: Repeats) -> str:
    starts_ns = repeats.numbers["started_utc_ns"]
    known_starts = starts_ns[np.isfinite(starts_ns)]
    if not len(known_starts):
        return ""
    first, last = (utc(float(end)) for end in (known_starts.min(), known_starts.max()))
    if first[:10] == last[:10]:
        return f" on {first[:10]} from {first[11:]} to {last[11:]} UTC" if first != last else f" on {first} UTC"
    return f" from {first} to {last} UTC"


def utc(at_ns: float) -> str:
    """Return a time, given in nanoseconds since 1970 UTC, as date and time to the minute."""
    return datetime.fromtimestamp(at_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M")


def _count_reasons(reasons: Sequence[str]) -> list[str]:
    """Return the reasons with their counts, the most frequent first."""
    counts = Counter(reason or "no reason given" for reason in reasons)
    ordered_reasons = sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))
    lines = [f"{reason} ({count})" for reason, count in ordered_reasons[:_MAX_REASONS]]
    remaining = ordered_reasons[_MAX_REASONS:]
    return (
        [*lines, f"{format_count(len(remaining), 'other reason')} ({sum(count for _, count in remaining)})"]
        if remaining
        else lines
    )


def _factor_names(sweep: Mapping[str, str]) -> str:
    return wording.join_names(list(sweep.values())[1:])


def title(cells: Sequence[Cell], sweep: Mapping[str, str]) -> str:
    """Return the default title of a report; see `paragraph` for `sweep`."""
    if len(sweep) > 1:
        return f"Sweep over {_factor_names(sweep)}"
    return f"Loss and delay: {wording.join_names(_values(cells, 'procedure'))}"


@dataclass(frozen=True)
class Provenance:
    """The provenance of one trial.

    Attributes:
        name: Its name.
        source: Its folder, or the table with its rows.
        has_evidence: True if its folder is available and the plan in it can be read.
        start_text: Start of its first attempt, to the minute in UTC; empty if unknown.
        robots: Sender and receiver, and the relay if there is one.
        attempts: Numbers of attempts by status.
        seed: Its seed; empty if unknown.
        hashes: Hashes of code, procedure and profiles; a missing hash is an empty text.
        versions: Versions of its programs; empty if its plan is not available.
        notes: The operator's notes; empty if its plan is not available.
    """

    name: str
    source: Path
    has_evidence: bool
    start_text: str
    robots: str
    attempts: str
    seed: str
    hashes: Sequence[str]
    versions: str
    notes: str


_HASHES: Final = ("code_sha256", "procedure_sha256", "profiles_sha256")


def trial_provenance(evidence: Evidence) -> Iterator[Provenance]:
    """Yield the provenance of every trial in the table, in the order of the rows."""
    texts = evidence.repeats.texts
    rows: dict[tuple[str, str], list[int]] = {}
    for row, key in enumerate(zip(texts["trial"].tolist(), texts["source"].tolist(), strict=True)):
        rows.setdefault(key, []).append(row)
    for (name, source), row_numbers in rows.items():
        yield _provenance_of(name, Path(source), row_numbers, evidence)


def _provenance_of(name: str, source: Path, rows: list[int], evidence: Evidence) -> Provenance:
    texts, numbers = evidence.repeats.texts, evidence.repeats.numbers
    first, plan = rows[0], evidence.plan(rows[0])
    relay = texts["relay"][first]
    starts_ns = numbers["started_utc_ns"][rows]
    return Provenance(
        name=name,
        source=source,
        has_evidence=plan is not None,
        start_text=utc(float(np.nanmin(starts_ns))) if np.isfinite(starts_ns).any() else "",
        robots=f"{texts['sender'][first]} to {texts['receiver'][first]}" + (f" via {relay}" if relay else ""),
        attempts=status_counts(Counter(texts["status"][rows])),
        seed="" if np.isnan(numbers["seed"][first]) else f"{numbers['seed'][first]:.0f}",
        hashes=[texts[name][first] for name in _HASHES],
        versions=", ".join(f"{program} {number}" for program, number in plan.versions.items()) if plan else "",
        notes=plan.notes if plan else "",
    )
