"""Checks of a robot's system with the output of the probe: kernel, disk, ports, battery."""

import re
from pathlib import Path
from typing import Final

from fieldkit.core import files
from fieldkit.core.model import Role
from fieldkit.core.units import format_bytes, format_duration
from fieldkit.remote.command import quote
from fieldkit.steps.capabilities import SendsTraffic
from fieldkit.trial import size
from fieldkit.trial.check.probe import MISSING_SECTION, Sections
from fieldkit.trial.check.report import Report, UserTools
from fieldkit.trial.plan import Plan

MIN_BATTERY_PERCENT: Final = 20
LONG_FETCH_S: Final = 60.0
"""A warning is given if fetching the evidence of one attempt takes longer than this."""

# Columns of `df -P` (POSIX): file system, blocks of 1024 bytes, used, available. With -P, long names do not wrap
# lines.
_DF: Final = re.compile(r"^\S.*\s[0-9]+\s+[0-9]+\s+(?P<free_kib>[0-9]{1,15})\s+[0-9]+%\s", re.MULTILINE)
_BATTERY: Final = re.compile(r"^(?P<name>\S{1,60}) (?P<percent>[0-9]{1,3})$", re.MULTILINE)


def user_tools(sections: Sections) -> UserTools:
    """Return the permissions and programs of a robot's user."""
    programs = sections.get("user-tools", MISSING_SECTION).text.split()
    return UserTools(sections.get("user", MISSING_SECTION).text.strip() == "0", frozenset(programs))


def judge(plan: Plan, role: Role, sections: Sections, report: Report) -> None:
    """Report findings about kernel, disk, ports and battery."""
    report.ok("system", sections.get("system", MISSING_SECTION).text)
    _judge_disk(plan, role, sections, report)
    scene = plan.scenes()[0]
    steps = (placed.step for placed in plan.procedure.walk() if isinstance(placed.step, SendsTraffic))
    flows = (flow for step in steps for flow in step.flows(scene) if not flow.has_other_listener)
    for port in dict.fromkeys(flow.port for flow in flows if flow.destination is role and flow.port is not None):
        _judge_port(port, sections, report)
    for battery in _BATTERY.finditer(sections.get("batteries", MISSING_SECTION).text):
        judge_battery(battery["name"], int(battery["percent"]), report)


def judge_laptop(plan: Plan, out: Path, report: Report) -> None:
    """Report the free space for the trial on the disk of `out`, and a warning if fetching the evidence takes long."""
    judge_disk_space(plan, files.free_bytes(out), files.nearest_existing(out), report)
    if (fetch_s := size.fetch_s(plan)) > LONG_FETCH_S:
        rate = size.FETCHED_BYTES_PER_S
        evidence, duration = format_bytes(rate * fetch_s), format_duration(fetch_s)
        report.warn(
            "fetch",
            f"an attempt leaves about {evidence}, which takes {duration} to fetch at {format_bytes(rate)}/s",
            "record less (--record, fewer topics), or fetch over a cable: control: separate",
        )


def judge_disk_space(plan: Plan, free_bytes: int, folder: Path, report: Report) -> None:
    """Report the free space on the laptop.

    The check fails if the space is not sufficient for one attempt. It gives a warning if the space is not sufficient
    for the whole trial.

    Args:
        plan: The trial.
        free_bytes: Free space in `folder`, or in its nearest existing parent.
        folder: The folder that the remedy names.
        report: Receives the finding.
    """
    attempt_bytes, trial_bytes = size.attempt_bytes(plan), size.trial_bytes(plan)
    detail = f"{format_bytes(free_bytes)} free, the trial needs about {format_bytes(trial_bytes)} or less"
    remedy = f"du -sh {quote((str(folder),))}/*   # delete what is not needed, or choose another --out"
    if free_bytes < attempt_bytes + size.RESERVE_BYTES:
        report.fail("disk", detail, remedy)
    elif free_bytes < trial_bytes + size.RESERVE_BYTES:
        report.warn("disk", detail, remedy)
    else:
        report.ok("disk", detail)


def _judge_disk(plan: Plan, role: Role, sections: Sections, report: Report) -> None:
    lines = list(_DF.finditer(sections.get("disk", MISSING_SECTION).text))
    if not lines:
        report.fail("disk", sections.get("disk", MISSING_SECTION).text, "df -Pk .")
        return
    free_bytes = int(lines[-1]["free_kib"]) << 10
    needed_bytes = size.evidence_bytes(plan, role) + size.reserve_bytes(plan, role)
    detail = f"{format_bytes(free_bytes)} free, {format_bytes(needed_bytes)} needed"
    if free_bytes < needed_bytes:
        report.fail(
            "disk", detail, "du -sh ~/.fieldkit/* ~/*.bag   # delete old bags, and evidence that was not fetched"
        )
    else:
        report.ok("disk", detail)


def _judge_port(port: int, sections: Sections, report: Report) -> None:
    """Report if a program listens on `port`. The second column of /proc/net/tcp is `ADDRESS:PORT` in hexadecimal."""
    columns = map(str.split, sections.get("listeners", MISSING_SECTION).text.splitlines())
    if any(len(words) > 1 and words[1].endswith(f":{port:04X}") for words in columns):
        tool = "netstat" if report.user_tools and "ss" not in report.user_tools.programs else "ss"
        report.fail(
            f"port {port}",
            "a program listens on it",
            f"sudo {tool} -lntup | grep :{port}   # find this program and stop it",
        )
    else:
        report.ok(f"port {port}", "free")


def judge_battery(name: str, percent: float, report: Report) -> None:
    """Report the charge of a battery."""
    if percent < MIN_BATTERY_PERCENT:
        report.warn("battery", f"{name} at {percent:.0f} %", "charge or replace it")
    else:
        report.ok("battery", f"{name} at {percent:.0f} %")
