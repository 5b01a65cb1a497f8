"""Expectations: what a lab demands of the figures of a trial, as it writes it."""

import re
from collections.abc import Iterable
from typing import Final

from fieldkit.analysis.quantities import Quantity, parse_amount
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.lazy import dataclass
from fieldkit.core.model import Protocol

_TEXT: Final = re.compile(
    rf"(?:(?P<protocol>{'|'.join(Protocol)})\s+)?(?P<name>[a-z][a-z0-9_.]{{0,100}})\s*(?P<sign><|>)\s*(?P<amount>[^<>=]+)",
    re.ASCII,
)


@dataclass(frozen=True)
class Expectation:
    """A demand on a figure: `udp up.file_loss < 2 %`.

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


def parse(text: str, known: Iterable[Quantity]) -> Expectation:
    """Return what an expectation says.

    Args:
        text: `NAME < AMOUNT` or `NAME > AMOUNT`, with `tcp` or `udp` before it for one protocol alone.
        known: The figures that there can be.

    Raises:
        ConfigurationError: It says nothing, or of a figure that there is not.
    """
    by_name = {quantity.name: quantity for quantity in known}
    found = _TEXT.fullmatch(text.strip())
    if found is None:
        raise ConfigurationError(
            f"{text[:60]!r} is no expectation", remedy="write for example: ip_loss < 2 %; or: udp jitter_s < 5 ms"
        )
    if (name := found["name"]) not in by_name:
        raise ConfigurationError(
            f"there is no figure {name!r} to expect something of",
            remedy=nearest(name, by_name, f"there are: {', '.join(by_name)}"),
        )
    amount = found["amount"].strip()
    sign = -1.0 if amount.startswith("-") else 1.0
    unit = by_name[name].unit
    bound = sign * parse_amount(amount.removeprefix("-"), unit, f"bound for {name}")
    protocol = Protocol(found["protocol"]) if found["protocol"] else None
    return Expectation(text.strip(), name, found["sign"] == "<", bound, protocol)
