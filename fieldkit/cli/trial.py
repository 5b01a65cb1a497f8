"""`fieldkit trial PROCEDURE DISTANCE ...`: the main job."""

import argparse
import secrets
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from fieldkit.cli import outcomes, session, wishes
from fieldkit.cli.display import watching
from fieldkit.cli.dry_run import print_commands
from fieldkit.cli.interrupts import interruptible
from fieldkit.cli.listing import Commands
from fieldkit.core.events import Note, Sink
from fieldkit.core.units import format_count, format_duration, parse_distance
from fieldkit.trial import locks, preflight, store
from fieldkit.trial.locks import Holder
from fieldkit.trial.plan import Plan
from fieldkit.trial.request import make_plan
from fieldkit.trial.runner import Outcome, run_trial


def add(commands: Commands) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "trial",
        help="run a procedure at one or more distances",
        description="Run a procedure: per protocol, so many repeats of record, capture, transfer and ping.",
        epilog="example: fieldkit trial los 30ft --repeats 3 --record 2s",
    )
    parser.add_argument("procedure", metavar="PROCEDURE", help="name of a procedure, see `fieldkit procedures`")
    parser.add_argument("distances", metavar="DISTANCE", nargs="+", help="with a unit, for example 30ft or 9.1m")
    session.add_site(parser)
    wishes.add(parser)
    parser.add_argument(
        "--seed", type=wishes.natural, metavar="N", default=1, help="seed of everything random (default: 1)"
    )
    parser.add_argument("--notes", metavar="TEXT", default="", help="kept with the trial: weather, place, people")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", default=Path("trials"), help="where trial folders go (default: trials/)"
    )
    parser.add_argument("--dry-run", action="store_true", help="print every remote command per robot, touch nothing")
    session.add_json(parser)
    session.add_operator(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the trial at each distance and print the table of each."""
    requests = [
        wishes.request(arguments, parse_distance(text), seed=arguments.seed, notes=arguments.notes)
        for text in arguments.distances
    ]
    topology = requests[0].chosen_topology
    with watching(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = session.backend(arguments, sink)
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
            )
            for request in requests
        ]
        if arguments.dry_run:
            print_commands(plans[0])
            return 0
        store.prepare(arguments.out)
        sink(Note(_announce(plans)))
        with (
            session.operator(arguments, sink) as operator,
            backend.open(cast, seed=arguments.seed, sink=sink, operator=operator) as lab,
        ):
            preflight.meet(cast, lab.shells, sink)
            with locks.held(lab.shells, Holder(run_id, locks.me(), plans[0].trial), sink=sink):
                ended = _each(plans, lambda plan: run_trial(plan, lab, arguments.out, sink, stop), sink)
    return outcomes.report(ended, quiet=arguments.json)


def _announce(plans: list[Plan]) -> str:
    protocols = " and ".join(protocol.upper() for protocol in plans[0].protocols)
    places = f" at each of {len(plans)} distances" if len(plans) > 1 else ""
    duration = format_duration(sum(plan.expected_s() for plan in plans))
    return f"{format_count(plans[0].repeats, 'repeat')} of {protocols}{places}, about {duration}"


def _each(plans: list[Plan], run: Callable[[Plan], Outcome | None], sink: Sink) -> list[Outcome | None]:
    """Run every plan; where one stops, tell which are not begun: whoever resumes that one alone would miss them."""
    ended: list[Outcome | None] = []
    try:
        for plan in plans:
            ended.append(run(plan))  # noqa: PERF401 (what had ended is needed where one stops)
    except BaseException:
        if later := plans[len(ended) + 1 :]:
            sink(Note(f"not begun: {', '.join(str(plan.distance) for plan in later)}"))
        raise
    return ended
