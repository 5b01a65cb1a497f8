"""The command `fieldkit cosim sweep`, which runs all combinations of settings and seeds in parallel."""

import argparse
from collections.abc import Sequence
from typing import Final

from fieldkit.cli.display import show_note, showing_events
from fieldkit.core.errors import (
    ConfigurationError,
    EvidenceError,
    FieldkitError,
    LinkError,
    shell_command,
)
from fieldkit.core.executors import Workers
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.external import has_addresses, without_federates
from sim_backends.cosim.studies.seeds import workers_for
from sim_backends.cosim.sweeps.factors import parse_factors
from sim_backends.cosim.sweeps.sweep_dataset import write_dataset
from sim_backends.cosim.sweeps.sweep_folder import RunFailure, SweepFolder
from sim_backends.cosim.sweeps.sweep_plan import SweepPlan, SweepRun, plan_sweep
from sim_backends.cosim.sweeps.sweep_runner import run_sweep

INTERRUPTED: Final = 130
"""Exit code after Ctrl-C, as in shells: 128 plus the number of SIGINT."""

_ERROR_CLASSES: Final = {
    error.exit_code: error for error in (FieldkitError, ConfigurationError, LinkError, EvidenceError)
}
"""The class of the error of a failed run, by the exit code that the sweep's folder stores."""


def run(arguments: argparse.Namespace) -> int:
    """Run the sweep; write a file per run, and the dataset of all results.

    Raises:
        FieldkitError: A factor or a scenario is invalid, the folder cannot be written, or runs failed. If runs
            failed, the exit code is the exit code of the first failed run.
    """
    factors = parse_factors(arguments.over)
    scenario = settings.read_scenario(arguments)
    seeds = settings.read_seeds(arguments, scenario)
    plan = plan_sweep(arguments.scenario, factors, seeds, settings.read_changes(arguments))
    workers = _workers(plan, settings.read_workers(arguments))
    for setting in plan.settings:
        build(without_federates(setting.scenario))  # raises before any run if a scenario is invalid
    command = _command(arguments)
    folder = SweepFolder(arguments.out, command)
    with folder.opened(plan):
        try:
            with showing_events(as_json=arguments.json) as sink:
                outcome = run_sweep(plan, folder, workers, sink=sink, again=arguments.again)
        except KeyboardInterrupt:
            rows = write_dataset(plan, folder)
            next_step = f"; {_next_step(folder)}" if rows else ""
            show_note(f"interrupted; all finished runs are saved{next_step}; to continue: {command}")
            return INTERRUPTED
        rows = write_dataset(plan, folder)
    if rows and not arguments.json:
        show_note(_next_step(folder))
    if outcome.failures:
        raise _error(outcome.failures, outcome.total, command)
    return 0


def _next_step(folder: SweepFolder) -> str:
    return f"results: {shell_command('fieldkit', 'aggregate', folder.path)}"


def _workers(plan: SweepPlan, workers: Workers) -> Workers:
    """Return the workers that can run a plan.

    Raises:
        ConfigurationError: The scenario publishes events of EMANE; or it needs a federate with an address, and the
            workers are a cluster.
    """
    scenarios = [setting.scenario for setting in plan.settings]
    if any(scenario.emane is not None for scenario in scenarios):
        raise ConfigurationError("only one run can publish events of EMANE", remedy="use fieldkit cosim run")
    if not any(map(has_addresses, scenarios)):
        return workers_for(sum(scenario.packets for scenario in scenarios) * len(plan.seeds), workers)
    if workers.cluster:
        raise ConfigurationError(
            "a federate with an address serves one run at a time", remedy="give its command instead of its address"
        )
    return Workers(1)


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that continues the sweep."""
    words = ["fieldkit", "cosim", "sweep", arguments.scenario]
    words += ["--over", *arguments.over] if arguments.over else []
    options = {
        name: getattr(arguments, name.replace("-", "_"))
        for name in ("duration", "seed", "seeds", "physics", "network", "jobs", "cluster")
    }
    words += [
        word for name, value in options.items() if value not in {None, ""} for word in (f"--{name}", str(value))
    ]
    words += [word for change in arguments.set for word in ("--set", change)]
    return shell_command(*words, "-o", arguments.out)


def _error(failures: Sequence[tuple[SweepRun, RunFailure]], total: int, command: str) -> FieldkitError:
    """Return the error for failed runs, with the exit code of the first one."""
    run, failure = failures[0]
    error_class = _ERROR_CLASSES.get(failure.exit_code, FieldkitError)
    return error_class(
        f"{len(failures)} of {total} runs failed; the first, after {format_count(failure.attempts, 'attempt')}: "
        f"{failure.reason}",
        where=str(run),
        remedy=f"{f'{failure.remedy}; ' if failure.remedy else ''}to try them again: {command} --again",
    )
