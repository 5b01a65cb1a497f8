"""The command `fieldkit cosim shootout --bound`, which compares the policy `error_bounded` with fixed windows.

It compares the numbers of exchanges that are needed to keep a bound on position errors.
"""

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Final

from fieldkit.cli.display import showing_progress
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.text import print_text
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, number_text, wrapped
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.run_record import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.external import without_federates
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.bounds import BoundCost, FixedCost, bound_cost, fixed_cost, longest_sufficient_window
from sim_backends.cosim.studies.seeds import Task, run_many

_SEED: Final = SheetColumn("seed", "seed", "")
_BOUND: Final = (
    SheetColumn("largest_m", "largest (mm)", "largest position error with error_bounded", 1e3),
    SheetColumn("exchanges", "exchanges", "number of exchanges with error_bounded"),
    SheetColumn("added_s", "added (ms)", "mean delay that error_bounded adds", 1e3),
    SheetColumn("all_window_s", "all runs (ms)", "longest fixed window that keeps the bound in all runs", 1e3),
    SheetColumn("all_exchanges", "fixed", "number of exchanges with that window"),
    SheetColumn("all_factor", "factor", "ratio of `fixed` to `exchanges`"),
)
_WINDOW_OF_RUN: Final = (
    SheetColumn("found_window_s", "this run (ms)", "longest fixed window that keeps the bound in this run", 1e3),
    SheetColumn("found_exchanges", "fixed", "number of exchanges with that window"),
    SheetColumn("found_factor", "factor", "ratio of `fixed` to `exchanges`"),
)


BOUND_ROUNDING: Final = 1e-6
"""A smaller excess over a bound, as a share of the bound, is a rounding error."""


def run(arguments: argparse.Namespace) -> int:
    """Search for the longest fixed window that keeps the bound; print its cost and the cost of `error_bounded`.

    Raises:
        ConfigurationError: An option does not apply to this mode.
    """
    if arguments.figure is not None or arguments.policy or arguments.windows:
        raise ConfigurationError(
            "--bound compares error_bounded with fixed windows, and has no figure",
            remedy="remove --figure, --policy and --window; change the bound by --set policy.bound=1cm",
        )
    scenario = settings.read_scenario(arguments)
    if scenario.policy.bound_db is not None:
        raise ConfigurationError(
            "--bound needs a bound on position errors, but policy.bound_db is a bound on the error of path loss",
            remedy="remove policy.bound_db; change the bound by --set policy.bound=1cm",
        )
    seeds = settings.read_seeds(arguments, scenario)
    build(without_federates(scenario))  # raises before any run if the scenario is invalid
    tasks = [Task(ErrorBounded.name, seed) for seed in seeds]
    workers = settings.read_workers(arguments)
    with showing_progress() as sink:
        report = partial(progress_reporter(sink, "seeds"), "bound", len(seeds))
        report(0)
        costs = run_many(partial(_bound_cost, scenario), tasks, workers=workers, progress=report)
        window_s, fixed_costs = longest_sufficient_window(
            [cost.window_s for cost in costs],
            lambda fixed_s: run_many(partial(_fixed_cost, scenario, fixed_s), tasks, workers=workers),
            scenario.policy.bound,
        )
    _sheet(scenario, seeds, costs, window_s, fixed_costs).show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        print_text(_summary(scenario, costs, window_s, fixed_costs))
    return 0


def _run(scenario: CosimScenario, task: Task, policy: SyncPolicy) -> Run:
    with build(scenario, policy=policy, seed=task.seed, measures_all=True) as simulation:
        return simulation.run()


def _bound_cost(scenario: CosimScenario, task: Task) -> BoundCost:
    policy = scenario.policy
    run = partial(_run, scenario, task)
    return bound_cost(run, policy.bound, step_s=scenario.physics.step, longest_s=policy.longest)


def _fixed_cost(scenario: CosimScenario, window_s: float, task: Task) -> FixedCost:
    return fixed_cost(partial(_run, scenario, task), window_s)


def _sheet(
    scenario: CosimScenario,
    seeds: Sequence[int],
    costs: Sequence[BoundCost],
    window_s: float,
    fixed_costs: Sequence[FixedCost],
) -> Sheet:
    rows = [
        (
            seed,
            cost.largest_m,
            cost.exchanges,
            cost.added_s,
            window_s,
            fixed_costs[index].exchanges if fixed_costs else None,
            fixed_costs[index].exchanges / cost.exchanges if fixed_costs else None,
            cost.window_s,
            cost.fixed_exchanges or None,
            cost.factor,
        )
        for index, (seed, cost) in enumerate(zip(seeds, costs, strict=True))
    ]
    title = f"{scenario.name}, {scenario.topology}: a bound of {number_text(scenario.policy.bound * 1e3)} mm"
    return Sheet(
        (_SEED, *_BOUND, *_WINDOW_OF_RUN),
        rows,
        [
            SheetPart(title, [column.name for column in (_SEED, *_BOUND)]),
            SheetPart(
                "longest fixed window of each run, determined after the run",
                [column.name for column in (_SEED, *_WINDOW_OF_RUN)],
            ),
        ],
    )


def _summary(
    scenario: CosimScenario, costs: Sequence[BoundCost], window_s: float, fixed_costs: Sequence[FixedCost]
) -> str:
    exchanges = sum(cost.exchanges for cost in costs)
    added_s = [cost.added_s for cost in costs if not math.isnan(cost.added_s)]
    bound_m, largest_m = scenario.policy.bound, max(cost.largest_m for cost in costs)
    bound_text = f"the bound of {number_text(bound_m * 1e3)} mm"
    outcome = (
        f"keeps {bound_text}"
        if largest_m <= bound_m * (1 + BOUND_ROUNDING)
        else f"exceeds {bound_text} (largest error {number_text(largest_m * 1e3)} mm)"
    )
    text = f"error_bounded {outcome} with {format_count(exchanges, 'exchange')}"
    if added_s:
        text += (
            f", and adds {number_text(math.fsum(added_s) / len(added_s) * 1e3)} ms to a delay, because an arrival "
            "waits for the end of its window; on average, that is half of a window, and half of the longest window "
            f"(policy.longest) is {number_text(scenario.policy.longest * 500)} ms"
        )
    if not fixed_costs:
        return f"{text}, and no fixed window keeps the bound"
    fixed_exchanges = sum(cost.exchanges for cost in fixed_costs)
    run_exchanges = sum(cost.fixed_exchanges for cost in costs)
    text += (
        f"; the fixed window that keeps the bound in {format_count(len(costs), 'run')}, "
        f"{number_text(window_s * 1e3)} ms, needs {format_count(fixed_exchanges, 'exchange')}, "
        f"{number_text(fixed_exchanges / exchanges)} times as many"
    )
    if len(costs) > 1:
        text += (
            f"; the longest windows of the single runs need {format_count(run_exchanges, 'exchange')}, "
            f"{number_text(run_exchanges / exchanges)} times as many as error_bounded"
        )
    if window_s == scenario.policy.longest:
        text += "; the fixed window is as long as policy.longest, which limits it"
    return wrapped(text)
