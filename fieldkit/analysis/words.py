"""Counts of the words in a text column under a condition.

Words have no statistical inference: a word may have been entered once for all repeats of a trial, which are then one
observation. Therefore a share of words has no interval, and a difference of shares has no p-value.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from fieldkit.core.columns import Column, Kind

_SEPARATOR: Final = "="
"""Separator of column and word in a table with a line per word: `grass=wet`. Names of columns cannot contain it."""


@dataclass(frozen=True)
class Tally:
    """Counts of the words of one column under one condition.

    Attributes:
        name: Name of the column.
        label: Its label.
        counts: Number of valid repeats by word, sorted by decreasing count, then alphabetically.
    """

    name: str
    label: str
    counts: Mapping[str, int]

    @property
    def n(self) -> int:
        """Number of valid repeats that have a word."""
        return sum(self.counts.values())

    def share(self, word: str) -> float | None:
        """Return the share of the `n` repeats that have this word; None if no repeat has a word."""
        return self.counts.get(word, 0) / self.n if self.n else None

    def quantity(self, word: str) -> str:
        """Return the name of a word's line in a table: `grass=wet`."""
        return f"{self.name}{_SEPARATOR}{word}"


def worded(columns: Iterable[Column]) -> tuple[Column, ...]:
    """Return the columns whose words are counted, in their order."""
    return tuple(column for column in columns if column.figure is not None and column.figure.kind is Kind.WORDS)


def tallies(column: Column, given: Iterable[tuple[int, str]]) -> Iterator[tuple[int, Tally]]:
    """Yield the index of each cell in which a column has words, with their counts.

    Args:
        column: The column.
        given: Cell and word of each valid repeat; the word is empty if missing.
    """
    counts: dict[int, Counter[str]] = {}
    for cell, word in given:
        if word:
            counts.setdefault(cell, Counter())[word] += 1
    label = column.figure.label if column.figure else column.name
    for cell, counter in counts.items():
        yield cell, Tally(column.name, label, dict(sorted(counter.items(), key=lambda item: (-item[1], item[0]))))
