"""Columns and marks of an attempt, from the states of the robots before and after it.

A mark is the name of a condition that can explain a difference between repeats. The states of the clocks during the
attempt are also used. A source is a program that reports a state. Its parser is imported only if a robot has the
source.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from fieldkit.core.columns import Measured, plain_name
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state import exchanges, health, marks, snapshots
from fieldkit.measure.robot_state.marks import RepeatMark
from fieldkit.measure.robot_state.snapshots import Snapshot
from fieldkit.measure.robot_state.state_columns import declare_columns

CLOCK_SOURCES: Final = frozenset(("chrony", "ptp", "timesyncd", "timedatectl"))
RADIO_SOURCES: Final = frozenset(("iw-info", "iw-reg", "iw-scan", "iw-survey"))
"""Names of the sources that report on clocks and on radios."""
_ONE_WAY: Final = "one_way_withheld"
_OFFSET: Final = "clock_offset_s"
_NO_SOURCE: Final = "no program of the robot reports it"

_Snapshots = Mapping[Role, tuple[Snapshot, Snapshot]]
"""Snapshots of each robot before and after an attempt; empty if they are missing."""


def measure(evidence: AttemptEvidence, names: Mapping[Role, str], measured: Measured) -> Measured:
    """Return the columns of an attempt, and the columns of the robots' states.

    If a one-way delay is empty because the offset of the clocks is unknown, the reason also names wrong clocks and
    missing time sources.

    Args:
        evidence: The attempt.
        names: Name of the robot in each role.
        measured: Columns of the attempt's steps.
    """
    snapshots_by_role = {role: snapshots.read_attempt(evidence, role) for role in names}
    clock_columns, clock_marks, has_clocks = _measure_clocks(evidence, names, snapshots_by_role, measured)
    health_by_role = {
        role: (health.parse(before), health.parse(after)) for role, (before, after) in snapshots_by_role.items()
    }
    flags = {role: health.flags_during(*states) for role, states in health_by_role.items()}
    radio_columns, radio_marks, has_airtime = _measure_radios(names, snapshots_by_role)
    all_marks = (*clock_marks, *health.marks(names, flags), *radio_marks)
    is_known = has_clocks or has_airtime or any(value is not None for value in flags.values())
    measured = (
        _with_clock_reasons(measured, "; ".join(mark.reason for mark in clock_marks)) | clock_columns | radio_columns
    )
    for role in names:
        # Declared columns without a value are missing.
        measured |= health.measure(role, *health_by_role[role]) | Measured.all_missing(
            declare_columns(role), _NO_SOURCE
        )
    return measured | marks.measure(all_marks, is_known=is_known)


def problems(
    evidence: AttemptEvidence, names: Mapping[Role, str], radios: Mapping[Role, Mapping[str, str]]
) -> Iterator[str]:
    """Yield a sentence for each state of a robot that makes the attempt void.

    Args:
        evidence: The attempt.
        names: Name of the robot in each role.
        radios: Settings of the robots' radios at the start of the trial.
    """
    for role, name in names.items():
        pair = snapshots.read_attempt(evidence, role)
        if any(RADIO_SOURCES & snapshot.keys() for snapshot in pair):
            from fieldkit.measure.robot_state import neighbourhood  # noqa: PLC0415 (few robots have iw)

            states = tuple(map(neighbourhood.parse, pair))
            if reason := neighbourhood.setting_problem(states, radios.get(role, {})):
                yield f"{name}: {reason}"


def _measure_clocks(
    evidence: AttemptEvidence, names: Mapping[Role, str], snapshots_by_role: _Snapshots, measured: Measured
) -> tuple[Measured, list[RepeatMark], bool]:
    """Return the columns of the clocks, their marks, and True if a program reports on a clock."""
    offsets = {role: exchanges.laptop_offset(evidence, role) for role in names}
    result = Measured()
    for role, offset in offsets.items():
        result |= exchanges.measure(role, offset)
    has_source = any(CLOCK_SOURCES & snapshot.keys() for pair in snapshots_by_role.values() for snapshot in pair)
    if not has_source and not any(offset and exchanges.is_wrong(offset) for offset in offsets.values()):
        return result, [], False
    from fieldkit.measure.robot_state import clock_states  # noqa: PLC0415 (see the docstring of the module)

    robot_clocks = {}
    for role, name in names.items():
        before, after = snapshots_by_role[role]
        during = evidence.read_or_none(snapshots.read_series, snapshots.during_file(role)) or ()
        robot_clocks[role] = clock_states.read(name, (before, *during, after), offsets[role])
    for role, clock in robot_clocks.items():
        result |= clock_states.measure(role, clock)
    is_known = any(clock.report is not None for clock in robot_clocks.values())
    return result, list(clock_states.marks(robot_clocks, measured)), is_known


def _measure_radios(
    names: Mapping[Role, str], snapshots_by_role: _Snapshots
) -> tuple[Measured, list[RepeatMark], bool]:
    """Return the columns of the radios, their marks, and True if an airtime is known."""
    if not any(RADIO_SOURCES & snapshot.keys() for pair in snapshots_by_role.values() for snapshot in pair):
        return Measured(), [], False
    from fieldkit.measure.robot_state import neighbourhood  # noqa: PLC0415 (see the docstring of the module)

    radios = {role: tuple(map(neighbourhood.parse, pair)) for role, pair in snapshots_by_role.items()}
    result = Measured()
    for role, states in radios.items():
        result |= neighbourhood.measure(role, states)
    is_known = any(state.others_share is not None for states in radios.values() for state in states)
    return result, list(neighbourhood.marks(names, radios)), is_known


def _with_clock_reasons(measured: Measured, reasons: str) -> Measured:
    """Append the reasons to the columns `one_way_withheld` of steps whose clock offset is unknown."""
    values = dict(measured.values)
    for name, value in measured.values.items():
        offset_name = name.removesuffix(_ONE_WAY) + _OFFSET
        if reasons and plain_name(name) == _ONE_WAY and offset_name not in measured.values:
            values[name] = f"{value}; {reasons}"
    return Measured(values, measured.missing)
