"""What a trial needs of its robots, looked at before repeat 1; each failure names its remedy."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.backends import Robot
from fieldkit.deadline import Deadline
from fieldkit.errors import RobotError
from fieldkit.model import RepeatId, Role
from fieldkit.procedures import steps_of
from fieldkit.remote import jobs
from fieldkit.remote.command import printable, with_environment
from fieldkit.remote.shell import Shell
from fieldkit.steps.base import Planned, Shells, together
from fieldkit.steps.capture import Capture
from fieldkit.steps.transfer import Transfer
from fieldkit.trial.plan import Plan

CHECK_S: Final = 10.0
MIN_FREE_KIB: Final = 100 * 1024
BASE_PROGRAMS: Final = ("setsid", "flock", "tar", "sha256sum", "ip")


@dataclass(frozen=True)
class Finding:
    """The outcome of one check.

    Attributes:
        robot: Name of the robot.
        check: What was looked at.
        detail: What was found; for a program, where it is.
        remedy: What to do about it; empty when the check passed.
    """

    robot: str
    check: str
    detail: str
    remedy: str = ""


@dataclass(frozen=True)
class _Probe:
    check: str
    argv: Sequence[str]
    remedy: str


def preflight(plan: Plan, shells: Shells) -> tuple[Finding, ...]:
    """Check every robot of the cast and put the job script on it.

    Returns:
        All findings, robot by robot.

    Raises:
        LinkError: A robot did not answer.
    """
    robots = plan.robots()
    per_robot = together(*(lambda role=role: _check(plan, robots[role], shells[role]) for role in robots))
    return tuple(finding for findings in per_robot for finding in findings)


def demand(findings: Sequence[Finding]) -> None:
    """Stop the trial if a check failed.

    Raises:
        RobotError: Names every failed check with its remedy.
    """
    failed = [finding for finding in findings if finding.remedy]
    if failed:
        lines = "".join(f"\n  {one.robot}: {one.check}: {one.detail}; {one.remedy}" for one in failed)
        raise RobotError(f"preflight found {len(failed)} problem(s):{lines}", remedy="mend these, then start again")


def _check(plan: Plan, robot: Robot, shell: Shell) -> list[Finding]:
    jobs.install(shell, Deadline.after(CHECK_S))
    findings = [_look(shell, robot, probe) for probe in _probes(plan, robot)]
    left = jobs.left(shell, Deadline.after(CHECK_S))
    findings.append(
        Finding(robot.name, "leftover jobs", "; ".join(left), "on the robot: kill -TERM -- -PID, for each PID named")
        if left
        else Finding(robot.name, "leftover jobs", "none")
    )
    return findings


def _look(shell: Shell, robot: Robot, probe: _Probe) -> Finding:
    done = shell.run(probe.argv, deadline=Deadline.after(CHECK_S), check=False)
    detail = printable(done.stdout + done.stderr) or "no answer"
    return Finding(robot.name, probe.check, detail, "" if done.exit_code == 0 else probe.remedy)


def _probes(plan: Plan, robot: Robot) -> Iterator[_Probe]:
    interface = robot.profile.radio.interface
    yield _Probe(
        f"address on {interface}",
        _script(
            'ip -4 -o addr show dev "$1" | grep -F " $2/" || { echo "no $2 on $1"; false; }', interface, robot.address
        ),
        f"check interface in the profile and address in the site file; ip addr show dev {shlex.quote(interface)}",
    )
    yield _Probe(
        "free disk",
        _script('df -Pk . | awk -v min="$1" \'NR==2 {print $4 " KiB"; exit $4 < min}\'', str(MIN_FREE_KIB)),
        f"free {MIN_FREE_KIB // 1024} MiB in the home of the user",
    )
    for program in BASE_PROGRAMS:
        yield _Probe(program, ("sh", "-c", 'command -v "$1"', "sh", program), f"install {program}")
    for program, setup in dict.fromkeys((one.program, one.setup) for one in _planned(plan, robot.role)):
        find = ("sh", "-c", 'command -v "$1"', "sh", program)
        yield _Probe(
            program,
            with_environment(find, setup=setup),
            f"install it on the robot, or correct the profile {robot.profile.name}",
        )
    for step in steps_of(plan.procedure, Capture):
        if robot.role in step.robots:
            yield _capture_right(robot)
    for transfer in steps_of(plan.procedure, Transfer):
        if transfer.receiver is robot.role:
            yield _port_free(transfer.port)


def _planned(plan: Plan, role: Role) -> Iterator[Planned]:
    for protocol in plan.protocols:
        scene = plan.scene(RepeatId(protocol, 1), "preflight")
        for entry in plan.procedure.steps:
            yield from (one for one in entry.step.commands(scene) if one.role is role)


def _capture_right(robot: Robot) -> _Probe:
    tools = robot.profile.tools
    # A capture by sudo runs the job script as root, to signal what it started.
    prefix = ("sudo", "-n", "sh", "-c", 'exec "$@"', "sh") if tools.capture_right == "sudo" else ()
    # Listing link types opens the interface, which needs the same right as a capture.
    return _Probe(
        "right to capture",
        (*prefix, tools.capture, "-L", "-i", robot.profile.radio.interface),
        f"sudo setcap cap_net_raw,cap_net_admin+eip $(command -v {shlex.quote(tools.capture)}), "
        "or capture_right: sudo in the profile with a NOPASSWD rule",
    )


def _port_free(port: int) -> _Probe:
    taken = f":{port:04X} [0-9A-F]+:0000 (0A|07) "
    return _Probe(
        f"port {port} free",
        _script(
            '! grep -E "$1" /proc/net/tcp /proc/net/tcp6 /proc/net/udp /proc/net/udp6 2>/dev/null && echo free', taken
        ),
        f"find out who listens: ss -lntup | grep {port}",
    )


def _script(text: str, *words: str) -> tuple[str, ...]:
    return ("sh", "-c", text, "sh", *words)
