"""Expectations: what a lab demands of the figures of a trial, judged on their intervals."""

import operator
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.quantities import Quantity, parse_amount, symbols
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import Protocol

_TEXT: Final = re.compile(
    rf"(?:(?P<protocol>{'|'.join(Protocol)})\s*:\s*)?(?P<name>[a-z][a-z0-9_.]{{0,100}})\s*(?P<sign><|>)\s*(?P<amount>[^<>=]+)",
    re.ASCII,
)


class Ruling(StrEnum):
    """What the figures say of an expectation."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "cannot be told"


@dataclass(frozen=True)
class Expectation:
    """A demand on a figure: `udp: up.file_loss < 2 %`.

    Attributes:
        text: As it was written.
        quantity: Name of the figure.
        is_below: Whether it is to be below the bound, or else above it.
        bound: The bound, in the figure's unit.
        protocol: For the repeats of which protocol; None for all.
    """

    text: str
    quantity: str
    is_below: bool
    bound: float
    protocol: Protocol | None = None


@dataclass(frozen=True)
class Judgement:
    """What the repeats under one condition say of an expectation.

    Attributes:
        expectation: Which.
        condition: The condition, by column.
        ruling: Whether it holds: the whole 95 % interval is where it is to be, none of it is, or neither.
        found: The figure; None where no valid repeat has it.
    """

    expectation: Expectation
    condition: Mapping[str, str | float | None]
    ruling: Ruling
    found: Estimate | None

    @property
    def holds(self) -> bool:
        """Whether the figure is shown to be where it is to be."""
        return self.ruling is Ruling.HOLDS


def parse(text: str, known: Iterable[Quantity]) -> Expectation:
    """Return what an expectation says.

    Args:
        text: `NAME < AMOUNT` or `NAME > AMOUNT`, with `tcp:` or `udp:` before it for one protocol alone.
        known: The figures that there can be.

    Raises:
        ConfigurationError: It says nothing, or of a figure that there is not.
    """
    by_name = {one.name: one for one in known}
    found = _TEXT.fullmatch(text.strip())
    if found is None:
        raise ConfigurationError(
            f"{text[:60]!r} is no expectation", remedy="write for example: ip_loss < 2 %; or: udp: jitter_s < 5 ms"
        )
    if (name := found["name"]) not in by_name:
        raise ConfigurationError(
            f"there is no figure {name!r} to expect something of",
            remedy=nearest(name, by_name, f"there are: {', '.join(by_name)}"),
        )
    amount = found["amount"].strip()
    sign = -1.0 if amount.startswith("-") else 1.0
    unit = by_name[name].unit
    example = symbols(unit)[0] if symbols(unit) else ""
    bound = sign * parse_amount(amount.removeprefix("-"), unit, f"bound for {name}, as 2{example}")
    protocol = Protocol(found["protocol"]) if found["protocol"] else None
    return Expectation(text.strip(), name, found["sign"] == "<", bound, protocol)


def judge(expectations: Sequence[Expectation], cells: Sequence[Cell]) -> tuple[Judgement, ...]:
    """Return what cells say of expectations, expectation by expectation; one that no cell is of can not be told."""
    return tuple(one for expectation in expectations for one in _judged(expectation, cells))


def _judged(expectation: Expectation, cells: Sequence[Cell]) -> Iterator[Judgement]:
    concerned = [cell for cell in cells if expectation.protocol in {None, cell.key.get("protocol")}]
    for cell in concerned:
        found = cell.estimates.get(expectation.quantity)
        yield Judgement(expectation, cell.key, _ruling(expectation, found), found)
    if not concerned:
        yield Judgement(expectation, {}, Ruling.OPEN, None)


def _ruling(expectation: Expectation, found: Estimate | None) -> Ruling:
    if found is None or found.low is None or found.high is None:
        return Ruling.OPEN
    beyond = operator.lt if expectation.is_below else operator.gt
    ends = [beyond(end, expectation.bound) for end in (found.low, found.high)]
    if all(ends):
        return Ruling.HOLDS
    return Ruling.OPEN if any(ends) else Ruling.FAILS
