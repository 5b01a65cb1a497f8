"""`fieldkit clocks`: the clock of every robot, the program that sets it, and a remedy for each problem."""

import argparse
from contextlib import ExitStack
from typing import TYPE_CHECKING

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_findings, showing_events
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError, FieldkitError, RobotError
from fieldkit.core.model import Topology, Verdict

if TYPE_CHECKING:
    from fieldkit.backends.protocols import Backend, Cast


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit clocks`."""
    parser.description = (
        "List the clock of every robot of the site file: its offset from this machine's clock, the program that sets "
        "it with its time source, and a remedy for each problem. Report pairs of robots whose programs contradict "
        "the measured offsets. No clock is changed; only the job script of fieldkit is installed. Exit code 3 if the "
        "clock of a robot could not be read, 1 if there is another problem."
    )
    shared.add_site(parser)
    shared.add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the findings robot by robot, and return 0 if there is no problem."""
    from fieldkit.cli import cli_options
    from fieldkit.core.prompts import Unattended
    from fieldkit.core.threads import run_parallel
    from fieldkit.remote.shell import Shell
    from fieldkit.trial.check import contact, time_sources
    from fieldkit.trial.check.report import LAPTOP, Report

    with showing_events(as_json=arguments.json) as sink, ExitStack() as stack:
        _, backend = cli_options.backend(arguments, sink)
        robots: dict[str, Shell | FieldkitError] = dict(stack.enter_context(backend.persistent_shells(sink=sink)))
        if not robots:  # emulated robots run only while their lab runs
            cast = _any_cast(backend)
            testbed = stack.enter_context(backend.open(cast, seed=1, sink=sink, operator=Unattended()))
            robots = {robot.name: testbed.shells[role] for role, robot in cast.items()}
        reports = {name: Report(name) for name in robots}
        times: dict[str, time_sources.RobotTime] = {}

        def check(name: str) -> None:
            shell, report = robots[name], reports[name]
            try:
                if isinstance(shell, FieldkitError):
                    raise shell
                times[name] = time_sources.read(shell)
            except FieldkitError as error:
                report.fail("connection", error.what, error.remedy)
                return
            contact.judge_clock(times[name].offset, shell.ssh_destination, report)
            time_sources.judge(times[name].reports, report, is_required=True)

        run_parallel(check, list(robots))
        laptop = Report(LAPTOP)
        for sentence in time_sources.contradictions({name: times[name] for name in robots if name in times}):
            laptop.warn("clocks", sentence, "fieldkit check   # then correct the time source of one of them")
        findings = [finding for report in (*reports.values(), laptop) for finding in report.findings]
        if arguments.json:
            for finding in findings:
                sink(finding)
    if not arguments.json:
        show_findings(findings)
    statuses = {finding.status for finding in findings}
    if Verdict.FAIL in statuses:
        return RobotError.exit_code
    return FieldkitError.exit_code if Verdict.WARN in statuses else 0


def _any_cast(backend: "Backend") -> "Cast":
    """Return the robots of the first topology for which the site file has roles."""
    try:
        return backend.cast(Topology.MASTER)
    except ConfigurationError:
        return backend.cast(Topology.MASTERLESS)
