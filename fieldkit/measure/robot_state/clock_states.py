"""Clocks of the robots in an attempt: reports of the robots' programs, and offsets that fieldkit measures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.core.columns import Measured, Value, plain_name
from fieldkit.core.model import Role
from fieldkit.measure.robot_clock import Offset
from fieldkit.measure.robot_state import chrony, exchanges, ptp, timesyncd
from fieldkit.measure.robot_state.clock_report import ClockReport
from fieldkit.measure.robot_state.marks import RepeatMark
from fieldkit.measure.robot_state.snapshots import Snapshot

_MARGIN_S: Final = 0.001
"""Difference between measured and reported offsets that is tolerated in addition to their errors."""

WRONG_CLOCK: Final = "wrong clock"
NO_SOURCE: Final = "no time source"
DISAGREE: Final = "clocks disagree"
"""Names of marks."""


@dataclass(frozen=True)
class RobotClock:
    """Clock of one robot in an attempt.

    Attributes:
        name: Name of the robot.
        reports: Reports before, during and after the attempt (`choose_report`). A report is missing if no program
            returned one.
        laptop: Offset from the laptop's clock; None if unknown.
    """

    name: str
    reports: tuple[ClockReport, ...] = ()
    laptop: Offset | None = None

    @property
    def report(self) -> ClockReport | None:
        """The first report with a problem or, without one, the report with the largest possible offset.

        None without reports.
        """
        problems = [report for report in self.reports if not report.is_synchronized]
        return problems[0] if problems else max(self.reports, key=_largest_offset_s, default=None)


def _largest_offset_s(report: ClockReport) -> float:
    return abs(report.offset_s or 0.0) + (report.error_s or 0.0)


def reports(snapshot: Snapshot) -> tuple[ClockReport, ...]:
    """Return the reports of all programs in a snapshot.

    If there are none, but the kernel's clock is known to be unsynchronized, the only report states this problem.
    """
    parsed_reports: list[ClockReport | None] = []
    if (output := snapshot.get(chrony.NAME)) is not None:
        parsed_reports.append(chrony.parse(output))
    if (output := snapshot.get(ptp.NAME)) is not None:
        parsed_reports.append(ptp.parse(output))
    state = snapshot.get(timesyncd.STATE_NAME)
    if (output := snapshot.get(timesyncd.NAME)) is not None:
        parsed_reports.append(timesyncd.parse(output, state))
    program_reports = tuple(report for report in parsed_reports if report is not None)
    if not program_reports and state is not None and timesyncd.is_synchronized(state) is False:
        return (ClockReport("", problem="no program synchronizes the clock"),)
    return program_reports


def choose_report(candidates: Sequence[ClockReport]) -> ClockReport | None:
    """Return the first report of a synchronized clock or, without one, the first report; None without reports."""
    return next((report for report in candidates if report.is_synchronized), candidates[0] if candidates else None)


def read(name: str, attempt_snapshots: Sequence[Snapshot], laptop: Offset | None) -> RobotClock:
    """Return the clock of a robot in an attempt.

    Args:
        name: Name of the robot.
        attempt_snapshots: Snapshots of the robot before, during and after the attempt.
        laptop: Offset of the robot's clock from the laptop's; None if unknown.
    """
    chosen_reports = (choose_report(reports(snapshot)) for snapshot in attempt_snapshots)
    return RobotClock(name, tuple(report for report in chosen_reports if report is not None), laptop)


def measure(role: Role, clock: RobotClock) -> Measured:
    """Return the columns of one robot's clock."""
    report = clock.report
    is_synchronized = report is not None and report.is_synchronized
    reason = (report.problem if report else "") or "no program of the robot reports on its clock"
    values: dict[str, Value | None] = {
        f"{role}_time_source": f"{report.program} {report.reference}".strip() if report and is_synchronized else None,
        f"{role}_time_offset_s": report.offset_s if report and is_synchronized else None,
        f"{role}_time_error_s": report.error_s if report and is_synchronized else None,
    }
    return Measured.from_optional(values, reason)


def marks(clocks: Mapping[Role, RobotClock], measured: Measured) -> Iterator[RepeatMark]:
    """Yield the marks of an attempt that its clocks cause.

    Args:
        clocks: The clocks.
        measured: The measured columns of the attempt's steps.
    """
    for clock in clocks.values():
        if sentence := wrong_clock(clock):
            yield RepeatMark(WRONG_CLOCK, sentence)
        elif clock.report is not None and clock.report.problem:
            yield RepeatMark(NO_SOURCE, f"{clock.name}: {clock.report.problem}")
    yield from (RepeatMark(DISAGREE, sentence) for sentence in contradictions(clocks, measured))


def wrong_clock(clock: RobotClock) -> str | None:
    """Return a sentence if a clock is known to be wrong by more than `exchanges.WRONG_S`; otherwise None."""
    report = clock.report
    offset_s = None
    if clock.laptop is not None and exchanges.is_wrong(clock.laptop):
        offset_s = clock.laptop.offset_s
    elif report is not None and report.is_synchronized and report.offset_s is not None:
        is_wrong = exchanges.is_wrong(Offset(report.offset_s, report.error_s or 0.0))
        offset_s = report.offset_s if is_wrong else None
    if offset_s is None:
        return None
    source = ""
    if report is not None:
        source = (
            f", {report.problem}"
            if report.problem
            else f", although {report.program} has the source {report.reference}"
        )
    return f"{clock.name} is off by {abs(offset_s):.1f} s{source}"


def contradictions(clocks: Mapping[Role, RobotClock], measured: Measured) -> Iterator[str]:
    """Yield a sentence for each measured clock offset that the reports of sender and receiver contradict."""
    if Role.SENDER not in clocks or Role.RECEIVER not in clocks:
        return
    pair = clocks[Role.SENDER], clocks[Role.RECEIVER]
    for name, value in measured.values.items():
        error = measured.values.get(name.removesuffix("offset_s") + "offset_error_s")
        if plain_name(name) == "clock_offset_s" and isinstance(value, float) and isinstance(error, float):
            names, reports_of_pair = (pair[0].name, pair[1].name), (pair[0].report, pair[1].report)
            if sentence := contradiction(names, reports_of_pair, Offset(value, error)):
                yield sentence


def contradiction(
    names: tuple[str, str], reports_of_pair: tuple[ClockReport | None, ClockReport | None], measured: Offset
) -> str | None:
    """Return a sentence if the reports of two robots contradict the measured offset between their clocks.

    None if they do not, or if a clock is not synchronized or has no report.

    Args:
        names: Names of the two robots.
        reports_of_pair: Reports of the two robots; None for a robot without a report.
        measured: Clock of the second robot minus clock of the first.
    """
    first, second = reports_of_pair
    if first is None or second is None or not (first.is_synchronized and second.is_synchronized):
        return None
    reported_s = (second.offset_s or 0.0) - (first.offset_s or 0.0)
    error_s = (second.error_s or 0.0) + (first.error_s or 0.0)
    if abs(measured.offset_s - reported_s) <= measured.error_s + error_s + _MARGIN_S:
        return None
    return (
        f"the clocks of {names[0]} and {names[1]} differ by {measured.offset_s:+.3f} s "
        f"(error {measured.error_s:.3f} s), but {_programs_report(first, second)} {reported_s:+.3f} s "
        f"(error {error_s:.3f} s)"
    )


def _programs_report(*reports: ClockReport) -> str:
    names = list(dict.fromkeys(report.program for report in reports))
    return f"{names[0]} reports" if len(names) == 1 else f"{' and '.join(names)} report"
