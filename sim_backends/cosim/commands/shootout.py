"""The command `fieldkit cosim shootout`, which prints the error and the cost of each sync policy."""

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Final

from fieldkit.cli.display import show_note, showing_progress
from fieldkit.core.events import Sink
from fieldkit.core.executors import Workers
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import bias, bound, orders, settings
from sim_backends.cosim.commands.results import FORMATION, formation_values
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value
from sim_backends.cosim.comparison import Errors
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.scenario.build import Simulation, build
from sim_backends.cosim.scenario.external import without_federates
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.formation import compute_formation, has_followers
from sim_backends.cosim.studies.shootout import Row, rows, run_outcomes

_ROW: Final = (
    SheetColumn("policy", "policy", ""),
    SheetColumn("window_s", "w (ms)", "window", 1e3),
    SheetColumn("seeds", "seeds", "number of seeds in the means"),
)
_TIMES: Final = (
    SheetColumn(
        "delivery_error_mean_s",
        "time (ms)",
        "mean absolute difference from the delivery time in the reference",
        1e3,
    ),
    SheetColumn("delivery_error_p95_s", "p95", "its 95th percentile", 1e3),
    SheetColumn("delivery_error_max_s", "max", "its maximum", 1e3),
    SheetColumn("delay_added_s", "added", "mean delay that the policy added, in ms", 1e3),
    SheetColumn("fate_disagreement", "fate (%)", "packets lost here or in the reference, but not in both", 100),
    SheetColumn(
        "causality_violations", "late", "arrivals per run at a time that was already in the past of the receiver"
    ),
)
_POSITIONS: Final = (
    SheetColumn("position_error_mean_m", "position (mm)", "mean error of relative positions in the network", 1e3),
    SheetColumn("position_error_p95_m", "p95", "its 95th percentile", 1e3),
    SheetColumn("position_error_max_m", "max", "its maximum", 1e3),
    SheetColumn(
        "path_error_mean_m",
        "path (mm)",
        "mean distance of agents from their positions in the reference, over time",
        1e3,
    ),
    SheetColumn("path_error_max_m", "max", "its maximum", 1e3),
)
_COSTS: Final = (
    SheetColumn("exchanges_per_s", "per s", "exchanges per simulated second"),
    SheetColumn("wall_agents", "agents (%)", "share of wall time in physics and programs", 100),
    SheetColumn("wall_network", "network", "share of wall time in the network", 100),
    SheetColumn("wall_exchange", "exchange", "share of wall time in the coordinator", 100),
    SheetColumn("wall_wait", "wait", "share of wall time in federates that only waited", 100),
    SheetColumn("real_time_factor", "speed", "simulated time over wall time"),
)
COLUMNS: Final = (*_ROW, *_TIMES, *_POSITIONS, *_COSTS, *FORMATION)


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario with each policy; print, and draw on request, the errors and the costs of the policies."""
    if arguments.orders:
        return orders.run(arguments)
    if arguments.bias:
        return bias.run(arguments)
    if arguments.bound:
        return bound.run(arguments)
    scenario = settings.read_scenario(arguments)
    policies = settings.read_policies(arguments)
    seeds = settings.read_seeds(arguments, scenario)
    windows_s = settings.read_windows_s(arguments, scenario)
    draw = None if arguments.figure is None else settings.open_figure(arguments.figure, "--figure")
    build(without_federates(scenario))  # raises before any run if the scenario is invalid
    settings.note_commensurate_events(scenario, policies, windows_s, len(seeds))
    with showing_progress() as sink:
        workers = settings.read_workers(arguments, scenario.packets * (len(policies) + 1) * len(seeds))
        all_rows = _all_rows(scenario, policies, seeds, windows_s, workers=workers, sink=sink)
    _sheet(scenario, all_rows, seeds).show(arguments.format)
    for window_s, row in all_rows:
        if row.failure:
            show_note(f"{settings.policy_text(row.policy, settings.with_window(scenario, window_s))}: {row.failure}")
        if (note := _exceeded_bound(scenario, row)) is not None:
            show_note(note)
    if draw is not None:
        from sim_backends.cosim.commands import plot  # noqa: PLC0415 (importing matplotlib takes half a second)

        panel = None
        if has_followers(scenario):
            longest_s = windows_s[-1]
            longest_rows = (row for window_s, row in all_rows if window_s == longest_s)
            panel = plot.growth_panel(longest_rows, f"{longest_s * 1e3:g} ms")
        draw(plot.error_against_cost(plot.cost_points(row for _, row in all_rows), panel))
    return 0


def _all_rows(
    scenario: CosimScenario,
    policies: Sequence[str],
    seeds: Sequence[int],
    windows_s: Sequence[float],
    *,
    workers: Workers,
    sink: Sink,
) -> list[tuple[float, Row]]:
    """Return a row for each policy; policies with a window have a row for each window."""
    all_rows: list[tuple[float, Row]] = []
    report = progress_reporter(sink)
    for number, window_s in enumerate(windows_s):
        policies_to_run = [name for name in policies if number == 0 or settings.has_window(name)]
        make_simulation = partial(_build, settings.with_window(scenario, window_s))
        runs = len({*policies_to_run, EventDriven.name}) * len(seeds)
        progress = partial(report, f"window {window_s * 1e3:g} ms", runs)
        progress(0)
        window_outcomes = run_outcomes(make_simulation, policies_to_run, seeds, workers=workers, progress=progress)
        window_rows = rows(window_outcomes, partial(compute_formation, scenario))
        all_rows += [(window_s, row) for row in window_rows if row.policy in policies_to_run]
    return sorted(all_rows, key=lambda window_and_row: policies.index(window_and_row[1].policy))


def _exceeded_bound(scenario: CosimScenario, row: Row) -> str | None:
    """Return a note if `error_bounded` exceeded a bound in metres; otherwise None."""
    chosen_policy = scenario.policy
    if row.policy != ErrorBounded.name or row.errors is None or chosen_policy.bound_db is not None:
        return None
    largest_m = row.errors.position_error_m.largest
    if math.isnan(largest_m) or largest_m <= chosen_policy.bound * (1 + bound.BOUND_ROUNDING):
        return None
    return (
        f"{row.policy} had a position error of {largest_m * 1e3:.3g} mm, more than its bound of "
        f"{chosen_policy.bound * 1e3:.3g} mm: agents changed their velocity "
        "by more than limits_m_s2 of the physics federate"
    )


def _build(scenario: CosimScenario, policy: str, seed: int) -> Simulation:
    return build(scenario, policy=policy, seed=seed, measures_all=True)


def _sheet(scenario: CosimScenario, all_rows: Sequence[tuple[float, Row]], seeds: Sequence[int]) -> Sheet:
    name = f"{scenario.name}, {scenario.topology}, {format_count(len(seeds), 'seed')}"
    windows_s = {window_s for window_s, _ in all_rows}
    row_labels = ["policy", "window_s"]
    if len(windows_s) == 1:
        name += f", window {windows_s.pop() * 1e3:g} ms"
        row_labels = ["policy"]

    def part(title: str, columns: Sequence[SheetColumn]) -> SheetPart:
        return SheetPart(title, [*row_labels, *(column.name for column in columns)])

    return Sheet(
        COLUMNS,
        [_values(window_s, row) for window_s, row in all_rows],
        [
            part(f"{name}: packets against the exact reference, {EventDriven.name}", _TIMES),
            part("positions", _POSITIONS),
            *([part("followers", FORMATION)] if has_followers(scenario) else []),
            part("cost", _COSTS),
        ],
    )


def _values(window_s: float, row: Row) -> Sequence[Value]:
    first_values: tuple[Value, ...] = (
        row.policy,
        window_s if settings.has_window(row.policy) else None,
        len(row.by_seed),
    )
    if row.errors is None or row.formation is None:
        return first_values + (None,) * (len(COLUMNS) - len(first_values))
    return (*first_values, *_error_values(row.errors), *formation_values(row.formation))


def _error_values(errors: Errors) -> tuple[Value, ...]:
    time_s, position_m, path_m = errors.delivery_error_s, errors.position_error_m, errors.path_error_m
    wall_s = sum(errors.wall_s.values()) or math.nan
    return (
        *(time_s.mean, time_s.p95, time_s.largest),
        errors.delay_added_s,
        errors.fate_disagreement,
        errors.causality_violations,
        *(position_m.mean, position_m.p95, position_m.largest),
        *(path_m.mean, path_m.largest),
        errors.exchanges_per_s,
        *(errors.wall_s[part] / wall_s for part in ("agents", "network", "exchange", "wait")),
        errors.real_time_factor,
    )
