"""Expectations: requirements on the figures of a trial, and the parser of their text."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from fieldkit.analysis.quantities import Quantity, parse_amount
from fieldkit.core.columns import Kind
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Protocol

_TEXT: Final = re.compile(
    rf"(?:(?P<protocol>{'|'.join(Protocol)})\s+)?"
    r"(?:(?P<repeats>every|max|min)\s+|(?P<share>[0-9][0-9.]{0,20}\s*%)\s+of\s+)?"
    r"(?P<name>[a-z][a-z0-9_.]{0,100})\s*(?P<sign><=|>=|<|>)\s*(?P<amount>[^<>=]+?)(?P<packets>\s+of\s+all\s+packets)?",
    re.ASCII,
)
_EXAMPLES: Final = "ip_loss < 2 %; every rtt_gap_s < 300 ms; 90 % of rtt_gap_s < 300 ms; ip_loss < 2 % of all packets"
MAX_SHARE: Final = 0.9999
"""Maximum share of all repeats that an expectation may require."""
_MIN_LOSS: Final = 1e-9
"""Minimum bound of a loss of all packets. No trial sends enough packets to show a smaller loss."""


class Scope(StrEnum):
    """Subject of an expectation.

    `figure` is the estimate over all repeats with its 95 % interval, `every` each repeat of the trial, `share` a
    share of all possible repeats with 95 % confidence, and `packets` the packets of all repeats together.
    """

    FIGURE = "figure"
    EVERY = "every"
    SHARE = "share"
    PACKETS = "packets"


@dataclass(frozen=True)
class Expectation:
    """A requirement on a figure, such as `udp up.file_loss < 5 %`.

    Attributes:
        text: The text as written by the operator.
        quantity: Name of the figure.
        is_below: True if the figure must be below the bound; otherwise it must be above the bound.
        bound: The bound, in the figure's unit.
        protocol: Protocol of the repeats; None for all protocols.
        is_inclusive: True if the figure may equal the bound (`<=` or `>=`).
        scope: Subject of the expectation.
        share: Required share of all repeats; None unless the scope is `share`.
    """

    text: str
    quantity: str
    is_below: bool
    bound: float
    protocol: Protocol | None = None
    is_inclusive: bool = False
    scope: Scope = Scope.FIGURE
    share: float | None = None

    def is_met(self, value: float) -> bool:
        """Return True if a value satisfies the bound."""
        if value == self.bound:
            return self.is_inclusive
        return (value < self.bound) is self.is_below


def parse(text: str, quantities: Iterable[Quantity]) -> Expectation:
    """Parse the text of an expectation.

    Args:
        text: `NAME < AMOUNT`, with `<`, `<=`, `>` or `>=`. With the prefix `every` (or `max` with `<`, `min` with
            `>`), each repeat must meet it; with the prefix `90 % of`, this share of all repeats. With the suffix `of
            all packets`, the bound is for all packets together. `tcp` or `udp` at the start restricts it to one
            protocol.
        quantities: The possible figures.

    Raises:
        ConfigurationError: The text is not an expectation, its figure is unknown, or no result could show it.
    """
    quantities_by_name = {quantity.name: quantity for quantity in quantities}
    match = _TEXT.fullmatch(text.strip())
    if match is None:
        raise ConfigurationError(f"{text[:60]!r} is not an expectation", remedy=f"write for example: {_EXAMPLES}")
    if (name := match["name"]) not in quantities_by_name:
        raise ConfigurationError(
            f"the expected figure {name!r} does not exist",
            remedy=did_you_mean(name, quantities_by_name, f"figures are: {', '.join(quantities_by_name)}"),
        )
    quantity, amount = quantities_by_name[name], match["amount"].strip()
    is_below = match["sign"].startswith("<")
    scope, share = _scope(match, quantity, is_below=is_below)
    sign = -1.0 if amount.startswith("-") else 1.0
    bound = sign * parse_amount(amount.removeprefix("-"), quantity.unit, f"bound for {name}")
    if scope is Scope.PACKETS and bound < _MIN_LOSS:
        raise ConfigurationError(
            f"no number of packets shows a loss below {amount}", remedy=f"write for example: every {name} <= 0 %"
        )
    return Expectation(
        text.strip(),
        name,
        is_below,
        bound,
        Protocol(match["protocol"]) if match["protocol"] else None,
        is_inclusive=match["sign"].endswith("="),
        scope=scope,
        share=share,
    )


def _scope(match: re.Match[str], quantity: Quantity, *, is_below: bool) -> tuple[Scope, float | None]:
    """Return the scope of an expectation, and its share of repeats if the scope is `share`.

    Raises:
        ConfigurationError: The scope does not fit the bound, or the share is not possible.
    """
    if match["packets"]:
        if match["repeats"] or match["share"] or not is_below or quantity.kind is not Kind.COUNTED:
            raise ConfigurationError(
                f"{match[0][:60]!r}: only an upper bound of a counted loss can be `of all packets`",
                remedy="write for example: ip_loss < 2 % of all packets",
            )
        return Scope.PACKETS, None
    if match["share"]:
        share = parse_amount(match["share"], "share", "share of repeats")
        if not 0 < share <= MAX_SHARE:
            raise ConfigurationError(
                f"{match['share']} of repeats cannot be required",
                remedy="write a share above 0 % and below 100 %; or every, for every repeat of the trial",
            )
        return Scope.SHARE, share
    if match["repeats"] in {"max", "min"} and (match["repeats"] == "max") is not is_below:
        raise ConfigurationError(
            f"{match[0][:60]!r} would be met by a single repeat",
            remedy="write max with <, min with >, or every",
        )
    return (Scope.EVERY if match["repeats"] else Scope.FIGURE), None
