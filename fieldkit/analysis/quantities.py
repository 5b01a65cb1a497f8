"""Quantities: columns of trial.csv that are aggregated over repeats, as declared by `Column.figure`."""

import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Self

from fieldkit.core.columns import BACKGROUND, FIRST_EXTERNAL_RANK, Bounds, Column, Kind, plain_name, step_prefixed
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import BITS_PER_S_PER_UNIT, FRACTION_PER_UNIT, SECONDS_PER_UNIT, parse_quantity

_NUMBER: Final = re.compile(r"\d{1,15}(?:\.\d{1,30})?|\.\d{1,30}", re.ASCII)
_IMPLIED_BY: Final = MappingProxyType(
    {"rtt_median_s": "rtt_loss", "goodput_bit_s": "file_loss", "topic_delay_median_s": "topic_loss"}
)
"""For quantities that have no value if nothing arrives, the column whose value implies that they were measured."""


@dataclass(frozen=True)
class Quantity:
    """A column of trial.csv that is aggregated over repeats.

    Attributes:
        name: Name of the column.
        label: Label in tables and on axes.
        kind: Kind of aggregation.
        unit: Unit of the column; `share` for a flag.
        arrived: Column with the number of received items; None unless counted.
        sent: Column with the number of sent items; None unless counted.
        possible_range: Smallest and largest possible value of a repeat.
        rank: Sort key in tables.
        at_least: Column of lower bounds (right-censored values), or None; see `columns.Figure`.
        of_sent: Column of the same statistic over all sent items, or None; see `columns.Figure`.
    """

    name: str
    label: str
    kind: Kind
    unit: str
    arrived: str | None = None
    sent: str | None = None
    possible_range: Bounds = (-sys.float_info.max, sys.float_info.max)
    rank: int = FIRST_EXTERNAL_RANK
    at_least: str | None = None
    of_sent: str | None = None

    @classmethod
    def of(cls, column: Column) -> Self | None:
        """Return the quantity of a column, or None if the column has no figure or a figure of the kind `words`."""
        figure = column.figure
        if figure is None or figure.kind is Kind.WORDS:
            return None
        return cls(
            column.name,
            figure.label,
            figure.kind,
            unit="share" if figure.kind is Kind.FLAG else column.unit,
            arrived=figure.arrived,
            sent=figure.sent,
            possible_range=column.possible_range,
            rank=figure.rank,
            at_least=figure.at_least,
            of_sent=figure.of_sent,
        )

    @property
    def step(self) -> str:
        """Name of the step that measures the quantity; empty if the step has no name."""
        return self.name.rpartition(".")[0]

    @property
    def plain_label(self) -> str:
        """The label without the name of the step."""
        return self.label.removeprefix(f"{self.step}: ")

    @property
    def is_builtin(self) -> bool:
        """True if tables and charts treat the quantity as built-in; see `columns.Figure.rank`."""
        return not FIRST_EXTERNAL_RANK <= self.rank < BACKGROUND

    @property
    def payload(self) -> str | None:
        """Column with the ICMP payload size, which affects a round-trip time; None for other quantities."""
        return step_prefixed(self.step, "rtt_payload_bytes") if plain_name(self.name) == "rtt_median_s" else None

    @property
    def implied_by(self) -> str | None:
        """Column whose value implies that this quantity was measured, even if it has no value; None if unknown."""
        name = _IMPLIED_BY.get(plain_name(self.name))
        return name and step_prefixed(self.step, name)

    @property
    def needed_columns(self) -> tuple[str, ...]:
        """All columns for a table of the quantity: `columns`, `optional_columns`, `payload` and `implied_by`."""
        return (
            *self.columns,
            *self.optional_columns,
            *(name for name in (self.payload, self.implied_by) if name is not None),
        )

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns in which a repeat must have values, starting with the column of the quantity."""
        return tuple(name for name in (self.name, self.arrived, self.sent) if name is not None)

    @property
    def optional_columns(self) -> tuple[str, ...]:
        """Further columns, which may be missing: lower bounds, and the statistic over all sent items."""
        return tuple(name for name in (self.at_least, self.of_sent) if name is not None)


def quantities(columns: Iterable[Column]) -> tuple[Quantity, ...]:
    """Return the quantities of a table, in the order of tables.

    Args:
        columns: Columns of the table, in order.
    """
    return in_order(quantity for column in columns if (quantity := Quantity.of(column)) is not None)


def with_plain_name(quantities: Iterable[Quantity], name: str) -> list[Quantity]:
    """Return the quantities with this name, of all steps. The quantity of the step without a name is first."""
    return sorted(
        (quantity for quantity in quantities if plain_name(quantity.name) == name),
        key=lambda quantity: quantity.step != "",
    )


def in_order(quantities: Iterable[Quantity]) -> tuple[Quantity, ...]:
    """Return quantities without duplicates, in the order of tables."""
    return tuple(sorted(dict.fromkeys(quantities), key=lambda quantity: quantity.rank))


def symbols(unit: str) -> tuple[str, ...]:
    """Return the symbols with which a value of a unit, or a difference of two values, can be written."""
    return (
        tuple(PER_UNIT[unit]) if unit in PER_UNIT else tuple(dict.fromkeys((unit, DIFFERENCE_UNITS.get(unit, unit))))
    )


def parse_amount(text: str, unit: str, what: str) -> float:
    """Return a value of a quantity, or a difference of values, in its unit, for example for `2%`, `5ms` or `3 dB`.

    Args:
        text: The text to parse. A unit with only one symbol may be omitted.
        unit: Unit of the quantity.
        what: Description of the value, for the message.

    Raises:
        ConfigurationError: The text is not a value in this unit, or the value is below 0.
    """
    if unit in PER_UNIT:
        return parse_quantity(text, PER_UNIT[unit], what)
    number = text.strip()
    for symbol in symbols(unit):
        number = number.removesuffix(symbol)
    if not _NUMBER.fullmatch(number.strip()):
        raise ConfigurationError(f"{text[:40]!r} is not a {what}", remedy=f"write for example 15{unit}")
    return float(number)


LOSSES: Final = ("datagram_loss", "tcp_byte_loss", "ip_loss", "file_loss", "rtt_loss")
"""Columns of losses, the most informative one first."""

PER_UNIT: Final = MappingProxyType({"share": FRACTION_PER_UNIT, "s": SECONDS_PER_UNIT, "bit/s": BITS_PER_S_PER_UNIT})
"""Symbols and factors of units that can be written in several ways. Other units have one symbol."""

DIFFERENCE_UNITS: Final = MappingProxyType({"share": "points", "dBm": "dB"})
"""Unit of the difference of two values, if it differs from the unit of the values."""

DEFAULT_BY: Final = ("procedure", "scenario", "topology", "backend", "distance", "distance_m", "protocol")
"""Columns that identify a condition by default."""


_SEPARATOR: Final = "="
"""Separator of column and word in a table with a line per word, such as `grass=wet`. It is not allowed in the names
of columns."""


@dataclass(frozen=True)
class Tally:
    """Counts of the words of one column under one condition.

    Attributes:
        name: Name of the column.
        label: Label of the column.
        counts: Number of valid repeats by word, in the order of decreasing counts, then alphabetically.
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
        """Return the name of a word's line in a table, such as `grass=wet`."""
        return f"{self.name}{_SEPARATOR}{word}"


def word_columns(columns: Iterable[Column]) -> tuple[Column, ...]:
    """Return the text columns whose values are counted, in their order."""
    return tuple(column for column in columns if column.figure is not None and column.figure.kind is Kind.WORDS)


def tallies(column: Column, words_with_cell: Iterable[tuple[int, str]]) -> Iterator[tuple[int, Tally]]:
    """Yield the index of each cell in which a column has words, and the counts of these words.

    Args:
        column: The column.
        words_with_cell: Cell and word of each valid repeat; a missing word is empty.
    """
    counts: dict[int, Counter[str]] = {}
    for cell, word in words_with_cell:
        if word:
            counts.setdefault(cell, Counter())[word] += 1
    label = column.figure.label if column.figure else column.name
    for cell, counter in counts.items():
        yield cell, Tally(column.name, label, dict(sorted(counter.items(), key=lambda item: (-item[1], item[0]))))
