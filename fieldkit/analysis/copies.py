"""The same attempt from several places: a folder that was copied, a table beside the trial that it is of."""

from collections import Counter
from itertools import count

import numpy as np

from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.core.errors import ConfigurationError


def once(repeats: Repeats) -> tuple[Repeats, tuple[str, ...]]:
    """Return each attempt once, where it is first, and a note on each source of which something was left out.

    Raises:
        ConfigurationError: Two sources say different things of an attempt.
    """
    first: dict[object, int] = {}
    columns = (repeats.column(name) for name in ("protocol", "repeat", "attempt"))
    # An attempt of no named trial cannot be told from another.
    trials = [trial or row for row, trial in enumerate(repeats.texts["trial"])]
    firsts = np.fromiter(map(first.setdefault, zip(trials, *columns, strict=True), count()), np.int64, len(repeats))
    again = np.flatnonzero(firsts != np.arange(len(repeats)))
    if not len(again):
        return repeats, ()
    _demand_equal(repeats.where(firsts[again]), repeats.where(again))
    pairs = Counter(zip(repeats.texts[SOURCE][again], repeats.texts[SOURCE][firsts[again]], strict=True))
    notes = tuple(
        f"{source}: {rows} rows are those of {kept}; they count once" for (source, kept), rows in pairs.items()
    )
    return repeats.where(np.setdiff1d(firsts, again)), notes


def _demand_equal(kept: Repeats, other: Repeats) -> None:
    differ = {name: column != other.texts[name] for name, column in kept.texts.items() if name != SOURCE}
    for name, column in kept.numbers.items():
        differ[name] = (column != other.numbers[name]) & ~(np.isnan(column) & np.isnan(other.numbers[name]))
    for name, column in differ.items():
        for index in np.flatnonzero(column)[:1]:
            raise ConfigurationError(
                f"{kept.name(index)} of {kept.texts['trial'][index]} has another {name} "
                f"than in {kept.texts[SOURCE][index]}",
                where=other.texts[SOURCE][index],
                remedy="name one of the two",
            )
