"""Check of the robots' time sources: the program that sets each clock, and contradictions with measured offsets."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.measure.robot_clock import Offset, offset
from fieldkit.measure.robot_state import clock_states, exchanges, snapshots
from fieldkit.measure.robot_state.clock_report import ClockReport
from fieldkit.remote import jobs, script
from fieldkit.remote.shell import Shell
from fieldkit.steps import clocks as clock_exchanges
from fieldkit.trial.check import contact
from fieldkit.trial.check.report import Report

CHECK: Final = "time source"

SNAPSHOT_S: Final = 15.0
"""Timeout of a snapshot: the outputs of programs that report the robot's state. These programs need at most 2 s; the
remaining time is for a slow connection."""

_NO_PROGRAM: Final = "no program of the robot reports that it sets the clock"
_INSTALL_REMEDY: Final = (
    "sudo apt-get install chrony   # then add a line `server ADDRESS iburst` to /etc/chrony/chrony.conf"
)
_REMEDIES: Final[Mapping[str, str]] = {
    "chronyd does not run": "sudo systemctl enable --now chrony",
    "chrony": "chronyc -n sources   # add a line `server ADDRESS iburst` to /etc/chrony/chrony.conf, restart chrony",
    "systemd-timesyncd": "sudo timedatectl set-ntp true   # and set NTP=ADDRESS in /etc/systemd/timesyncd.conf",
    "ptp4l": "sudo pmc -u -b 0 'GET PORT_DATA_SET'   # its network needs a PTP master",
}
"""Remedy by problem, or by program."""
_OFFSET_REMEDIES: Final[Mapping[str, str]] = {"chrony": "sudo chronyc makestep"}
_OFFSET_REMEDY: Final = "wait until the program has corrected the clock, or restart the program"
"""Remedies for a clock that differs from its time source: by program, and for all other programs."""


@dataclass(frozen=True)
class RobotTime:
    """Clock of one robot.

    Attributes:
        offset: Offset from the laptop's clock; None if the robot sent no time.
        reports: Reports of the robot's programs.
    """

    offset: Offset | None
    reports: tuple[ClockReport, ...]


def read_reports(shell: Shell) -> tuple[ClockReport, ...]:
    """Return the reports of a robot's programs about its clock. `jobs.install` must be called first.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The script failed.
    """
    output = script.call(shell, "snapshot", deadline=Deadline.after(SNAPSHOT_S))
    return clock_states.reports(snapshots.parse(output.decode(errors="replace")))


def read(shell: Shell) -> RobotTime:
    """Log in to a robot and return the state of its clock. Raises the same errors as `read_reports`."""
    jobs.install(shell, Deadline.after(contact.CONTACT_S))
    times = clock_exchanges.exchanges(shell, contact.CONTACT_S)
    return RobotTime(offset(times) if times else None, read_reports(shell))


def judge(reports: Sequence[ClockReport], report: Report, *, is_required: bool = False) -> None:
    """Add a finding for each report on the program that sets a robot's clock.

    Args:
        reports: Reports of the robot's programs.
        report: Receives the findings.
        is_required: True to add a warning if the robot has no such program.
    """
    for clock_report in reports:
        if clock_report.problem:
            remedy = _REMEDIES.get(clock_report.problem) or _REMEDIES.get(clock_report.program, _INSTALL_REMEDY)
            report.warn(CHECK, clock_report.problem, remedy)
        else:
            error = "" if clock_report.error_s is None else f" \N{PLUS-MINUS SIGN} {clock_report.error_s:.6f} s"
            detail = f"{clock_report.program} follows {clock_report.reference}, {clock_report.offset_s:+.6f} s{error}"
            if exchanges.is_wrong(Offset(clock_report.offset_s or 0.0, clock_report.error_s or 0.0)):
                report.warn(CHECK, detail, _OFFSET_REMEDIES.get(clock_report.program, _OFFSET_REMEDY))
            else:
                report.ok(CHECK, detail)
    if not reports and is_required:
        report.warn(CHECK, _NO_PROGRAM, _INSTALL_REMEDY)


def contradictions(times: Mapping[str, RobotTime]) -> Iterator[str]:
    """Yield a sentence for each pair of robots whose measured offset contradicts the reports of their programs.

    Args:
        times: Clocks by the names of the robots.
    """
    for (first, first_time), (second, second_time) in combinations(times.items(), 2):
        if first_time.offset is None or second_time.offset is None:
            continue
        measured = Offset(
            second_time.offset.offset_s - first_time.offset.offset_s,
            second_time.offset.error_s + first_time.offset.error_s,
        )
        reports = clock_states.choose_report(first_time.reports), clock_states.choose_report(second_time.reports)
        if sentence := clock_states.contradiction((first, second), reports, measured):
            yield sentence
