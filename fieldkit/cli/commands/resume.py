"""`fieldkit resume TRIAL`: continue a trial that stopped."""

import argparse

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import showing_events
from fieldkit.cli.interrupts import interruptible
from fieldkit.cli.parser import Parser


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit resume`."""
    parser.description = (
        "Continue a trial that was stopped by Ctrl-C or a signal, or because a robot or the emulator was lost or the "
        "disk was full. Finished repeats are not repeated. Files that differ from their checksums are reported; if "
        "rows of trial.csv must be rebuilt from them, the trial does not continue (exit code 4). The version of "
        "fieldkit, the backend and the robots in their roles must be the same as at the start of the trial."
    )
    shared.add_trial(parser, "folder of the trial")
    parser.add_argument(
        "--failed", action="store_true", help="also repeat the failed repeats; their failed attempts become void"
    )
    shared.add_site(parser)
    shared.add_operator(parser)
    shared.add_json(parser)
    shared.add_all(parser)
    shared.add_junit(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the remaining repeats of the trial and print its table."""
    from fieldkit.cli import cli_options, hints, results
    from fieldkit.trial.running import resumption

    plan = resumption.resumable(arguments.trial)  # raise its errors before errors of site files and backends
    hints.repeat_options(plan.overrides())
    with showing_events(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = cli_options.backend(arguments, sink)
        folder = arguments.trial.resolve().parent
        if (code := cli_options.run_elsewhere(backend, arguments, folder)) is not None:
            return code
        with cli_options.operator(arguments, sink) as operator:
            outcome = resumption.resume(
                arguments.trial,
                name,
                backend,
                failed=arguments.failed,
                sink=sink,
                operator=operator,
                stop=stop,
            )
    return results.report([outcome], arguments)
