"""`fieldkit cosim shootout SCENARIO --bound`: what a bound costs, by `error_bounded` and by fixed windows."""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Final

from fieldkit.cli.display import working
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, number
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.bounds import BoundCost, CertainCost, bound_cost
from sim_backends.cosim.studies.seeds import Task, run_many

_COLUMNS: Final = (
    SheetColumn("seed", "seed", ""),
    SheetColumn("largest_m", "largest (mm)", "error of position by error_bounded", 1e3),
    SheetColumn("bounded_exchanges", "exchanges", "of error_bounded"),
    SheetColumn("certain_window_s", "certain (ms)", "fixed window that keeps the bound whatever bodies do", 1e3),
    SheetColumn("certain_exchanges", "its exchanges", ""),
    SheetColumn("certain_factor", "factor", "by which error_bounded needs fewer exchanges"),
    SheetColumn("found_window_s", "found (ms)", "longest fixed window that, by a search, kept it in this run", 1e3),
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
    seeds = settings.seeds(arguments, scenario)
    build(scenario)  # what cannot be run is told before anything runs
    tasks = [Task(ErrorBounded.name, seed) for seed in seeds]
    with working() as sink:
        told = partial(teller(sink, "seeds"), "bound", len(seeds))
        told(0)
        costs = run_many(partial(_cost, scenario), tasks, progress=told)
    _sheet(scenario, seeds, costs).show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        print(certain_words(scenario, [cost.certain for cost in costs]))
        print(_found_words(costs))
    return 0


def _cost(scenario: CosimScenario, task: Task) -> BoundCost:
    def run_by(policy: SyncPolicy) -> Run:
        return build(scenario, policy=policy, seed=task.seed).run()

    chosen = scenario.policy
    return bound_cost(run_by, chosen.bound, step_s=scenario.physics.step, longest_s=chosen.longest)


def _sheet(scenario: CosimScenario, seeds: Sequence[int], costs: Sequence[BoundCost]) -> Sheet:
    rows = [
        (
            seed,
            cost.largest_m,
            cost.certain.bounded_exchanges,
            cost.certain.shortest_s,
            cost.certain.exchanges,
            cost.certain.factor,
            cost.window_s,
            cost.fixed_exchanges or None,
            cost.factor,
        )
        for seed, cost in zip(seeds, costs, strict=True)
    ]
    title = f"{scenario.name}, {scenario.topology}: a bound of {number(scenario.policy.bound * 1e3)} mm"
    names = [column.name for column in _COLUMNS]
    return Sheet(_COLUMNS, rows, [SheetPart(title, names[:6]), SheetPart("the window found", [names[0], *names[6:]])])


def certain_words(scenario: CosimScenario, costs: Sequence[CertainCost]) -> str:
    """Return in words by how much fewer exchanges `error_bounded` takes than the window that is certain.

    Args:
        scenario: Has the bound.
        costs: Of each seed.
    """
    least_s = min(cost.shortest_s for cost in costs)
    return (
        f"error_bounded keeps {number(scenario.policy.bound * 1e3)} mm with {_factor([one.factor for one in costs])} "
        "exchanges than the\n"
        f"fixed window that keeps it whatever bodies do, {number(least_s * 1e3)} ms"
    )


def _found_words(costs: Sequence[BoundCost]) -> str:
    factors = [cost.factor for cost in costs if cost.fixed_exchanges]
    if not factors:
        return "and no fixed window kept it"
    return f"and with {_factor(factors)} than the longest that, as is known afterwards, kept it"


def _factor(factors: Sequence[float]) -> str:
    mean = sum(factors) / len(factors)
    return f"{number(mean)} times fewer" if mean >= 1 else f"{number(1 / mean)} times more"
