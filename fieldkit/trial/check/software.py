"""What the probe asks and says of a robot's programs: those that steps start, the right to capture, ROS."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.core.errors import RobotError
from fieldkit.core.model import RepeatId, Role
from fieldkit.remote.command import quote, with_environment
from fieldkit.steps import variants
from fieldkit.steps.base import Planned
from fieldkit.steps.capture import Capture
from fieldkit.steps.record import Record
from fieldkit.steps.variants import Tool, Variants
from fieldkit.trial.check import tools
from fieldkit.trial.check.probe import MISSING, NOTHING, Section, Sections
from fieldkit.trial.check.report import Report
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import steps_of

BASE_PROGRAMS: Final = ("setsid", "mkfifo", "timeout", "awk", "tar", "sha256sum")

# Of Debian.
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
}
_RIGHT: Final = "right to capture"
_TOOLS: Final = "tools"
_ROS: Final = "ros"


def commands(plan: Plan, robot: Robot) -> dict[str, Sequence[str]]:
    """Return what the probe is to run on the robot, by the name of its section."""
    asked: dict[str, Sequence[str]] = {}
    for program, setup in _programs(plan, robot.role):
        asked[_at(program)] = with_environment(("sh", "-c", 'command -v "$1"', "sh", program), setup=setup)
    if any(robot.role in step.robots for step in steps_of(plan.procedure, Capture)):
        asked[_RIGHT] = _capture(robot)
    if _records(plan, robot.role):
        ros = robot.profile.ros
        said = ("sh", "-c", 'echo "$ROS_DISTRO $ROS_MASTER_URI"')
        asked[_ROS] = with_environment(said, setup=ros.command.setup, environment=ros.environment)
    asked[_TOOLS] = tools.probe(robot.profile, _tools(plan, robot.role))
    return asked


def judge(plan: Plan, robot: Robot, sections: Sections, report: Report) -> Variants:
    """Add what was found of the programs.

    Returns:
        Which variants of the tools the robot has; the expected ones where that is among what failed.
    """
    ros = robot.profile.ros.command
    records = bool(_records(plan, robot.role))
    programs = dict.fromkeys(program for program, _ in _programs(plan, robot.role))
    found = [program for program in programs if sections.get(_at(program), NOTHING).ok]
    report.ok("programs", ", ".join(found) or "none found")
    for program in programs:
        # A recorder that its setup file hides is told with that file.
        if program not in found and (sections.get(_ROS, NOTHING).ok or program != ros.record[0]):
            package = _PACKAGES.get(Path(program).name)
            correct = f"correct its name in profile {robot.profile.name}"
            report.fail(program, "not found", f"sudo apt-get install {package}" if package else correct)
    if _RIGHT in sections and robot.profile.tools.capture in found:
        _judge_right(robot, sections[_RIGHT], report)
    if records:
        _judge_ros(robot, sections.get(_ROS, NOTHING), report)
    if len(found) < len(programs):
        return variants.expected(robot.profile)
    return _judge_tools(robot, sections.get(_TOOLS, NOTHING), report)


def _at(program: str) -> str:
    return f"program {program}"


def _tools(plan: Plan, role: Role) -> set[Tool]:
    return {one.tool for one in _planned(plan, role) if one.tool is not None}


def _judge_tools(robot: Robot, said: Section, report: Report) -> Variants:
    try:
        found = tools.parse(said.text.encode(), robot.profile)
    except RobotError as error:
        report.fail(_TOOLS, error.what, error.remedy)
        return variants.expected(robot.profile)
    # A netcat names itself in too many ways, or not at all.
    words = [f"{found.netcat} netcat" if tool is Tool.NETCAT else said for tool, said in found.versions.items()]
    if words:
        report.ok(_TOOLS, ", ".join(words))
    return found


def can_record(plan: Plan, robot: Robot, sections: Sections) -> bool:
    """Return whether nothing is known to be missing for a recording on the robot."""
    needed = (_ROS, _at(robot.profile.ros.command.record[0]))
    return not _records(plan, robot.role) or all(sections.get(name, NOTHING).ok for name in needed)


def _programs(plan: Plan, role: Role) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each program that a step starts, or fieldkit itself, with the files to source before looking for it."""
    yield from ((program, ()) for program in BASE_PROGRAMS)
    yield from dict.fromkeys((one.program, one.setup) for one in _planned(plan, role))


def _planned(plan: Plan, role: Role) -> Iterator[Planned]:
    for protocol in plan.protocols:
        scene = plan.scene(RepeatId(protocol, 1), "check")
        for entry in plan.procedure.steps:
            yield from (one for one in entry.step.commands(scene) if one.role is role)


def _records(plan: Plan, role: Role) -> list[Record]:
    return [record for record in steps_of(plan.procedure, Record) if record.robot is role]


def _capture(robot: Robot) -> tuple[str, ...]:
    names = robot.profile.tools
    # A capture by sudo runs the job script as root, to signal what it started.
    prefix = ("sudo", "-n", "sh", "-c", 'exec "$@"', "sh") if names.capture_right == "sudo" else ()
    # Listing link types opens the interface, which needs the same right as a capture.
    return (*prefix, names.capture, "-L", "-i", robot.profile.radio.interface)


def _judge_right(robot: Robot, said: Section, report: Report) -> None:
    names = robot.profile.tools
    if said.ok:
        report.ok(_RIGHT, "by sudo -n" if names.capture_right == "sudo" else "the user's own")
    elif names.capture_right == "direct":
        remedy = f"sudo setcap cap_net_raw,cap_net_admin+eip $(command -v {quote((names.capture,))})"
        report.fail(_RIGHT, said.text, remedy)
    elif said.code == MISSING:
        report.fail(_RIGHT, "there is no sudo", f"write capture_right: direct in profile {robot.profile.name}")
    else:
        remedy = 'echo "$USER ALL=(ALL) NOPASSWD: $(command -v sh)" | sudo tee /etc/sudoers.d/fieldkit'
        report.fail(_RIGHT, said.text, remedy)


def _judge_ros(robot: Robot, said: Section, report: Report) -> None:
    command = robot.profile.ros.command
    distribution, _, master = said.text.partition(" ")
    if not said.ok:
        files = quote(command.setup)
        report.fail("ROS", said.text, f"ls -l {files}   # correct setup in profile {robot.profile.name}")
    elif robot.profile.ros.variant == "ros1" and not master:
        remedy = f"write ROS_MASTER_URI under ros.environment in profile {robot.profile.name}"
        report.warn("ROS", "ROS_MASTER_URI is not set", remedy)
    elif distribution and distribution != command.distribution:
        remedy = f"write distribution: {distribution} in profile {robot.profile.name}"
        report.warn("ROS", f"{distribution}; the profile says {command.distribution}", remedy)
    else:
        report.ok("ROS", ", master ".join(said.text.split()) or "no environment of its own")
