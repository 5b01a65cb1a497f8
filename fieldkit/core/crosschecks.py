"""Declarations of which sources of evidence a quantity has, and what follows if they contradict each other."""

from dataclasses import dataclass
from enum import StrEnum


class CheckOutcome(StrEnum):
    """Consequence of a contradiction.

    `void`: the repeat does not count; `withheld`: the columns are empty, with the reason; `unchecked`: the quantity
    has one source only.
    """

    VOID = "void"
    WITHHELD = "withheld"
    UNCHECKED = "unchecked"


@dataclass(frozen=True)
class CrossCheck:
    """A quantity, its source, and the independent sources that it is compared with.

    Attributes:
        quantity: The quantity, in words.
        columns: Columns of trial.csv that depend on it; patterns of `fnmatch`.
        source: File and field that the columns are computed from; ROLE stands for a role.
        against: Independent sources; empty only if the quantity is unchecked.
        tolerance: Differences that are legitimate, with the reason; for an unchecked quantity why it has one source.
        outcome: What a larger difference causes.
    """

    quantity: str
    columns: tuple[str, ...]
    source: str
    against: tuple[str, ...]
    tolerance: str
    outcome: CheckOutcome = CheckOutcome.VOID
