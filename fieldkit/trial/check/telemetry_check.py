"""Query each telemetry source of a robot once, as a check; an entry point of the group `fieldkit.checks`."""

import os

from fieldkit.config.profiles import TELEMETRY
from fieldkit.core.columns import cell_text
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role
from fieldkit.remote.script import CALL, REPLY_S
from fieldkit.remote.shell import Shell
from fieldkit.trial.check.report import Report
from fieldkit.trial.check.software import ProbeResult
from fieldkit.trial.plan import Plan


def check_sources(plan: Plan, role: Role, shell: Shell, probe_result: ProbeResult, report: Report) -> None:  # noqa: ARG001
    """Report the values of each telemetry source of a robot, or the reason why a source gives no value.

    Raises:
        LinkError: The robot did not answer.
    """
    profile = plan.cast[role].profile
    if TELEMETRY not in profile.sections:
        return
    from fieldkit.telemetry import laptop_telemetry, source_readings  # noqa: PLC0415 (few profiles have sources)
    from fieldkit.telemetry.telemetry_section import telemetry_of  # noqa: PLC0415

    telemetry = telemetry_of(profile)
    for name, source in telemetry.sources.items() if telemetry is not None else ():
        if source.at == "laptop":
            output = laptop_telemetry.query_once(source, os.environ)
        else:
            address, interface, _, *options = source.poll_words(profile.radio.interface)
            # `poll` runs while the first file exists: `/` always does. The second argument `-` means: without a lock.
            words = (*CALL, "poll", "/", "-", address, interface, laptop_telemetry.ONCE, *options)
            output = shell.run(words, deadline=Deadline.after(source.limit + REPLY_S), check=False).stdout
        readings = source_readings.parse(output, source)
        if readings.values:
            values_text = ", ".join(
                f"{quantity} {cell_text(value)}" for quantity, value in readings.values[0].items()
            )
            if absent := source.absent_quantities(readings.values):
                detail = f"{values_text}; no possible value of {', '.join(absent)}"
                report.warn(f"telemetry {name}", detail, _remedy(source.kind))
            else:
                report.ok(f"telemetry {name}", values_text)
        else:
            reason = readings.reason or "the query did not end"
            report.warn(f"telemetry {name}", f"no value: {reason}", _remedy(source.kind))


def _remedy(kind: str) -> str:
    if kind == "modemmanager":
        return "enable extended signal reports: sudo mmcli -m any --signal-setup=2; without root, add a polkit rule"
    return "run the command of the source; this prints it: fieldkit trial ... --dry-run"
