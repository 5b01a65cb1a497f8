"""Log in to a robot and check its clock."""

from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.measure.robot_clock import Offset, offset
from fieldkit.remote.shell import Shell
from fieldkit.steps import clocks
from fieldkit.trial.check.report import Report

CONTACT_S: Final = 15.0
"""Timeout of a login, and of reading a robot's clock."""
WARN_S: Final = 1.0
"""A warning is given if the clock's offset is certainly larger than this."""
WRONG_CLOCK_S: Final = 1800.0
"""From this offset on, the clock is considered to be set incorrectly, not only to drift. Typical causes are a wrong
time zone and a board without a battery."""


def log_in(shell: Shell) -> None:
    """Log in to a robot.

    Raises:
        FieldkitError: The robot cannot be reached, has another host key, or refuses the login.
    """
    shell.run(("true",), deadline=Deadline.after(CONTACT_S))


def judge(shell: Shell, report: Report) -> Offset | None:
    """Report that the robot can be reached, and return the offset of its clock.

    The offset is None if the robot sent no time. The function raises the same errors as `log_in`.
    """
    log_in(shell)
    exchanges = clocks.exchanges(shell, CONTACT_S)
    detail = "host key and login are correct"
    if exchanges:
        fastest_s = min(exchange.response_ns - exchange.request_ns for exchange in exchanges) / 1e9
        detail += f", answers in {1e3 * fastest_s:.0f} ms"
    report.ok("connection", detail)
    return offset(exchanges) if exchanges else None


def judge_clock(clock_offset: Offset | None, ssh_destination: str, report: Report) -> None:
    """Report the offset of a robot's clock.

    Args:
        clock_offset: The offset; None if the robot reported no time.
        ssh_destination: Login command for a person (`Shell.ssh_destination`).
        report: Receives the finding.
    """
    if clock_offset is None:
        report.warn("clock", "date prints no time", "date -u +%s.%N")
        return
    magnitude_s = abs(clock_offset.offset_s)
    detail = (
        f"{clock_offset.offset_s:+.3f} s relative to the laptop, \N{PLUS-MINUS SIGN} {clock_offset.error_s:.3f} s"
    )
    if magnitude_s - clock_offset.error_s <= WARN_S:
        report.ok("clock", detail)
        return
    if magnitude_s >= WRONG_CLOCK_S:
        direction = "ahead" if clock_offset.offset_s > 0 else "behind"
        detail = f"{magnitude_s / 3600:.1f} hours {direction}: {detail}"
    command = "date -u -s @$(date +%s)"
    has_sudo = report.user_tools is None or report.user_tools.root or "sudo" in report.user_tools.programs
    robot_command = f"sudo {command}" if has_sudo else f"\"su -c '{command}'\""
    report.warn("clock", detail, f"ssh -t {ssh_destination} {robot_command}   # on the laptop")
