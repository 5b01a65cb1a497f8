"""Quantities: columns of trial.csv that are put together over repeats, as those columns declare it."""

import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Self

from fieldkit.core.columns import BACKGROUND, FIRST_OF_OTHERS, Bounds, Column, Kind, plain_name, prefixed
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import BITS_PER_S_PER_UNIT, FRACTION_PER_UNIT, SECONDS_PER_UNIT, parse_quantity

_NUMBER: Final = re.compile(r"\d{1,15}(?:\.\d{1,30})?|\.\d{1,30}", re.ASCII)
_IMPLIED_BY: Final = MappingProxyType(
    {"rtt_median_s": "rtt_loss", "goodput_bit_s": "file_loss", "topic_delay_median_s": "topic_loss"}
)


@dataclass(frozen=True)
class Quantity:
    """A column of trial.csv that figures are made of.

    Attributes:
        name: The column.
        label: In words, for tables and axes.
        kind: How repeats are put together.
        unit: The column's, `share` for what is true or false.
        arrived: Column that counts what arrived; None unless counted.
        sent: Column that counts of how many; None unless counted.
        possible: Smallest and largest value of a repeat.
        rank: Place among others, from the first.
        at_least: Column of lower bounds of what had not ended, None if there is none; see `columns.Figure`.
        of_sent: Column of the same statistic over all that was sent, likewise.
    """

    name: str
    label: str
    kind: Kind
    unit: str
    arrived: str | None = None
    sent: str | None = None
    possible: Bounds = (-sys.float_info.max, sys.float_info.max)
    rank: int = FIRST_OF_OTHERS
    at_least: str | None = None
    of_sent: str | None = None

    @classmethod
    def of(cls, column: Column) -> Self | None:
        """Return the quantity that a column declares, None where it declares none, or words."""
        one = column.figure
        if one is None or one.kind is Kind.WORDS:
            return None
        return cls(
            column.name,
            one.label,
            one.kind,
            unit="share" if one.kind is Kind.FLAG else column.unit,
            arrived=one.arrived,
            sent=one.sent,
            possible=column.possible,
            rank=one.rank,
            at_least=one.at_least,
            of_sent=one.of_sent,
        )

    @property
    def step(self) -> str:
        """Name of the step that measures it, empty where that has none."""
        return self.name.rpartition(".")[0]

    @property
    def plain_label(self) -> str:
        """The label without the name of the step."""
        return self.label.removeprefix(f"{self.step}: ")

    @property
    def is_own(self) -> bool:
        """Whether every trial has it, or a step of a kind that every trial has, under a name."""
        return not FIRST_OF_OTHERS <= self.rank < BACKGROUND

    @property
    def payload(self) -> str | None:
        """Column with the ICMP payload size, without which a round-trip time cannot be read; None for others."""
        return prefixed(self.step, "rtt_payload_bytes") if plain_name(self.name) == "rtt_median_s" else None

    @property
    def implied_by(self) -> str | None:
        """Column whose value shows that a repeat was measured for this quantity too; None if none is known."""
        name = _IMPLIED_BY.get(plain_name(self.name))
        return name and prefixed(self.step, name)

    @property
    def needed(self) -> tuple[str, ...]:
        """All columns that a table of it is made of: `columns`, `companions`, and those that say how to read it."""
        return (
            *self.columns,
            *self.companions,
            *(name for name in (self.payload, self.implied_by) if name is not None),
        )

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns without which a repeat does not have it, itself first."""
        return tuple(name for name in (self.name, self.arrived, self.sent) if name is not None)

    @property
    def companions(self) -> tuple[str, ...]:
        """The columns that say more of it where they are there: lower bounds, the figure over all that was sent."""
        return tuple(name for name in (self.at_least, self.of_sent) if name is not None)


def quantities(columns: Iterable[Column]) -> tuple[Quantity, ...]:
    """Return the quantities of a table, in the order in which tables show them.

    Args:
        columns: The table's, in order.
    """
    return in_order(quantity for column in columns if (quantity := Quantity.of(column)) is not None)


def alike(found: Iterable[Quantity], name: str) -> list[Quantity]:
    """Return the quantities that are called `name` but for the names of their steps, that of no named step first."""
    return sorted(
        (quantity for quantity in found if plain_name(quantity.name) == name), key=lambda one: one.step != ""
    )


def in_order(found: Iterable[Quantity]) -> tuple[Quantity, ...]:
    """Return quantities, each once, in the order in which tables show them."""
    return tuple(sorted(dict.fromkeys(found), key=lambda one: one.rank))


def symbols(unit: str) -> tuple[str, ...]:
    """Return how people write a unit of quantities, and of how far they are apart."""
    return tuple(PER_UNIT[unit]) if unit in PER_UNIT else tuple(dict.fromkeys((unit, APART.get(unit, unit))))


def parse_amount(text: str, unit: str, what: str) -> float:
    """Return an amount of a quantity, or of how far two are apart, in its unit: `2%`, `5ms`, `3 dB`.

    Args:
        text: What somebody wrote. A unit that has one symbol alone may be left out.
        unit: The quantity's.
        what: For the message.

    Raises:
        ConfigurationError: It is no such amount, or below 0.
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
"""Losses, what says most of a transfer first."""

PER_UNIT: Final = MappingProxyType({"share": FRACTION_PER_UNIT, "s": SECONDS_PER_UNIT, "bit/s": BITS_PER_S_PER_UNIT})
"""How people write amounts of quantities: of these units the symbols, with their factors; others as they are."""

APART: Final = MappingProxyType({"share": "points", "dBm": "dB"})
"""In what two values of a unit are apart, where that is another."""

DEFAULT_BY: Final = ("procedure", "scenario", "topology", "backend", "distance", "distance_m", "protocol")
"""Columns that tell one condition from another."""
