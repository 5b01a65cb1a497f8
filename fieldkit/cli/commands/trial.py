"""`fieldkit trial PROCEDURE DISTANCE ...`: run trials."""

import argparse
import secrets
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import showing_events
from fieldkit.cli.interrupts import interruptible
from fieldkit.cli.parser import Parser
from fieldkit.core.events import Note
from fieldkit.core.units import format_count, parse_distance

if TYPE_CHECKING:
    from fieldkit.trial.plan import Plan


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit trial`."""
    parser.description = "Run a procedure at one or more distances; each distance is a trial with a separate folder."
    parser.takes_lengths = True
    parser.epilog = "example: fieldkit trial los 30ft --repeats 3 --record 2s"
    parser.add_argument("procedure", metavar="PROCEDURE", help="name of a procedure, see `fieldkit procedures`")
    parser.add_argument("distances", metavar="DISTANCE", nargs="+", help="with a unit, for example 30ft or 9.1m")
    shared.add_site(parser)
    shared.add_overrides(parser)
    parser.add_argument(
        "--seed",
        type=shared.natural,
        metavar="N",
        default=1,
        help="seed of all random draws (default: 1); trials with the same seed draw the same numbers, so independent "
        "trials need different seeds",
    )
    parser.add_argument(
        "--notes",
        type=shared.free_text,
        metavar="TEXT",
        default="",
        help="notes stored with the trial: weather, place, people",
    )
    shared.add_out(parser, "the folders of trials")
    parser.add_argument("--dry-run", action="store_true", help="print the commands of each robot, change nothing")
    shared.add_json(parser)
    shared.add_all(parser)
    shared.add_operator(parser)
    shared.add_junit(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the trial at each distance and print the table of each."""
    from fieldkit.backends.protocols import simulators_of
    from fieldkit.cli import cli_options
    from fieldkit.trial.request import make_plan

    requests = [
        cli_options.request(arguments, parse_distance(text), seed=arguments.seed, notes=arguments.notes)
        for text in arguments.distances
    ]
    topology = requests[0].effective_topology
    with showing_events(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = cli_options.backend(arguments, sink)
        cast = backend.cast(topology)
        run_id = secrets.token_hex(8)
        plans = [
            make_plan(
                request,
                backend=name,
                cast=cast,
                now=datetime.now(UTC),
                session=run_id,
                lab_bytes=backend.lab_bytes,
                simulators=simulators_of(backend),
            )
            for request in requests
        ]
        for line in requests[0].procedure.adjustments(cast):
            sink(Note(line))
        if plans[0].procedure.expectations:
            from fieldkit.trial.check import shortfalls

            for line in shortfalls.undecidable_expectations(plans[0]):
                sink(Note(line))
        if arguments.dry_run:
            from fieldkit.cli import dry_run

            if arguments.json:
                dry_run.report_commands(plans[0], sink)
            else:
                dry_run.print_commands(plans[0])
            return 0
        if (code := cli_options.run_elsewhere(backend, arguments, arguments.out)) is not None:
            return code
        # These modules import pyarrow, which a dry run does not need.
        from fieldkit.cli import results
        from fieldkit.trial import estimates
        from fieldkit.trial.running import opening

        sink(Note(_announcement(plans)))
        for line in estimates.battery_notes(plans) if backend.by_hand else ():
            sink(Note(line))
        with cli_options.operator(arguments, sink) as operator:
            outcomes = opening.run(
                plans, backend, plans[0].cast, arguments.out, sink=sink, operator=operator, stop=stop
            )
    return results.report(outcomes, arguments)


def _announcement(plans: "list[Plan]") -> str:
    """Return the number of repeats and the expected duration, as text."""
    from fieldkit.trial import estimates

    protocols = " and ".join(protocol.upper() for protocol in plans[0].protocols)
    places = f" at each of {len(plans)} distances" if len(plans) > 1 else ""
    duration = estimates.total(estimates.estimate_trial(plan, []) for plan in plans)
    condition = "" if duration.is_certain else " if links fail"
    return f"{format_count(plans[0].repeats, 'repeat')} of {protocols}{places}, about {duration}{condition}"
