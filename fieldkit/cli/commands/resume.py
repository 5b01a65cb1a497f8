"""`fieldkit resume TRIAL`: go on with a trial that stopped."""

import argparse

from fieldkit.cli import options, results
from fieldkit.cli.display import watching
from fieldkit.cli.terminal import interruptible
from fieldkit.trial.running import opening
from fieldkit.trial.running.resumption import resumable


def run(arguments: argparse.Namespace) -> int:
    """Run what is left of the trial and print its table."""
    resumable(arguments.trial)  # before anything is said of site files and backends
    with watching(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = options.backend(arguments, sink)
        with options.operator(arguments, sink) as operator:
            outcome = opening.resume(arguments.trial, name, backend, sink=sink, operator=operator, stop=stop)
    return results.report([outcome], arguments)
