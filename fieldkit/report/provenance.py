"""Provenance of a report, trial by trial: robots, seeds, hashes, versions."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.analysis.wording import ended
from fieldkit.report import summary
from fieldkit.report.evidence import Evidence


@dataclass(frozen=True)
class Provenance:
    """What the rows of one trial come from.

    Attributes:
        name: Its name.
        source: Its folder, or the table that its rows were read from.
        is_at_hand: Whether its raw evidence is.
        began: When its first attempt began, in words.
        robots: Who sent to whom, and by whom.
        attempts: How they ended.
        seed: Its seed.
        hashes: Of code, procedure and profiles; empty where missing.
        versions: Of the programs that made it, in words; empty when its folder is not at hand.
        notes: The operator's.
    """

    name: str
    source: Path
    is_at_hand: bool
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
    for (name, source), mine in rows.items():
        yield _trial(name, Path(source), mine, evidence)


def _trial(name: str, source: Path, rows: list[int], evidence: Evidence) -> Provenance:
    texts, numbers = evidence.repeats.texts, evidence.repeats.numbers
    first, plan = rows[0], evidence.plan(rows[0])
    relay = texts["relay"][first]
    started = numbers["started_utc_ns"][rows]
    return Provenance(
        name=name,
        source=source,
        is_at_hand=plan is not None,
        began=summary.utc(float(np.nanmin(started))) if np.isfinite(started).any() else "",
        robots=f"{texts['sender'][first]} to {texts['receiver'][first]}" + (f" by {relay}" if relay else ""),
        attempts=ended(Counter(texts["status"][rows])),
        seed="" if np.isnan(numbers["seed"][first]) else f"{numbers['seed'][first]:.0f}",
        hashes=[texts[name][first] for name in _HASHES],
        versions=", ".join(f"{what} {number}" for what, number in plan.versions.items()) if plan else "",
        notes=plan.notes if plan else "",
    )
