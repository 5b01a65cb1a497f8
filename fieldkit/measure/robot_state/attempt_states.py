"""Measure the robots' reports on their clocks and computers in an attempt, and mark it."""

from collections.abc import Iterator, Mapping
from typing import Final

from fieldkit.core.columns import Measured, plain_name
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state import clocks, health, marks, neighbourhood

_ONE_WAY: Final = "one_way_withheld"
_OFFSET: Final = "clock_offset_s"


def measure(evidence: AttemptEvidence, names: Mapping[Role, str], measured: Measured) -> Measured:
    """Return the columns of an attempt, with those of the robots' reports.

    If a one-way delay is withheld because no offset of the clocks is known, its reason also names wrong clocks and
    missing time sources.

    Args:
        evidence: The attempt.
        names: Name of the robot in each role.
        measured: The columns of its steps.
    """
    robot_clocks = clocks.read(evidence, names)
    computers = {role: health.read(evidence, role) for role in names}
    flags = {role: health.flags_during(*states) for role, states in computers.items()}
    all_marks = list(clocks.marks(robot_clocks, measured))
    clock_reasons = "; ".join(mark.reason for mark in all_marks)
    radios = {role: neighbourhood.read(evidence, role) for role in names}
    all_marks += (*health.marks(names, flags), *neighbourhood.marks(names, radios))
    shares = (state.others_share for states in radios.values() for state in states)
    reports = (clock.report for clock in robot_clocks.values())
    is_known = any(value is not None for value in (*reports, *flags.values(), *shares))
    for role, clock in robot_clocks.items():
        measured |= clocks.measure(role, clock) | health.measure(role, *computers[role])
        measured |= neighbourhood.measure(role, radios[role])
    return _with_clock_reasons(measured, clock_reasons) | marks.measure(all_marks, is_known=is_known)


def problems(evidence: AttemptEvidence, names: Mapping[Role, str]) -> Iterator[str]:
    """Yield each reason why the states of the robots make an attempt void; arguments as for `measure`."""
    for role, name in names.items():
        if reason := neighbourhood.channel_problem(neighbourhood.read(evidence, role)):
            yield f"{name}: {reason}"


def _with_clock_reasons(measured: Measured, reasons: str) -> Measured:
    values = dict(measured.values)
    for name, value in measured.values.items():
        offset_name = name.removesuffix(_ONE_WAY) + _OFFSET
        if reasons and plain_name(name) == _ONE_WAY and offset_name not in measured.values:
            values[name] = f"{value}; {reasons}"
    return Measured(values, measured.missing)
