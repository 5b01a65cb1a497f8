"""Comparison of a trial's files with its manifest."""

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.text import sanitized
from fieldkit.trial import manifest, store
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.store import MANIFEST_FILE
from fieldkit.trial.stored import plans

_MAX_LISTED: Final = 5


def verify(folder: Path) -> list[str]:
    """Compare a trial's files with its manifest.

    Returns:
        One sentence per difference, sorted by file; empty if there are no differences.

    Raises:
        EvidenceError: There is no manifest, or it cannot be read.
    """
    sums = manifest.read(folder)
    unexpected = {str(path.relative_to(folder)): kind for path, kind in plans.unexpected_files(folder)}
    present = {manifest.relative_name(folder, path): path for path in manifest.plain_files(folder)}
    present.pop(MANIFEST_FILE, None)
    return _sentences(_file_differences(sums.keys() - unexpected.keys(), sums, present) | unexpected)


def differences(folder: Path, attempts: Iterable[str] | None = None) -> Mapping[str, str]:
    """Return the changes of evidence since its checksums were computed, by file.

    Files of attempts without checksums are ignored.

    Args:
        folder: The trial's folder. Without a manifest, there are no differences.
        attempts: Names of the attempts' folders; None for all attempts, plan, journals and position files.

    Raises:
        EvidenceError: The manifest cannot be read.
    """
    if not (folder / MANIFEST_FILE).exists():
        return {}
    sums = manifest.read(folder)
    sums_by_attempt = manifest.by_attempt(sums)
    top_level = _top_level_differences(folder, sums) if attempts is None else {}
    selected = sums_by_attempt.keys() if attempts is None else sums_by_attempt.keys() & set(attempts)

    def compare(attempt: str) -> dict[str, str]:
        present = {
            manifest.relative_name(folder, path): path
            for path in manifest.plain_files(store.attempt_folder(folder, attempt))
        }
        return _file_differences(sums_by_attempt[attempt].keys(), sums_by_attempt[attempt], present)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return top_level | {
            name: change for changes in pool.map(compare, selected) for name, change in changes.items()
        }


def _top_level_differences(folder: Path, sums: manifest.Sums) -> dict[str, str]:
    """Return the changes of the plan, the journals and position files.

    Lines may have been appended to journals since their checksums were computed.
    """
    changed = {PLAN_FILE: PLAN_FILE in sums and manifest.sha256(folder / PLAN_FILE) != sums[PLAN_FILE]}
    for name in (JOURNAL_FILE, laptop_files.MOTION):
        changed[name] = name in sums and manifest.count_unchanged_lines(folder / name, sums[name]) is None
    for name in filter(manifest.is_positions, sums.keys() | {path.name for path in folder.iterdir()}):
        changed[name] = not (folder / name).is_file() or manifest.sha256(folder / name) != sums.get(name)
    return {name: "changed" for name, is_changed in changed.items() if is_changed}


def summarize(problems: Mapping[str, str]) -> str:
    """Return a sentence with the first differences (at most 5) and the number of further differences."""
    sentences = _sentences(problems)
    further = len(sentences) - _MAX_LISTED
    more_text = f"; and {further} more: fieldkit verify lists them" if further > 0 else ""
    return "; ".join(sentences[:_MAX_LISTED]) + more_text


def _file_differences(names: Iterable[str], sums: manifest.Sums, present: Mapping[str, Path]) -> dict[str, str]:
    listed_names = set(names)
    problems = dict.fromkeys(listed_names - present.keys(), "missing")
    problems |= dict.fromkeys(present.keys() - sums.keys(), "not in the manifest")
    problems |= {
        name: "changed" for name in listed_names & present.keys() if manifest.sha256(present[name]) != sums[name]
    }
    return problems


def _sentences(problems: Mapping[str, str]) -> list[str]:
    return [f"{sanitized(name).replace(chr(10), '?')}: {problem}" for name, problem in sorted(problems.items())]
