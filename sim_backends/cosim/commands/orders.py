"""`fieldkit cosim shootout SCENARIO --orders`: local errors against the window, and the order of each sync policy."""

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Final

from fieldkit.cli.display import show_note, working
from fieldkit.core.events import Sink
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.base import PolicyError, SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.policies import POLICIES, make_policy
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.local_errors import MEASURES, TAIL_NS, LocalErrors, local_errors, pooled, spread_over
from sim_backends.cosim.studies.seeds import Task, run_many

WINDOWS_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
BEGINS: Final = 20
"""Windows that are begun in the reference of each seed."""
_COLUMNS: Final = (
    SheetColumn("policy", "policy", ""),
    SheetColumn("window_s", "w (ms)", "window as it was, mean", 1e3),
    SheetColumn("delivery_s", "time (ms)", "delivery time less the reference's, magnitude, mean", 1e3),
    SheetColumn("late_s", "late (ms)", "by how much receivers had passed an arrival, mean", 1e3),
    SheetColumn("position_m", "place (mm)", "how wrong the network was about two agents, mean", 1e3),
    SheetColumn("fates", "fate (%)", "packets with another fate", 100),
    SheetColumn("path_m", "path (mm)", "how far off agents are at the window's end, mean", 1e3),
)
_HEADS: Final[Mapping[str, str]] = MappingProxyType(
    {column.name: column.head.partition(" (")[0] for column in _COLUMNS if column.name in MEASURES}
)


def run(arguments: argparse.Namespace) -> int:
    """Measure local errors, print them with their orders, and draw them."""
    scenario = settings.scenario(arguments)
    seeds = settings.seeds(arguments, scenario)
    windows_s = settings.windows_s(arguments, scenario) if arguments.windows else list(WINDOWS_S)
    policies = [name for name in settings.policies(arguments) if not getattr(POLICIES[name], "exact", False)]
    draw = None if arguments.figure is None else settings.figure(arguments.figure, "--figure")
    build(scenario)  # what cannot be run is told before anything runs
    with working() as sink:
        found, failures = _measured(scenario, policies, seeds, windows_s, sink)
    title = f"{scenario.name}, {scenario.topology}, {format_count(len(seeds), 'seed')}"
    _errors(title, found).show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        _orders(found).show(arguments.format)
    for name, failure in failures.items():
        show_note(f"{name}: {failure}")
    if draw is not None:
        from sim_backends.cosim.commands import figures  # noqa: PLC0415 (matplotlib takes half a second)

        draw(figures.error_against_window(found))
    return 0


def _measured(
    scenario: CosimScenario, policies: Sequence[str], seeds: Sequence[int], windows_s: Sequence[float], sink: Sink
) -> tuple[dict[str, LocalErrors], dict[str, PolicyError]]:
    """Return the local errors of each policy over all seeds, and why others have none."""
    tasks = [Task(name, seed) for name in policies for seed in seeds]
    tell = partial(teller(sink), "local errors", len(tasks))
    tell(0)
    results = run_many(partial(_local, scenario, windows_s), tasks, progress=tell)
    several: dict[str, list[LocalErrors]] = {}
    failures: dict[str, PolicyError] = {}
    for task, result in zip(tasks, results, strict=True):
        if isinstance(result, PolicyError):
            failures.setdefault(task.policy, result)
        else:
            several.setdefault(task.policy, []).append(result)
    return {name: pooled(ones) for name, ones in several.items() if name not in failures}, failures


def _local(scenario: CosimScenario, windows_s: Sequence[float], task: Task) -> LocalErrors | PolicyError:
    def make(policy: SyncPolicy) -> Coordinator:
        return build(scenario, policy=policy, seed=task.seed, measures_all=True).coordinator

    def method(window_s: float) -> SyncPolicy:
        # Windows of error_bounded are as long as others', but where its bound would not be kept.
        longest_s = window_s if task.policy == ErrorBounded.name else max(window_s, scenario.policy.longest)
        return make_policy(task.policy, **scenario.policy.parameters | {"window_s": window_s, "longest_s": longest_s})

    until_ns = scenario.duration_ns - TAIL_NS - round(max(windows_s) * 1e9)
    begins_ns = spread_over(0, max(until_ns, scenario.physics.step_ns), BEGINS, scenario.physics.step_ns)
    try:
        return local_errors(make, {task.policy: method}, windows_s, begins_ns)[task.policy]
    except PolicyError as error:
        return error


def _errors(title: str, found: Mapping[str, LocalErrors]) -> Sheet:
    rows: list[Sequence[Value]] = []
    for name, errors in found.items():
        means = [errors.mean(measure) for measure in MEASURES]
        for number, window_s in enumerate(errors.window_s.mean(axis=1)):
            rows.append((name, float(window_s), *(float(values[number]) for values in means)))
    part = SheetPart(f"{title}: errors of single windows", [column.name for column in _COLUMNS])
    return Sheet(_COLUMNS, rows, [part])


def _orders(found: Mapping[str, LocalErrors]) -> Sheet:
    columns = [SheetColumn("policy", "policy", "")]
    columns += [SheetColumn(measure, _HEADS[measure], "") for measure in MEASURES]
    rows = [(name, *(in_words(errors, measure) for measure in MEASURES)) for name, errors in found.items()]
    part = SheetPart(
        "order: the power of the window by which an error shrinks, with its 95 % interval", ("policy", *MEASURES)
    )
    return Sheet(columns, rows, [part])


def in_words(errors: LocalErrors, measure: str) -> str:
    """Return the order of an error with its interval: `1.00 [0.98, 1.03]`; empty where no error was seen."""
    order = errors.order(measure)
    if math.isnan(order.value):
        return ""
    interval = "" if math.isnan(order.low) else f" [{order.low:.2f}, {order.high:.2f}]"
    return f"{order.value:.2f}{interval}"
