"""Remove duplicate attempts from the combined rows of several tables. Contradictory tables are an error."""

from collections import Counter

import numpy as np

from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import format_count


def deduplicated(repeats: Repeats) -> tuple[Repeats, tuple[str, ...]]:
    """Return the first row of each attempt, and a note on each source from which rows were removed.

    Raises:
        ConfigurationError: Two sources have different values for an attempt.
    """
    attempts = repeats.codes(("trial", "protocol", "repeat", "attempt"))
    # Attempts without the name of a trial cannot be identified, so all of them are kept.
    unnamed = repeats.texts["trial"] == ""
    attempts[unnamed] = len(repeats) + np.flatnonzero(unnamed)
    _, kept_rows, attempt_of_row = np.unique(attempts, return_index=True, return_inverse=True)
    first_row_of_attempt = kept_rows[attempt_of_row]
    duplicates = np.flatnonzero(first_row_of_attempt != np.arange(len(repeats)))
    if not len(duplicates):
        return repeats, ()
    originals = first_row_of_attempt[duplicates]
    _check_equal(repeats.where(originals), repeats.where(duplicates))
    pairs = Counter(zip(repeats.texts[SOURCE][duplicates], repeats.texts[SOURCE][originals], strict=True))
    notes = tuple(
        f"{source}: {format_count(rows, 'row')} also in {kept}, counted once"
        for (source, kept), rows in pairs.items()
    )
    return repeats.where(np.sort(kept_rows)), notes


def _check_equal(kept: Repeats, other: Repeats) -> None:
    """Raise an error if two tables have different values in the same row."""
    differ = {name: column != other.texts[name] for name, column in kept.texts.items() if name != SOURCE}
    for name, column in kept.numbers.items():
        differ[name] = (column != other.numbers[name]) & ~(np.isnan(column) & np.isnan(other.numbers[name]))
    for name, column in differ.items():
        for index in np.flatnonzero(column)[:1]:
            raise ConfigurationError(
                f"{kept.name(index)} of {kept.texts['trial'][index]} has another {name} "
                f"than in {kept.texts[SOURCE][index]}",
                where=other.texts[SOURCE][index],
                remedy="name only one of these two sources",
            )
