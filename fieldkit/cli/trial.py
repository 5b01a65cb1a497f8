"""`fieldkit trial PROCEDURE DISTANCE ...`: the main job."""

import argparse
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from fieldkit import profiles
from fieldkit.backends import Backend, backend_names, load_backend
from fieldkit.cli.display import ask_operator, show_error, summary_table, watching
from fieldkit.cli.dry_run import print_commands
from fieldkit.cli.listing import Commands
from fieldkit.errors import ConfigurationError, EvidenceError
from fieldkit.events import Note, Sink
from fieldkit.model import Protocol, Topology
from fieldkit.procedures import load_procedure
from fieldkit.trial import store
from fieldkit.trial.plan import Plan, Request, make_plan
from fieldkit.trial.runner import Outcome, run_trial
from fieldkit.units import format_duration, parse_distance, parse_duration_s

_DEFAULT_BACKEND: Final = "emulated"
_PROTOCOL_HELP: Final = "may be given more than once (default: the procedure's)"


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
    parser.add_argument(
        "--backend", help=f"one of: {', '.join(backend_names())} (default: the site file's; without one, emulated)"
    )
    parser.add_argument(
        "--site", type=Path, help=f"site file of the lab (default: {profiles.SITE_FILE}, if there is one)"
    )
    parser.add_argument("--topology", choices=[str(one) for one in Topology], help="default: the procedure's")
    parser.add_argument("--protocol", action="append", choices=[str(one) for one in Protocol], help=_PROTOCOL_HELP)
    parser.add_argument("--repeats", type=_positive, metavar="N", help="per protocol (default: the procedure's)")
    parser.add_argument("--record", metavar="DURATION", help="length of every recording, for example 2s")
    parser.add_argument("--seed", type=_natural, default=1, help="seed of everything random (default: 1)")
    parser.add_argument("--notes", default="", help="kept with the trial: weather, place, people")
    parser.add_argument("--out", type=Path, default=Path("trials"), help="where trial folders go (default: trials/)")
    parser.add_argument("--dry-run", action="store_true", help="print every remote command per robot, touch nothing")
    parser.add_argument("--json", action="store_true", help="one event a line instead of the display")
    parser.add_argument("--yes", action="store_true", help="do not ask: the robots stand where they should")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the trial at each distance and print the table of each."""
    requests = _requests(arguments)
    topology = requests[0].chosen_topology
    with watching(as_json=arguments.json) as sink:
        name, backend = _backend(arguments, sink)
        cast = backend.cast(topology)
        plans = [make_plan(request, backend=name, cast=cast, now=datetime.now(UTC)) for request in requests]
        if arguments.dry_run:
            print_commands(plans[0])
            return 0
        store.prepare(arguments.out)
        sink(Note(_announce(plans)))
        ask = _say_nothing if arguments.yes else ask_operator
        outcomes = []
        with backend.open(cast, seed=arguments.seed, sink=sink, ask=ask) as lab:
            outcomes = [run_trial(plan, lab, arguments.out, sink) for plan in plans]
    return _report(outcomes, quiet=arguments.json)


def _report(outcomes: list[Outcome], *, quiet: bool) -> int:
    for outcome in outcomes:
        if not quiet:
            summary_table(outcome.cells)
        if outcome.failed:
            show_error(f"{outcome.failed} repeat(s) failed; reasons in {outcome.folder / 'trial.csv'}")
    return EvidenceError.exit_code if any(outcome.failed for outcome in outcomes) else 0


def _requests(arguments: argparse.Namespace) -> list[Request]:
    procedure = load_procedure(arguments.procedure)
    record_s = None if arguments.record is None else parse_duration_s(arguments.record)
    if record_s == 0:
        raise ConfigurationError("a recording of 0 s records nothing", remedy="write for example --record 2s")
    return [
        Request(
            procedure=procedure,
            distance=parse_distance(text),
            topology=None if arguments.topology is None else Topology(arguments.topology),
            protocols=tuple(dict.fromkeys(Protocol(one) for one in arguments.protocol or ())),
            repeats=arguments.repeats,
            record_s=record_s,
            seed=arguments.seed,
            notes=arguments.notes,
        )
        for text in arguments.distances
    ]


def _backend(arguments: argparse.Namespace, sink: Sink) -> tuple[str, Backend]:
    path: Path | None = arguments.site
    if path is None and Path(profiles.SITE_FILE).is_file():
        path = Path(profiles.SITE_FILE)
    if path is None:
        name = arguments.backend or _DEFAULT_BACKEND
        if arguments.backend is None:
            sink(Note(f"no site file {profiles.SITE_FILE} here: using emulated robots"))
        return name, load_backend(name, None, None)
    site, document = profiles.load_site(path)
    name = arguments.backend or site.backend
    return name, load_backend(name, site, document)


def _announce(plans: list[Plan]) -> str:
    protocols = " and ".join(protocol.upper() for protocol in plans[0].protocols)
    count = sum(plan.repeats for plan in plans)
    duration = format_duration(sum(plan.expected_s() for plan in plans))
    return f"{count} {'repeat' if count == 1 else 'repeats'} of {protocols}, about {duration}"


def _natural(text: str) -> int:
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 0")
    return int(text)


def _positive(text: str) -> int:
    if _natural(text) < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return int(text)


def _say_nothing(question: str) -> None:
    """Stand in for the operator who said --yes."""
    del question
