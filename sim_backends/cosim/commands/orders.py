"""The command `fieldkit cosim shootout --orders`, which computes local errors and the order of each sync policy.

A local error is the error of a single window that begins in the state of the exact reference. If the order of a
policy is n, this error is proportional to the n-th power of the window.
"""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Final

from fieldkit.cli.display import show_note, showing_progress
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Sink
from fieldkit.core.executors import Workers
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.result_texts import order_text
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies import registry
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.policies.sync_policy import PolicyError, SyncPolicy
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.external import without_federates
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.local_errors import (
    MEASURES,
    TAIL_NS,
    LocalErrors,
    local_errors,
    low_discrepancy_times_ns,
    pool,
)
from sim_backends.cosim.studies.seeds import Task, run_many

WINDOWS_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
"""Windows for which local errors are computed unless the option `--window` is given."""
START_TIMES: Final = 20
"""Number of start times for the windows of each policy, in the exact reference of each seed."""
_COLUMNS: Final = (
    SheetColumn("policy", "policy", ""),
    SheetColumn("window_s", "w (ms)", "mean of the actual windows", 1e3),
    SheetColumn(
        "delivery_s",
        "time (ms)",
        "mean absolute difference from the delivery time in the reference",
        1e3,
    ),
    SheetColumn("late_s", "late (ms)", "mean time by which an arrival was in the receiver's past", 1e3),
    SheetColumn(
        "position_m", "position (mm)", "mean error of the relative position of two agents in the network", 1e3
    ),
    SheetColumn("fates", "fate (%)", "packets lost here or in the reference, but not in both", 100),
    SheetColumn("path_m", "path (mm)", "mean position error of agents at the end of a window", 1e3),
)
_HEADS: Final[Mapping[str, str]] = MappingProxyType(
    {column.name: column.head.partition(" (")[0] for column in _COLUMNS if column.name in MEASURES}
)
"""Heading of each measure without its unit, because an order has no unit."""


def run(arguments: argparse.Namespace) -> int:
    """Measure local errors, print them with their orders, and draw them on request."""
    scenario = settings.read_scenario(arguments)
    seeds = settings.read_seeds(arguments, scenario)
    windows_s = settings.read_windows_s(arguments, scenario) if arguments.windows else list(WINDOWS_S)
    policies = [
        name for name in settings.read_policies(arguments) if not getattr(registry.policies()[name], "exact", False)
    ]
    if not policies:
        raise ConfigurationError(
            "--orders: exact policies have no errors in a window", remedy="choose other policies with --policy"
        )
    if arguments.figure is not None and len(windows_s) < 2:
        raise ConfigurationError(
            "--figure: errors against the window need two windows", remedy="write for example --window 1ms,10ms"
        )
    draw = None if arguments.figure is None else settings.open_figure(arguments.figure, "--figure")
    build(without_federates(scenario))  # raises before any run if the scenario is invalid
    with showing_progress() as sink:
        runs = len(policies) * len(seeds) * len(windows_s)
        workers = settings.read_workers(arguments, scenario.packets * runs)
        by_policy, failures = _measure(scenario, policies, seeds, windows_s, workers=workers, sink=sink)
    title = f"{scenario.name}, {scenario.topology}, {format_count(len(seeds), 'seed')}"
    _error_sheet(title, by_policy).show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        _order_sheet(by_policy).show(arguments.format)
    for name, failure in failures.items():
        show_note(f"{name}: {failure}")
    if draw is not None:
        from sim_backends.cosim.commands import plot  # noqa: PLC0415 (importing matplotlib takes half a second)

        figure = plot.error_against_window(by_policy)
        if figure is None:
            show_note("not drawn, because no policy has errors above 0 with two windows")
        else:
            draw(figure)
    return 0


def _measure(
    scenario: CosimScenario,
    policies: Sequence[str],
    seeds: Sequence[int],
    windows_s: Sequence[float],
    *,
    workers: Workers,
    sink: Sink,
) -> tuple[dict[str, LocalErrors], dict[str, PolicyError]]:
    """Return the local errors of each policy over all seeds, and the errors of policies that failed with a seed."""
    tasks = [Task(name, seed) for name in policies for seed in seeds]
    report = partial(progress_reporter(sink), "local errors", len(tasks))
    report(0)
    results = run_many(partial(_local_errors, scenario, windows_s), tasks, workers=workers, progress=report)
    errors_by_policy: dict[str, list[LocalErrors]] = {}
    failures: dict[str, PolicyError] = {}
    for task, result in zip(tasks, results, strict=True):
        if isinstance(result, PolicyError):
            failures.setdefault(task.policy, result)
        else:
            errors_by_policy.setdefault(task.policy, []).append(result)
    return {name: pool(errors) for name, errors in errors_by_policy.items() if name not in failures}, failures


def _local_errors(scenario: CosimScenario, windows_s: Sequence[float], task: Task) -> LocalErrors | PolicyError:
    """Return the local errors of a policy with one seed, or the error with which the policy failed."""

    def make_coordinator(policy: SyncPolicy) -> Coordinator:
        return build(scenario, policy=policy, seed=task.seed, measures_all=True).coordinator

    def policy_for(window_s: float) -> SyncPolicy:
        # error_bounded has the same windows as the other policies unless its bound requires shorter windows.
        longest_s = window_s if task.policy == ErrorBounded.name else max(window_s, scenario.policy.longest)
        return make_policy(task.policy, **scenario.policy.parameters | {"window_s": window_s, "longest_s": longest_s})

    until_ns = scenario.duration_ns - TAIL_NS - round(max(windows_s) * 1e9)
    step_ns = scenario.physics.step_ns
    starts_ns = low_discrepancy_times_ns(0, max(until_ns, step_ns), START_TIMES, step_ns)
    try:
        return local_errors(make_coordinator, {task.policy: policy_for}, windows_s, starts_ns)[task.policy]
    except PolicyError as error:
        return error


def _error_sheet(title: str, by_policy: Mapping[str, LocalErrors]) -> Sheet:
    rows: list[Sequence[Value]] = []
    for name, errors in by_policy.items():
        means = [errors.mean(measure) for measure in MEASURES]
        for number, window_s in enumerate(errors.window_s.mean(axis=1)):
            rows.append((name, float(window_s), *(float(values[number]) for values in means)))
    part = SheetPart(f"{title}: errors of single windows", [column.name for column in _COLUMNS])
    return Sheet(_COLUMNS, rows, [part])


def _order_sheet(by_policy: Mapping[str, LocalErrors]) -> Sheet:
    columns = [SheetColumn("policy", "policy", "")]
    columns += [SheetColumn(measure, _HEADS[measure], "") for measure in MEASURES]
    rows = [(name, *(order_text(errors, measure) for measure in MEASURES)) for name, errors in by_policy.items()]
    part = SheetPart(
        "order: the exponent n if the error is proportional to window^n, with its 95 % interval",
        ("policy", *MEASURES),
    )
    return Sheet(columns, rows, [part])
