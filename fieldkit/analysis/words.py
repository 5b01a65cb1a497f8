"""Columns of words, which have no mean: how often each word was given under a condition.

They are counted and not judged: a word may have been given once for all repeats of a trial, and then these are one
observation, however many they are. So a share of words has no interval, and a difference of two has no p-value.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from fieldkit.core.columns import Column, Kind

_OF: Final = "="
"""Between a column and one of its words, where a table has a line for each: `grass=wet`. No column's name has it."""


@dataclass(frozen=True)
class Tally:
    """The words of one column under one condition.

    Attributes:
        name: The column.
        label: What people call it.
        counts: How many valid repeats have each word, the most frequent first, else in the order of the alphabet.
    """

    name: str
    label: str
    counts: Mapping[str, int]

    @property
    def n(self) -> int:
        """Valid repeats that have a word."""
        return sum(self.counts.values())

    def share(self, word: str) -> float | None:
        """Return the share of these that have one word; None where none has any."""
        return self.counts.get(word, 0) / self.n if self.n else None

    def quantity(self, word: str) -> str:
        """Return what a line of a table is of that says how often a word was given: `grass=wet`."""
        return f"{self.name}{_OF}{word}"


def worded(columns: Iterable[Column]) -> tuple[Column, ...]:
    """Return the columns whose words are counted, in their order."""
    return tuple(column for column in columns if column.figure is not None and column.figure.kind is Kind.WORDS)


def tallies(column: Column, given: Iterable[tuple[int, str]]) -> Iterator[tuple[int, Tally]]:
    """Yield the cells in which a column has words, with what they are.

    Args:
        column: Which.
        given: Cell and word of each valid repeat, the word empty where it is missing.
    """
    counts: dict[int, Counter[str]] = {}
    for cell, word in given:
        if word:
            counts.setdefault(cell, Counter())[word] += 1
    label = column.figure.label if column.figure else column.name
    for cell, found in counts.items():
        yield cell, Tally(column.name, label, dict(sorted(found.items(), key=lambda one: (-one[1], one[0]))))
