"""Preflight checks of robots and laptop, before the first repeat of a trial; `fieldkit check` runs all of them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.core import files, plugins
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, LinkError, RobotError
from fieldkit.core.events import Finding, PhaseStarted, Sink
from fieldkit.core.model import Role, Verdict
from fieldkit.core.threads import run_parallel
from fieldkit.core.units import format_count, format_duration
from fieldkit.remote import jobs
from fieldkit.remote.script import HELD_REMEDY
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Shells
from fieldkit.steps.variants import Variants
from fieldkit.trial import session_jobs, store
from fieldkit.trial.check import contact, probe, radio, software, system
from fieldkit.trial.check.report import LAPTOP, Report
from fieldkit.trial.check.software import ProbeResult
from fieldkit.trial.plan import Plan
from fieldkit.trial.running import locks
from fieldkit.trial.running.locks import LockState

JOBS_S: Final = 10.0
"""Timeout for installing the job script, which starts and stops programs on a robot, and for listing running jobs."""

RobotCheck = Callable[[Plan, Role, Shell, ProbeResult, Report], None]
"""A check that a package adds to `fieldkit check`. It runs after all other checks, and adds its findings to the
report. It raises `LinkError` if the robot did not answer, and `RobotError` if the robot could not be checked."""

FleetCheck = Callable[[Plan, Shells, Mapping[Role, Report]], None]
"""A check of all robots together, which a package adds as an option of `fieldkit check`. Its arguments are the plan,
the robots that can be reached, and the reports, to which it adds its findings. It raises no `FieldkitError`."""

_CONNECTION: Final = "connection"


def connect_all(cast: Cast, shells: Shells, sink: Sink) -> None:
    """Log in to every robot, before a person carries any robot to its place.

    Raises:
        ConfigurationError: There are no credentials.
        RobotError: A robot cannot be reached, has another host key, or refuses the login. The message lists all such
            robots.
    """
    sink(PhaseStarted("connect"))

    def log_in(role: Role) -> Report:
        report = Report(cast[role].name)
        try:
            contact.log_in(shells[role])
        except (LinkError, RobotError) as error:
            report.fail(_CONNECTION, error.what, error.remedy)
        return report

    require_passed(_all_findings(run_parallel(log_in, cast)))


@dataclass(frozen=True)
class PreflightResult:
    """Result of `check`.

    Attributes:
        findings: All findings, robot by robot. A robot that cannot be reached is a failed check.
        variants: Variants of the tools of each robot that was reached.
    """

    findings: tuple[Finding, ...]
    variants: Mapping[Role, Variants]


def check(
    plan: Plan, shells: Shells, out: Path, *, all_checks: bool, fleet_checks: Sequence[FleetCheck] = ()
) -> PreflightResult:
    """Check every robot of the cast and this machine, and install the job script on each robot.

    Args:
        plan: The trial.
        shells: The robots.
        out: Folder of the trial.
        all_checks: True to check locks as well, and to run the checks that packages add (`plugins.CHECKS`).
        fleet_checks: Checks of all robots together. They run after the other checks of robots, and only if no robot
            is locked.
    """
    reports = {role: Report(robot.name) for role, robot in plan.cast.items()}
    variants_by_role: dict[Role, Variants] = {}

    def check_robot(role: Role) -> bool:
        return _check_robot(plan, role, shells[role], variants_by_role, reports[role], all_checks=all_checks)

    are_unlocked = run_parallel(check_robot, plan.cast)
    for refusal in plan.refusals(variants_by_role):
        reports[refusal.role].fail("tools", refusal.what, refusal.remedy)
    reachable = {role: shells[role] for role in plan.cast if role in variants_by_role}
    laptop = Report(LAPTOP)
    if all(are_unlocked):
        for fleet_check in fleet_checks:
            fleet_check(plan, reachable, reports)
    elif fleet_checks:  # packets of these checks would disturb the measurement of the other user
        laptop.warn("network", "not checked, because a robot is locked", HELD_REMEDY)
    system.judge_laptop(plan, out, laptop)
    return PreflightResult(_all_findings([*reports.values(), laptop]), variants_by_role)


def check_before_trial(plan: Plan, shells: Shells, folder: Path, sink: Sink) -> Mapping[Role, Variants]:
    """Run the preflight checks, store all findings in the trial's folder, and report warnings and failures.

    Returns:
        The variants of the tools of each robot.

    Raises:
        RobotError: A check failed. The message lists all failed checks with their remedies.
    """
    result = check(plan, shells, folder.parent, all_checks=False)
    findings = result.findings
    fields = ((finding.robot, finding.check, finding.status, finding.detail, finding.remedy) for finding in findings)
    lines = map("\t".join, fields)
    files.write(folder / store.PREFLIGHT_FILE, "".join(f"{line}\n" for line in lines).encode())
    for finding in findings:
        if finding.status is not Verdict.OK:
            sink(finding)
    require_passed(findings)
    return result.variants


def require_passed(findings: Sequence[Finding]) -> None:
    """Raise an error if a check failed.

    Raises:
        RobotError: A check failed. The message lists all failed checks with their remedies.
    """
    failed = [finding for finding in findings if finding.status is Verdict.FAIL]
    if failed:
        lines = "".join(
            f"\n  {finding.robot}: {finding.check}: {finding.detail}\n    {finding.remedy}" for finding in failed
        )
        raise RobotError(
            f"the checks found {format_count(len(failed), 'problem')}:{lines}",
            remedy="fix these problems, then try again",
        )


def _check_robot(
    plan: Plan, role: Role, shell: Shell, variants_by_role: dict[Role, Variants], report: Report, *, all_checks: bool
) -> bool:
    """Add the findings about a robot. Return False if locks are checked and it is locked."""
    stage, robot = _CONNECTION, plan.cast[role]  # if an error is raised, it is reported as the check `stage`
    try:
        offset = contact.judge(shell, report)
        stage = "probe"
        sections = probe.run_probe(shell, robot.profile.radio.interface, software.commands(plan, role))
        report.user_tools = system.user_tools(sections)
        contact.judge_clock(offset, shell.ssh_destination, report)
        system.judge(plan, role, sections, report)
        variants_by_role[role] = software.judge(plan, role, sections, report)
        radio.judge(robot, sections, report)
        stage = "jobs"
        jobs.install(shell, Deadline.after(JOBS_S))
        # During a trial, the robots are already locked. The later checks would disturb the jobs of another user.
        if all_checks and not _judge_lock(locks.read_lock(shell), report):
            return False
        _judge_jobs(plan, jobs.list_running(shell, Deadline.after(JOBS_S)), report)
        stage = "agent"
        software.check_agent(plan, role, sections, shell, report)
        if not all_checks:
            return True
        from fieldkit.trial.check import time_sources  # noqa: PLC0415 (trials do not check time sources)

        stage = time_sources.CHECK
        time_sources.judge(time_sources.read_reports(shell), report)
        for point in plugins.entry_points(plugins.CHECKS):
            stage = point.name
            robot_check: RobotCheck = plugins.load(point)
            robot_check(plan, role, shell, ProbeResult(sections, variants_by_role[role]), report)
    except FieldkitError as error:
        report.fail(stage, error.what, error.remedy)
    return True


def _judge_jobs(plan: Plan, running_jobs: Sequence[str], report: Report) -> None:
    session_folders = {f"{planned.job.folder}/" for planned in session_jobs.planned_jobs(plan.cast, plan.session)}
    trial_folders = (f"/{plan.trial}/", *session_folders)
    other_jobs = [line for line in running_jobs if not any(folder in line for folder in trial_folders)]
    for line in other_jobs:
        report.fail("jobs", f"a job of an earlier trial is running: {line}", "fieldkit abort")
    if not other_jobs:
        report.ok("jobs", "no job of an earlier trial is running")


def _judge_lock(lock: LockState | None, report: Report) -> bool:
    """Report the lock of a robot; return True if it is not locked."""
    if lock is None:
        report.ok("lock", "the robot is not locked")
        return True
    holder, remaining = lock.holder, format_duration(lock.remaining_s)
    detail = f"{holder.user} has locked the robot for {holder.purpose}; the lock expires in {remaining}"
    report.fail("lock", detail, HELD_REMEDY)
    return False


def _all_findings(reports: Iterable[Report]) -> tuple[Finding, ...]:
    return tuple(finding for report in reports for finding in report.findings)
