"""`fieldkit check`: check the requirements of a trial on robots and laptop, with a remedy for each problem."""

import argparse
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_findings, showing_events
from fieldkit.cli.parser import Parser
from fieldkit.core import plugins
from fieldkit.core.errors import RobotError
from fieldkit.core.events import PhaseStarted
from fieldkit.core.model import Distance, Verdict
from fieldkit.core.prompts import Unattended

if TYPE_CHECKING:
    from fieldkit.trial.running.preflight import FleetCheck


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit check`."""
    parser.description = (
        "Check everything that a trial of the procedure needs from the robots and from this machine. The robots need "
        "not be placed, and only the scripts of fieldkit are installed on them. `fieldkit trial` makes the same "
        "checks, except for time sources, telemetry sources and a test recording. For the estimate of disk space, "
        "give --repeats and --record of the planned trial."
    )
    parser.takes_lengths = True
    parser.epilog = "example: fieldkit check los --topology masterless"
    parser.add_argument(
        "procedure", metavar="PROCEDURE", nargs="?", default="los", help="name of a procedure (default: los)"
    )
    shared.add_site(parser)
    shared.add_overrides(parser)
    for point in plugins.entry_points(plugins.FLEET_CHECKS):
        parser.add_argument(
            f"--{point.name}",
            dest="fleet_checks",
            action="append_const",
            const=point.name,
            default=[],
            help=f"also check the {point.name.upper()} network between the robots: settings, and test datagrams",
        )
    shared.add_json(parser)
    parser.set_defaults(run=run)


_CHECK_DISTANCE = Distance(metres=1.0, label="check")
"""Distance of the robots if fieldkit places them, as in an emulation. A person does not place robots for a check."""


def _fleet_checks(names: Sequence[str]) -> "list[FleetCheck]":
    points = plugins.entry_points(plugins.FLEET_CHECKS)
    return [plugins.load(point) for point in points if point.name in names]


def run(arguments: argparse.Namespace) -> int:
    """Check, print every finding, and return 0 if a trial could start."""
    from fieldkit.backends.protocols import simulators_of
    from fieldkit.cli import cli_options
    from fieldkit.trial.request import make_plan
    from fieldkit.trial.running import preflight

    request = cli_options.request(arguments, _CHECK_DISTANCE)
    with showing_events(as_json=arguments.json) as sink:
        name, backend = cli_options.backend(arguments, sink)
        if (code := cli_options.run_elsewhere(backend, arguments, Path("trials"))) is not None:
            return code
        robots_by_role = backend.cast(request.effective_topology)
        plan = make_plan(
            request,
            backend=name,
            cast=robots_by_role,
            now=datetime.now(UTC),
            lab_bytes=backend.lab_bytes,
            simulators=simulators_of(backend),
        )
        with backend.open(plan.cast, seed=plan.seed, sink=sink, operator=Unattended()) as lab:
            lab.place(plan.placement)
            sink(PhaseStarted("check"))
            result = preflight.check(
                plan, lab.shells, Path("trials"), all_checks=True, fleet_checks=_fleet_checks(arguments.fleet_checks)
            )
            findings = result.findings
        if arguments.json:
            for finding in findings:
                sink(finding)
    if not arguments.json:
        show_findings(findings)
    return RobotError.exit_code if any(finding.status is Verdict.FAIL for finding in findings) else 0
