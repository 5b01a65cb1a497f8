"""Declarations of the independent sources of a quantity, and of the consequence if they contradict each other."""

from dataclasses import dataclass
from enum import StrEnum


class CheckOutcome(StrEnum):
    """Consequence of a contradiction.

    `void`: the repeat does not count; `withheld`: the values could be wrong, so the columns are empty, and the reason
    is reported; `marked`: the repeat is valid, and the column `marks` names the contradiction; `unchecked`: the
    quantity has only one source.
    """

    VOID = "void"
    WITHHELD = "withheld"
    MARKED = "marked"
    UNCHECKED = "unchecked"


@dataclass(frozen=True)
class CrossCheck:
    """A quantity, its source, and the independent sources that it is compared with.

    Attributes:
        quantity: Description of the quantity.
        columns: Columns of trial.csv that depend on it; patterns of `fnmatch`.
        source: File and field that the columns are computed from; ROLE is a placeholder for a role.
        against: Independent sources; empty only if the quantity is unchecked.
        tolerance: Legitimate differences, with the reason; for an unchecked quantity, why it has only one source.
        outcome: Consequence of a larger difference.
    """

    quantity: str
    columns: tuple[str, ...]
    source: str
    against: tuple[str, ...]
    tolerance: str
    outcome: CheckOutcome = CheckOutcome.VOID
