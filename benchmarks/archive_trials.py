"""A synthetic lab archive: trials in the real format, made from the trials in `tests/data`.

Each trial has the `trial.yaml` of a stored trial and a `trial.csv` with its columns. Names, distances and times
differ; durations are scaled and ping losses are drawn at random, with a fixed seed. About 2 % of the rows are marked
as failed.
"""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

ROOT: Final = Path(__file__).resolve().parents[1]
STORED: Final = ROOT / "tests" / "data" / "fieldkit"
TRIALS_PER_FOLDER: Final = 100
START_NS: Final = 1_700_000_000 * 10**9
_PINGS: Final = 10
"""Echo requests in each repeat."""
_SCALED: Final = ("rtt_min_s", "rtt_median_s", "rtt_mean_s", "rtt_p95_s", "rtt_max_s", "rtt_jitter_s", "delay_s")
"""Columns that are multiplied by a random factor."""
_KINDS: Final = (*("_los_",) * 7, "evidence", "selfheal", "driveaway")
"""Parts of names of stored trials: trial n of the archive copies a stored trial whose name contains element n % 10.

Seven of ten trials therefore have the procedure los. The plan of the trial `evidence` declares many columns (42).
"""


@dataclass(frozen=True)
class StoredTrial:
    """A trial that is copied.

    Attributes:
        name: Name of its folder.
        plan: The text of its `trial.yaml`.
        header: The columns of its table.
        rows: The valid rows of its table.
    """

    name: str
    plan: str
    header: Sequence[str]
    rows: Sequence[Mapping[str, str]]


def stored_trials() -> list[StoredTrial]:
    """Return the trials in the folders `4` and `evidence` of `tests/data/fieldkit`."""
    trials = []
    for folder in (*sorted((STORED / "4" / "trials").iterdir()), *(STORED / "evidence").iterdir()):
        table = csv.DictReader(io.StringIO((folder / "trial.csv").read_text(encoding="utf-8")))
        rows = [row for row in table if row["status"] == "valid"]
        plan = (folder / "trial.yaml").read_text(encoding="utf-8")
        trials.append(StoredTrial(folder.name, plan, table.fieldnames or (), rows))
    return trials


def write_archive(folder: Path, trials: int, repeats: int) -> None:
    """Write trials of `repeats` rows each into a tree of folders."""
    generator = np.random.default_rng(1)
    stored = stored_trials()
    for number in range(trials):
        kind = _KINDS[number % len(_KINDS)]
        candidates = [trial for trial in stored if kind in trial.name]
        original = candidates[number // len(_KINDS) % len(candidates)]
        distance_m = 5 * (1 + number // len(_KINDS) % 12)
        name = f"20260101T{number:06d}.000000Z{original.name.rsplit('Z', 1)[1]}"
        path = folder / f"campaign-{number // TRIALS_PER_FOLDER:03d}" / name
        path.mkdir(parents=True)
        plan = original.plan.replace(original.name, name).replace(
            f"distance_m: {original.rows[0]['distance_m']}", f"distance_m: {distance_m}"
        )
        (path / "trial.yaml").write_text(plan, encoding="utf-8")
        fixed = {"trial": name, "distance_m": str(distance_m), "distance": f"{distance_m}m"}
        with (path / "trial.csv").open("w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(file, original.header, lineterminator="\n")
            table.writeheader()
            table.writerows(_rows(generator, original, fixed, number, repeats))


def _rows(
    generator: np.random.Generator, original: StoredTrial, fixed: Mapping[str, str], number: int, repeats: int
) -> Iterator[dict[str, str]]:
    """Yield the rows of a trial: copies of stored rows, in which times are scaled and ping losses are drawn."""
    protocols = list(dict.fromkeys(row["protocol"] for row in original.rows))
    by_protocol = {name: next(row for row in original.rows if row["protocol"] == name) for name in protocols}
    for repeat in range(repeats):
        row = {**by_protocol[protocols[repeat % len(protocols)]], **fixed}
        scale = generator.uniform(0.5, 2)
        arrived = int(generator.binomial(_PINGS, 0.98)) or 1
        row |= {name: f"{float(row[name]) * scale:.9g}" for name in _SCALED if row.get(name)}
        if row.get("rtt_sent") == str(_PINGS):
            row |= {"rtt_received": str(arrived), "rtt_loss": f"{1 - arrived / _PINGS:.9g}"}
        row |= {
            "repeat": str(1 + repeat // len(protocols)),
            "attempt": "1",
            "started_utc_ns": str(START_NS + (number * repeats + repeat) * 10**10),
        }
        if generator.random() < 0.02:
            row |= {"status": "failed", "reason": "the control link was lost"}
        yield row
