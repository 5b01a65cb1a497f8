"""Check that a robot has the programs that steps start, and fulfils the other needs of steps.

Most checks use the output of the probe, a script that reads the state of a robot. The others use the agent, a Python
program of fieldkit that is copied to the robot.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.config import locations
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Role
from fieldkit.remote.command import with_environment
from fieldkit.remote.shell import Shell
from fieldkit.steps import variants
from fieldkit.steps.capabilities import HasNeeds
from fieldkit.steps.scene import CommandResult, Need, Planned
from fieldkit.steps.variants import Tool, Variants
from fieldkit.trial import session_jobs
from fieldkit.trial.check import radio, tools
from fieldkit.trial.check.probe import MISSING_SECTION, Sections
from fieldkit.trial.check.report import Report
from fieldkit.trial.plan import Plan

BASE_PROGRAMS: Final = ("setsid", "mkfifo", "timeout", "awk", "tar", "sha256sum")
"""Programs that fieldkit needs on every robot, for all procedures."""

# Package names in Debian.
_PACKAGES: Final = {
    "setsid": "util-linux",
    "mkfifo": "coreutils",
    "timeout": "coreutils",
    "awk": "mawk",
    "tar": "tar",
    "sha256sum": "coreutils",
    "nc": "netcat-traditional",
    "nc.traditional": "netcat-traditional",
    "nc.openbsd": "netcat-openbsd",
    "ncat": "ncat",
    "tcpdump": "tcpdump",
    "ping": "iputils-ping",
    "busybox": "busybox",
    "iperf3": "iperf3",
    "python3": "python3",
}
_TOOLS_SECTION: Final = "tools"
_AGENT_TIMEOUT_S: Final = 30.0
"""Timeout of a check that the agent runs."""


@dataclass(frozen=True)
class ProbeResult:
    """Result of the probe of a robot. Later checks use it.

    Attributes:
        sections: Outputs of the probe's commands.
        variants: Variants of the robot's tools.
    """

    sections: Sections
    variants: Variants

    def has_program(self, program: str, needs: Sequence[Need]) -> bool:
        """Return True if the robot has a program that a step starts, and fulfils all needs of this program.

        Args:
            program: The program.
            needs: Needs of the steps on this robot.
        """
        names = (_section(program), *(need.name for need in needs if need.missing_program == program))
        return all(self.sections.get(name, MISSING_SECTION).ok for name in names)


def commands(plan: Plan, role: Role) -> dict[str, Sequence[str]]:
    """Return the commands that the probe must run on the robot in `role`, by section name."""
    profile = plan.cast[role].profile
    commands_by_section: dict[str, Sequence[str]] = {}
    for program, setup in _programs(plan, role):
        commands_by_section[_section(program)] = with_environment(
            ("sh", "-c", 'command -v "$1"', "sh", program), setup=setup
        )
    for need in needs_of(plan, role):
        commands_by_section[need.name] = need.argv
    commands_by_section[_TOOLS_SECTION] = tools.probe(profile, _tools(plan, role))
    return commands_by_section


def judge(plan: Plan, role: Role, sections: Sections, report: Report) -> Variants:
    """Report findings about the programs.

    Returns:
        The variants of the robot's tools, or the expected variants if this check failed.
    """
    profile = plan.cast[role].profile
    programs = dict.fromkeys(program for program, _ in _programs(plan, role))
    remedies = {job.program: job.remedy for job in _planned_jobs(plan, role)}
    present = [program for program in programs if sections.get(_section(program), MISSING_SECTION).ok]
    report.ok("programs", ", ".join(present) or "none found")
    needs = needs_of(plan, role)
    # If a ROS setup file is missing, the recorder is not found either. Only the setup file is then reported.
    explained_programs = {need.missing_program for need in needs if not sections.get(need.name, MISSING_SECTION).ok}
    for program in programs:
        if program not in present and program not in explained_programs:
            package = _PACKAGES.get(Path(program).name)
            profile_remedy = remedies.get(program) or (
                f"correct its name in profile {profile.name}: {locations.copy_profile_command(profile.name)}"
            )
            report.fail(program, "not found", f"sudo apt-get install {package}" if package else profile_remedy)
    interface = profile.radio.interface if radio.is_interface_missing(sections) else None
    for need in needs:
        # A need that uses a missing interface is skipped, because the missing interface is reported separately.
        if (not need.required_program or need.required_program in present) and interface not in need.argv:
            report.add(need.name, *need.judge(sections.get(need.name, MISSING_SECTION)))
    if len(present) < len(programs):
        return variants.expected(profile)
    return _judge_tools(profile, sections.get(_TOOLS_SECTION, MISSING_SECTION), report)


def check_agent(plan: Plan, role: Role, sections: Sections, shell: Shell, report: Report) -> None:
    """Report the agent's findings about needs of steps. The agent is installed if the robot has its interpreter.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The agent cannot be installed.
    """
    for need in needs_of(plan, role, by_agent=True):
        if sections.get(_section(need.required_program), MISSING_SECTION).ok:
            from fieldkit.remote import agent  # noqa: PLC0415 (few steps need the agent)

            agent.install(shell)
            completed = shell.run(need.argv, deadline=Deadline.after(_AGENT_TIMEOUT_S), check=False)
            text = (completed.stdout + completed.stderr).decode("utf-8", "replace")
            report.add(need.name, *need.judge(CommandResult(text, completed.exit_code)))


def _section(program: str) -> str:
    return f"program {program}"


def _tools(plan: Plan, role: Role) -> set[Tool]:
    return {job.tool for job in _planned_jobs(plan, role) if job.tool is not None}


def _judge_tools(profile: RobotProfile, result: CommandResult, report: Report) -> Variants:
    try:
        detected = tools.parse(result.text.encode(), profile)
    except RobotError as error:
        report.fail(_TOOLS_SECTION, error.what, error.remedy)
        return variants.expected(profile)
    # For netcat, the variant is reported: some variants print no version, and the formats of the others differ.
    words = [
        f"{detected.netcat} netcat" if tool is Tool.NETCAT else version for tool, version in detected.versions.items()
    ]
    if words:
        report.ok(_TOOLS_SECTION, ", ".join(words))
    return detected


def _programs(plan: Plan, role: Role) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each program that a step or fieldkit starts, with the setup files that must be sourced first."""
    yield from ((program, ()) for program in BASE_PROGRAMS)
    yield from dict.fromkeys((job.program, job.setup) for job in _planned_jobs(plan, role))


def _planned_jobs(plan: Plan, role: Role) -> Iterator[Planned]:
    """Yield the jobs of steps and of the session on a robot."""
    for scene in plan.scenes():
        yield from (job for job in plan.jobs(scene) if job.role is role)
    yield from (job for job in session_jobs.planned_jobs(plan.cast, plan.session) if job.role is role)


def needs_of(plan: Plan, role: Role, *, by_agent: bool = False) -> tuple[Need, ...]:
    """Return the needs of steps on a robot, without duplicates.

    Args:
        plan: The trial.
        role: Role of the robot.
        by_agent: True for the needs that the agent checks, False for those that the probe checks.
    """
    scene = plan.scenes()[0]
    steps = (placed.step for placed in plan.procedure.walk() if isinstance(placed.step, HasNeeds))
    needs = (need for step in steps for need in step.needs(scene) if need.role is role)
    return tuple({need.name: need for need in needs if need.agent == by_agent}.values())
