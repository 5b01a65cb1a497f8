"""Tables of the fault matrix, in Markdown: one per kind of robot, a row per parties and fault, over all phases."""

import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from tests.helpers.motion_cells import AT_REST, CELLS, Blow, Craft, MotionCell, expected
from tests.helpers.motion_outcomes import MotionOutcome
from tests.helpers.motion_parties import Party

BEGIN: Final = "<!-- written by tests/e2e/motion_faults.py -->"
END: Final = "<!-- end of what it writes -->"

_TITLES: Final = {
    Craft.ROVER: "Ground robot",
    Craft.PX4: "Drone with PX4",
    Craft.COPTER: "Drone with ArduCopter",
}
_FAULTS: Final = {
    Blow.KILL: "killed",
    Blow.PAUSE: "6 s suspended",
    Blow.SUSPEND: "suspended",
    Blow.SLOW: "slow",
    Blow.CTRL_C: "Ctrl-C",
    Blow.STOP: "`fieldkit stop`",
    Blow.ABORT: "`fieldkit abort`",
}
_CELLS: Final = {cell.name: cell for cell in CELLS}


def tables(outcomes: Sequence[MotionOutcome], made: str) -> str:
    """Return the tables of outcomes.

    Args:
        outcomes: Of any cells, in any order.
        made: When and where they were observed.
    """
    lines = [f"{made}: {len(outcomes)} trials, {sum(bool(seen.problems) for seen in outcomes)} beyond their bounds."]
    for craft, title in _TITLES.items():
        rows = list(_rows(craft, outcomes))
        if rows:
            ground = " on the ground, bound | median | max |" if craft.flies else ""
            begins = "descends" if craft.flies else "stationary"
            lines += ["", f"### {title}", ""]
            lines.append(
                f"| who | fault | who detects it | robot | {begins}, bound | median | max |{ground} n | beyond |"
            )
            lines.append("| --- " * (12 if craft.flies else 9) + "|")
            lines += rows
    return "\n".join(lines) + "\n"


def _rows(craft: Craft, outcomes: Sequence[MotionOutcome]) -> Iterator[str]:
    groups: dict[tuple[tuple[Party, ...], Blow], list[tuple[MotionCell, MotionOutcome]]] = {}
    for seen in outcomes:
        cell = _CELLS[seen.cell]
        if cell.craft is craft:
            groups.setdefault((cell.parties, cell.blow), []).append((cell, seen))
    order = list(dict.fromkeys((cell.parties, cell.blow) for cell in CELLS if cell.craft is craft))
    for key in sorted(groups, key=order.index):
        (parties, blow), members = key, groups[key]
        wants = expected(next((cell for cell, _ in members if cell.moment not in AT_REST), members[0][0]))
        cells = [", ".join(parties), _fault(parties, blow), wants.detected_by, wants.does]
        cells += _times(wants.begins_s, [(cell, seen.begins_s) for cell, seen in members])
        if craft.flies:
            cells += _times(wants.ends_s, [(cell, seen.ends_s) for cell, seen in members])
        beyond = sum(bool(seen.problems) for _, seen in members)
        yield "| " + " | ".join([*cells, str(len(members)), str(beyond)]) + " |"


def _fault(parties: Sequence[Party], blow: Blow) -> str:
    if {*parties} == {Party.LINK}:
        return {Blow.KILL: "cut", Blow.PAUSE: "6 s cut", Blow.SLOW: "3.5 s delay"}[blow]
    if blow is Blow.ABORT:
        return "killed, then `fieldkit abort`"
    if parties == (Party.FIELDKIT, Party.OPERATOR):
        return f"suspended, then {_FAULTS[blow]}"
    return _FAULTS[blow]


def _times(bound_s: float | None, times: Sequence[tuple[MotionCell, float | None]]) -> list[str]:
    """Return bound, median and maximum, each in seconds; one that never came is a maximum of `never`."""
    bound = "" if bound_s is None else f"{bound_s:.1f}"
    known = [value for _, value in times if value is not None]
    if not known:
        return [bound, "", "never"]
    last = max(times, key=lambda one: float("inf") if one[1] is None else one[1])
    greatest = "never" if last[1] is None else f"{last[1]:.1f}"
    return [bound, f"{statistics.median(known):.1f}", f"{greatest} ({last[0].moment})"]


def write(page: Path, text: str) -> None:
    """Put tables into a page, between the markers.

    Raises:
        ValueError: The page has no markers.
    """
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{page} has no {BEGIN} and {END}")
    page.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{after}", encoding="utf-8")
