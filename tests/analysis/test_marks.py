"""Comparison of runs with marked repeats: a condition of the robots may explain a difference."""

import pytest

from fieldkit.analysis import comparable
from fieldkit.analysis.compare import compare
from fieldkit.analysis.repeats import Repeats, parse
from fieldkit.measure.robot_state import state_columns
from fieldkit.trial.columns import robot_columns, trial_columns

HEADER = "trial,scenario,topology,protocol,distance_m,repeat,attempt,status,profiles_sha256,procedure_sha256,marks"


def run(name: str, *marks: str) -> Repeats:
    """Return a run with a repeat for each text in the column `marks`."""
    rows = [f"{name},los,master,udp,10,{number},1,valid,aa,bb,{text}" for number, text in enumerate(marks, 1)]
    return parse("\n".join((HEADER, *rows, "")).encode(), trial_columns(robot_columns(())))


@pytest.mark.parametrize(
    ("a", "b", "refusals", "notes"),
    [
        (("none", "none"), ("none", "none"), (), ()),
        (("wrong clock",), ("wrong clock", "wrong clock"), (), ()),
        (("none", "none"), ("none", "wrong clock"), ("marks, wrong clock",), ()),
        (("wrong clock and clocks disagree",), ("wrong clock",), ("marks, clocks disagree",), ()),
        (("none",), ("no time source",), (), ("marks, no time source",)),
        (("",), ("wrong clock",), (), ("marks, wrong clock",)),
    ],
)
def test_a_mark_in_a_different_share_of_the_repeats_is_a_concern(
    a: tuple[str, ...], b: tuple[str, ...], refusals: tuple[str, ...], notes: tuple[str, ...]
) -> None:
    comparison = compare(run("a", *a), run("b", *b))
    mark_concerns = [concern for concern in comparison.concerns if concern.what.startswith("marks")]
    assert tuple(concern.what for concern in mark_concerns if concern.refuses) == refusals
    assert tuple(concern.what for concern in mark_concerns if not concern.refuses) == notes


def test_the_names_of_both_packages_are_equal() -> None:
    assert comparable.MARKS == state_columns.MARKS
    assert comparable.NO_MARKS == state_columns.NO_MARKS
    assert comparable.MARK_SEPARATOR == state_columns.MARK_SEPARATOR
