"""Runs a sweep: submits the missing runs, writes each result when it arrives, and repeats runs that crashed."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from fieldkit.core.columns import Value
from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError, describe_exception
from fieldkit.core.events import Note, Progress, Sink
from fieldkit.core.executors import Workers
from fieldkit.core.sweep_events import SweepEnded, SweepPlanned, SweepRunEnded
from fieldkit.core.tasks import TaskEnd, WorkerDiedError, completed
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.execution import simulate
from sim_backends.cosim.commands.flow_rows import flow_rows
from sim_backends.cosim.commands.results import FlowResult, SeedResult
from sim_backends.cosim.federates import FederateError
from sim_backends.cosim.sweeps.factors import DISTANCE
from sim_backends.cosim.sweeps.sweep_folder import RunFailure, SweepFolder
from sim_backends.cosim.sweeps.sweep_plan import SweepPlan, SweepRun, digest

ATTEMPTS: Final = 3
"""Largest number of attempts at a run."""

_TRANSIENT: Final = (LinkError, FederateError, WorkerDiedError, OSError, MemoryError)
"""Errors after which a run is tried again: a worker or simulator terminated or did not answer, or a resource was
exhausted. Other errors would occur again, because a run depends only on its settings and seed."""

_NOT_LISTED: Final = frozenset({"policy", DISTANCE, "line", "topology"})
"""Factors that `_settings_text` does not list by name: its text starts with the policy, and other columns contain the
distance, the line and the topology."""


@dataclass(frozen=True)
class RunResult:
    """The result of a run, as a worker returns it.

    Attributes:
        content: The content of the file with the result.
        error: The error that ended the run early; None if the run is complete.
    """

    content: Mapping[str, Any]
    error: FieldkitError | None


@dataclass(frozen=True)
class SweepOutcome:
    """The state of a sweep after it was run.

    Attributes:
        total: Number of runs.
        finished: Number of finished runs.
        failures: Runs without a result that have no attempt left, with their last failure, in the order of the plan.
    """

    total: int
    finished: int
    failures: Sequence[tuple[SweepRun, RunFailure]]


def execute(run: SweepRun, *, verify: bool = False) -> RunResult:
    """Return the result of a run.

    Args:
        run: The run.
        verify: True to check that world and robot profiles are the same as in the process that planned the run.

    Raises:
        ConfigurationError: The world or a robot profile differs.
        FieldkitError: The run could not start.
        KeyboardInterrupt: Ctrl-C interrupted the run.
    """
    scenario = run.setting.scenario
    if verify and digest(scenario) != run.setting.digest:
        raise ConfigurationError(
            "the world or a robot profile of the scenario differs on a worker",
            remedy="start the workers in a copy of this folder, with the same worlds/ and robots/",
        )
    result = simulate(scenario, scenario.policy.name, run.seed, None)
    if result.is_interrupted:
        raise KeyboardInterrupt
    rows = flow_rows(f"{scenario.name}-{run.setting.digest[:8]}", scenario, _settings_text(run), run.seed, result)
    content = {
        "simulated_s": result.simulated_s,
        "event_hash": result.digest,
        "wall_s": dict(result.wall_s),
        "rows": [row | _sweep_columns(run, flow, result) for row, flow in zip(rows, result.flows, strict=True)],
    }
    return RunResult(content, result.error)


def _settings_text(run: SweepRun) -> str:
    """Return the settings as text for the name of the procedure, so that all conditions have different names."""
    scenario = run.setting.scenario
    text = settings.policy_text(scenario.policy.name, scenario)
    omitted = _NOT_LISTED | ({"window"} if settings.has_window(scenario.policy.name) else set())
    return ", ".join(
        [text, *(f"{name} {value}" for name, value in run.setting.values.items() if name not in omitted)]
    )


def _sweep_columns(run: SweepRun, flow: FlowResult, result: SeedResult) -> dict[str, Value]:
    """Return the columns that only sweeps have; a distance is written as on the command line."""
    columns: dict[str, Value] = {"flow": flow.name}
    if DISTANCE in run.setting.values:
        columns["distance"] = run.setting.values[DISTANCE]
    if flow.arrived_packets:
        columns["added_delay_mean_s"] = flow.added_s
    if result.simulated_s:
        columns["exchanges_per_s"] = result.windows / result.simulated_s
    return columns


def run_sweep(
    plan: SweepPlan, folder: SweepFolder, workers: Workers, *, sink: Sink, again: bool = False
) -> SweepOutcome:
    """Execute all runs that have no result, and return the state of the sweep afterwards.

    Args:
        plan: The plan.
        folder: Its opened folder.
        workers: The workers that execute the runs.
        sink: Receives events.
        again: True to also repeat failed runs that have no attempt left.

    Raises:
        ConfigurationError: A result cannot be written (the message contains the command that continues), or a worker
            has another version or other files.
        LinkError: The scheduler of the cluster does not answer.
    """
    finished = folder.finished_runs()
    missing_runs = [run for run in plan.runs if run.name not in finished]
    previous_failures = {} if again else {run.name: folder.failure(run) for run in missing_runs}
    attempts = {
        run.name: 0 if (failure := previous_failures.get(run.name)) is None else failure.attempts
        for run in missing_runs
    }
    final_failures = {name for name, failure in previous_failures.items() if failure is not None and failure.is_final}
    finished_count = len(plan.runs) - len(missing_runs)
    sink(SweepPlanned(str(folder.path), finished_count, len(plan.runs), len(plan.settings), len(plan.seeds)))
    report = _Reporter(sink, finished_count, len(plan.runs))
    work = partial(execute, verify=bool(workers.cluster))
    while tasks := [
        run
        for run in missing_runs
        if attempts[run.name] < ATTEMPTS and run.name not in finished and run.name not in final_failures
    ]:
        for end in completed(work, tasks, workers, lambda text: sink(Note(text))):
            run = tasks[end.number]
            # All scenarios were checked before, so this error means that the worker is set up wrongly.
            if isinstance(end.error, ConfigurationError):
                raise end.error
            attempts[run.name] += 1
            failure = _failure(end, attempts[run.name])
            if failure is None and end.result is not None:
                folder.write_result(run, end.result.content)
                finished.add(run.name)
            elif failure is not None:
                folder.write_failure(run, failure)
                if failure.is_final:
                    final_failures.add(run.name)
            report.report_end(run, attempts[run.name], failure)
    failures = [
        (run, failure) for run in missing_runs if run.name not in finished and (failure := folder.failure(run))
    ]
    sink(
        SweepEnded(str(folder.path), len(finished & attempts.keys()) + finished_count, len(failures), len(plan.runs))
    )
    return SweepOutcome(len(plan.runs), len(plan.runs) - len(failures), failures)


def _failure(end: TaskEnd[RunResult], attempts: int) -> RunFailure | None:
    """Return the failure of a run; None if it is complete."""
    error: Exception | None = end.error if end.result is None else end.result.error
    if error is None:
        return None
    rows = () if end.result is None else end.result.content["rows"]
    is_final = not isinstance(error, _TRANSIENT)
    if isinstance(error, FieldkitError):
        return RunFailure(attempts, error.located, error.remedy, error.exit_code, rows, is_final)
    return RunFailure(attempts, describe_exception(error), "", FieldkitError.exit_code, rows, is_final)


class _Reporter:
    """Reports the end of each run and the remaining time."""

    def __init__(self, sink: Sink, finished_count: int, total: int) -> None:
        self._sink = sink
        self._finished_count = self._initial_count = finished_count
        self._total = total
        self._start_s = time.monotonic()
        sink(Progress("sweep", finished_count, total, "runs"))

    def report_end(self, run: SweepRun, attempt: int, failure: RunFailure | None) -> None:
        self._finished_count += failure is None
        spent_s, new_count = time.monotonic() - self._start_s, self._finished_count - self._initial_count
        remaining_s = spent_s / new_count * (self._total - self._finished_count) if new_count else None
        self._sink(
            SweepRunEnded(
                str(run.setting),
                run.seed,
                run.name,
                "" if failure is None else failure.reason,
                "" if failure is None else failure.remedy,
                attempt,
                self._finished_count,
                self._total,
            )
        )
        self._sink(Progress("sweep", self._finished_count, self._total, "runs", remaining_s))
