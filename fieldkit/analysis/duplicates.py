"""Remove duplicate attempts from the combined rows of several tables. Contradictory tables are an error."""

from collections import Counter

import numpy as np

from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import format_count


def deduplicated(repeats: Repeats) -> tuple[Repeats, tuple[str, ...]]:
    """Return the first row of each attempt, and notes on the removed rows.

    Rows without the name of a trial are all kept. There is a note for each pair of a source whose rows were removed,
    and the source with the first rows of these attempts.

    Raises:
        ConfigurationError: Two rows have different values for an attempt.
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
        f"{source}: {format_count(rows, 'row')} also in {first_source}, counted once"
        for (source, first_source), rows in pairs.items()
    )
    return repeats.where(np.sort(kept_rows)), notes


def _check_equal(originals: Repeats, duplicates: Repeats) -> None:
    """Raise an error if a duplicate row has another value than its original, the row with the same index."""
    differs = {name: column != duplicates.texts[name] for name, column in originals.texts.items() if name != SOURCE}
    for name, column in originals.numbers.items():
        duplicate = duplicates.numbers[name]
        differs[name] = (column != duplicate) & ~(np.isnan(column) & np.isnan(duplicate))
    for name, column in differs.items():
        for index in np.flatnonzero(column)[:1]:
            raise ConfigurationError(
                f"{originals.name(index)} of {originals.texts['trial'][index]} has another {name} "
                f"than in {originals.texts[SOURCE][index]}",
                where=duplicates.texts[SOURCE][index],
                remedy="name only one of these two sources",
            )
