"""`fieldkit cosim shootout SCENARIO --bound`: what a bound costs, by `error_bounded` and by fixed windows."""

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Final

from fieldkit.cli.display import working
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.printing import say
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, filled, number
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.bounds import BoundCost, FixedCost, bound_cost, fixed_cost, kept_by_all
from sim_backends.cosim.studies.seeds import Task, run_many

_COLUMNS: Final = (
    SheetColumn("seed", "seed", ""),
    SheetColumn("largest_m", "largest (mm)", "error of position by error_bounded", 1e3),
    SheetColumn("exchanges", "exchanges", "of error_bounded"),
    SheetColumn("added_s", "added (ms)", "what error_bounded adds to a delay, mean", 1e3),
    SheetColumn("all_window_s", "all (ms)", "longest fixed window that, by a search, keeps it in all runs", 1e3),
    SheetColumn("all_exchanges", "its exchanges", ""),
    SheetColumn("all_factor", "factor", "by which error_bounded needs fewer exchanges"),
    SheetColumn("found_window_s", "own (ms)", "longest that keeps it in this run, as is known afterwards", 1e3),
    SheetColumn("found_exchanges", "its exchanges", ""),
    SheetColumn("found_factor", "factor", ""),
)


def run(arguments: argparse.Namespace) -> int:
    """Search for the fixed window that keeps the bound, with each seed, and print what both cost.

    Raises:
        ConfigurationError: An option of other shootouts is given.
    """
    if arguments.figure is not None or arguments.policy or arguments.windows:
        raise ConfigurationError(
            "--bound is about error_bounded and its bound, and has no figure",
            remedy="leave out --figure, --policy and --window; change the bound by --set policy.bound=1cm",
        )
    scenario = settings.scenario(arguments)
    if scenario.policy.bound_db is not None:
        raise ConfigurationError(
            "--bound compares errors of places, and policy.bound_db is about path loss",
            remedy="leave out policy.bound_db; change the bound by --set policy.bound=1cm",
        )
    seeds = settings.seeds(arguments, scenario)
    build(scenario)  # what cannot be run is told before anything runs
    tasks = [Task(ErrorBounded.name, seed) for seed in seeds]
    with working() as sink:
        told = partial(teller(sink, "seeds"), "bound", len(seeds))
        told(0)
        costs = run_many(partial(_cost, scenario), tasks, progress=told)
        window_s, fixed = kept_by_all(
            [cost.window_s for cost in costs],
            lambda tried_s: run_many(partial(_fixed, scenario, tried_s), tasks),
            scenario.policy.bound,
        )
    _sheet(scenario, seeds, costs, window_s, fixed).show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        say(_words(scenario, costs, window_s, fixed))
    return 0


def _run_by(scenario: CosimScenario, task: Task, policy: SyncPolicy) -> Run:
    return build(scenario, policy=policy, seed=task.seed, measures_all=True).run()


def _cost(scenario: CosimScenario, task: Task) -> BoundCost:
    chosen = scenario.policy
    run = partial(_run_by, scenario, task)
    return bound_cost(run, chosen.bound, step_s=scenario.physics.step, longest_s=chosen.longest)


def _fixed(scenario: CosimScenario, window_s: float, task: Task) -> FixedCost:
    return fixed_cost(partial(_run_by, scenario, task), window_s)


def _sheet(
    scenario: CosimScenario,
    seeds: Sequence[int],
    costs: Sequence[BoundCost],
    window_s: float,
    fixed: Sequence[FixedCost],
) -> Sheet:
    rows = [
        (
            seed,
            cost.largest_m,
            cost.exchanges,
            cost.added_s,
            window_s,
            fixed[place].exchanges if fixed else None,
            fixed[place].exchanges / cost.exchanges if fixed else None,
            cost.window_s,
            cost.fixed_exchanges or None,
            cost.factor,
        )
        for place, (seed, cost) in enumerate(zip(seeds, costs, strict=True))
    ]
    title = f"{scenario.name}, {scenario.topology}: a bound of {number(scenario.policy.bound * 1e3)} mm"
    names = [column.name for column in _COLUMNS]
    return Sheet(
        _COLUMNS,
        rows,
        [SheetPart(title, names[:7]), SheetPart("the window that would have done", [names[0], *names[7:]])],
    )


def _words(scenario: CosimScenario, costs: Sequence[BoundCost], window_s: float, fixed: Sequence[FixedCost]) -> str:
    mine = sum(cost.exchanges for cost in costs)
    late_s = [cost.added_s for cost in costs if not math.isnan(cost.added_s)]
    words = f"error_bounded keeps {number(scenario.policy.bound * 1e3)} mm in {format_count(mine, 'exchange')}"
    if late_s:
        words += (
            f", and adds {number(math.fsum(late_s) / len(late_s) * 1e3)} ms to a delay, as an arrival waits for its "
            f"window's end: half of policy.longest is {number(scenario.policy.longest * 500)} ms"
        )
    if not fixed:
        return f"{words}, and no fixed window does"
    theirs, own = sum(one.exchanges for one in fixed), sum(cost.fixed_exchanges for cost in costs)
    words += (
        f"; the fixed window that keeps it in {format_count(len(costs), 'run')}, {number(window_s * 1e3)} ms, needs "
        f"{theirs:,}, {number(theirs / mine)} times as many"
    )
    if len(costs) > 1:
        words += f"; the longest that would have done in each {own:,}, {number(own / mine)} times as many"
    if window_s == scenario.policy.longest:
        words += "; no window is longer than policy.longest, which the fixed one is"
    return filled(words)
