"""Markdown tables of the fault matrix, one per kind of robot, with a row for each fault of one or more parties."""

import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from tests.helpers.motion_cells import AT_REST, CELLS, Craft, InjectedFault, MotionCell, expected
from tests.helpers.motion_outcomes import MotionOutcome
from tests.helpers.motion_parties import Party

BEGIN: Final = "<!-- written by tests/e2e/motion_faults.py -->"
END: Final = "<!-- end of the tables -->"

_TITLES: Final = {
    Craft.ROVER: "Ground robot",
    Craft.PX4: "Drone with PX4",
    Craft.COPTER: "Drone with ArduCopter",
}
_FAULTS: Final = {
    InjectedFault.KILL: "killed",
    InjectedFault.PAUSE: "6 s suspended",
    InjectedFault.SUSPEND: "suspended",
    InjectedFault.SLOW: "slow",
    InjectedFault.CTRL_C: "Ctrl-C",
    InjectedFault.STOP: "`fieldkit stop`",
    InjectedFault.ABORT: "`fieldkit abort`",
}
_CELLS: Final = {cell.name: cell for cell in CELLS}


def tables(outcomes: Sequence[MotionOutcome], observed_on: str) -> str:
    """The tables of outcomes.

    Args:
        outcomes: Outcomes of any cells, in any order.
        observed_on: Date and machine of the observations.
    """
    beyond = sum(bool(outcome.problems) for outcome in outcomes)
    lines = [
        f"{observed_on}: {len(outcomes)} trials, {beyond} beyond their bounds.",
    ]
    for craft, title in _TITLES.items():
        rows = list(_rows(craft, outcomes))
        if rows:
            ground = " on the ground: bound (s) | median (s) | max (s) |" if craft.flies else ""
            start_column = "descends" if craft.flies else "stationary"
            lines += ["", f"### {title}", ""]
            lines.append(
                f"| party | fault | detected by | reaction "
                f"| {start_column}: bound (s) | median (s) | max (s) |{ground} trials | beyond |"
            )
            lines.append("| --- " * (12 if craft.flies else 9) + "|")
            lines += rows
    return "\n".join(lines) + "\n"


def _rows(craft: Craft, outcomes: Sequence[MotionOutcome]) -> Iterator[str]:
    groups: dict[tuple[tuple[Party, ...], InjectedFault], list[tuple[MotionCell, MotionOutcome]]] = {}
    for outcome in outcomes:
        cell = _CELLS[outcome.cell]
        if cell.craft is craft:
            groups.setdefault((cell.parties, cell.fault), []).append((cell, outcome))
    order = list(dict.fromkeys((cell.parties, cell.fault) for cell in CELLS if cell.craft is craft))
    for key in sorted(groups, key=order.index):
        (parties, fault), trials = key, groups[key]
        expectation = expected(next((cell for cell, _ in trials if cell.moment not in AT_REST), trials[0][0]))
        cells = [", ".join(parties), _fault(parties, fault), expectation.detected_by, expectation.does]
        cells += _times(expectation.begins_s, [(cell, outcome.begins_s) for cell, outcome in trials])
        if craft.flies:
            cells += _times(expectation.ends_s, [(cell, outcome.ends_s) for cell, outcome in trials])
        beyond = sum(bool(outcome.problems) for _, outcome in trials)
        yield "| " + " | ".join([*cells, str(len(trials)), str(beyond)]) + " |"


def _fault(parties: Sequence[Party], fault: InjectedFault) -> str:
    if {*parties} == {Party.LINK}:
        return {InjectedFault.KILL: "cut", InjectedFault.PAUSE: "6 s cut", InjectedFault.SLOW: "3.5 s delay"}[fault]
    if fault is InjectedFault.ABORT:
        return "killed, then `fieldkit abort`"
    if parties == (Party.FIELDKIT, Party.OPERATOR):
        return f"suspended, then {_FAULTS[fault]}"
    return _FAULTS[fault]


def _times(bound_s: float | None, times: Sequence[tuple[MotionCell, float | None]]) -> list[str]:
    """Bound, median and maximum in seconds; the maximum is `never` if an event did not occur."""
    bound = "" if bound_s is None else f"{bound_s:.1f}"
    event_times_s = [value for _, value in times if value is not None]
    if not event_times_s:
        return [bound, "", "never"]
    slowest = max(times, key=lambda entry: float("inf") if entry[1] is None else entry[1])
    maximum = "never" if slowest[1] is None else f"{slowest[1]:.1f}"
    return [bound, f"{statistics.median(event_times_s):.1f}", f"{maximum} ({slowest[0].moment})"]


def write(page: Path, text: str) -> None:
    """Replace the text between the markers of a page by tables.

    Raises:
        ValueError: The page has no markers.
    """
    before, begin_marker, remainder = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end_marker, after = remainder.partition(END)
    if not begin_marker or not end_marker:
        raise ValueError(f"{page} has no {BEGIN} and {END}")
    page.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{after}", encoding="utf-8")
