"""`fieldkit resume TRIAL`: go on with a trial that stopped."""

import argparse

from fieldkit.cli import options, results
from fieldkit.cli.display import watching
from fieldkit.cli.interrupts import interruptible
from fieldkit.core.errors import ConfigurationError
from fieldkit.trial import locks, preflight
from fieldkit.trial.locks import Holder
from fieldkit.trial.resumption import demand_cast, resumable
from fieldkit.trial.runner import resume_trial


def run(arguments: argparse.Namespace) -> int:
    """Run what is left of the trial and print its table."""
    plan = resumable(arguments.trial)
    with watching(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = options.backend(arguments, sink)
        if name != plan.backend:
            raise ConfigurationError(
                f"it was begun on backend {plan.backend}, not {name}",
                where=str(arguments.trial),
                remedy=f"fieldkit resume {arguments.trial} --backend {plan.backend}",
            )
        cast = backend.cast(plan.topology)
        demand_cast(plan, cast)
        with (
            options.operator(arguments, sink) as operator,
            backend.open(cast, seed=plan.seed, sink=sink, operator=operator) as lab,
        ):
            preflight.meet(cast, lab.shells, sink)
            with locks.held(lab.shells, Holder(plan.session, locks.me(), plan.trial), sink=sink):
                outcome = resume_trial(arguments.trial, lab, sink, stop)
    return results.report([outcome], quiet=arguments.json)
