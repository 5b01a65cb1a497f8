"""Marks of an attempt: conditions of the robots that can explain a difference between repeats.

A source is a program on a robot that reports such conditions.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from fieldkit.core.columns import Measured, Value
from fieldkit.measure.robot_state.state_columns import MARK_SEPARATOR, MARKS, NO_MARKS


@dataclass(frozen=True)
class RepeatMark:
    """Mark of a repeat.

    Attributes:
        name: Name of the mark in the column `marks`.
        reason: Sentence without a full stop that contains the name of the robot.
    """

    name: str
    reason: str


def measure(marks: Iterable[RepeatMark], *, is_known: bool) -> Measured:
    """Return the columns of the marks.

    Args:
        marks: The marks.
        is_known: True if a source of a robot answered. The value without marks is then `none`, otherwise it is empty.
    """
    all_marks = list(marks)
    names = MARK_SEPARATOR.join(dict.fromkeys(mark.name for mark in all_marks))
    reasons = "; ".join(dict.fromkeys(mark.reason for mark in all_marks))
    values: dict[str, Value | None] = {MARKS: names or (NO_MARKS if is_known else None)}
    return Measured.from_optional(values, "no source of a robot reports on its state") | Measured.from_optional(
        {"marks_reason": reasons or None}, "the repeat has no mark"
    )
