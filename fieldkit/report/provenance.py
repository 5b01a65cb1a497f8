"""Provenance of a report, trial by trial: robots, seeds, hashes, versions."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.analysis.wording import status_counts
from fieldkit.report import summary
from fieldkit.report.evidence import Evidence


@dataclass(frozen=True)
class Provenance:
    """The provenance of one trial.

    Attributes:
        name: Its name.
        source: Its folder, or the table with its rows.
        has_evidence: True if its raw evidence is available.
        began: Start of its first attempt, as text.
        robots: Sender, receiver and relay.
        attempts: Numbers of attempts by status.
        seed: Its seed.
        hashes: Hashes of code, procedure and profiles; empty if missing.
        versions: Versions of its programs; empty if its folder is not available.
        notes: The operator's notes.
    """

    name: str
    source: Path
    has_evidence: bool
    began: str
    robots: str
    attempts: str
    seed: str
    hashes: Sequence[str]
    versions: str
    notes: str


_HASHES: Final = ("code_sha256", "procedure_sha256", "profiles_sha256")


def trials(evidence: Evidence) -> Iterator[Provenance]:
    """Yield every trial in the table, in the order of its rows."""
    texts = evidence.repeats.texts
    rows: dict[tuple[str, str], list[int]] = {}
    for row, key in enumerate(zip(texts["trial"].tolist(), texts["source"].tolist(), strict=True)):
        rows.setdefault(key, []).append(row)
    for (name, source), row_numbers in rows.items():
        yield _trial(name, Path(source), row_numbers, evidence)


def _trial(name: str, source: Path, rows: list[int], evidence: Evidence) -> Provenance:
    texts, numbers = evidence.repeats.texts, evidence.repeats.numbers
    first, plan = rows[0], evidence.plan(rows[0])
    relay = texts["relay"][first]
    started = numbers["started_utc_ns"][rows]
    return Provenance(
        name=name,
        source=source,
        has_evidence=plan is not None,
        began=summary.utc(float(np.nanmin(started))) if np.isfinite(started).any() else "",
        robots=f"{texts['sender'][first]} to {texts['receiver'][first]}" + (f" by {relay}" if relay else ""),
        attempts=status_counts(Counter(texts["status"][rows])),
        seed="" if np.isnan(numbers["seed"][first]) else f"{numbers['seed'][first]:.0f}",
        hashes=[texts[name][first] for name in _HASHES],
        versions=", ".join(f"{program} {number}" for program, number in plan.versions.items()) if plan else "",
        notes=plan.notes if plan else "",
    )
