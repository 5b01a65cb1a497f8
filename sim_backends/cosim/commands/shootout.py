"""`fieldkit cosim shootout SCENARIO`: how wrong each sync policy is, and what it costs."""

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Final

from fieldkit.cli.display import show_note, working
from fieldkit.core.events import Sink
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import bias, bound, orders, settings
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.followers import FORMATION, formation_values
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value
from sim_backends.cosim.comparison import Errors
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.scenario.build import Simulation, build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.formation import formation, has_followers
from sim_backends.cosim.studies.outcomes import outcomes
from sim_backends.cosim.studies.shootout import Row, rows

COLUMNS: Final = (
    SheetColumn("policy", "policy", ""),
    SheetColumn("window_s", "w (ms)", "window", 1e3),
    SheetColumn("seeds", "seeds", "runs that the numbers are means of"),
    SheetColumn("delivery_error_mean_s", "time (ms)", "delivery time less the reference's, magnitude, mean", 1e3),
    SheetColumn("delivery_error_p95_s", "p95", "its 95th percentile", 1e3),
    SheetColumn("delivery_error_max_s", "max", "its maximum", 1e3),
    SheetColumn("delay_added_s", "added", "what the policy added to the delay, mean, in ms", 1e3),
    SheetColumn("fate_disagreement", "fate (%)", "packets lost here or there, but not in both", 100),
    SheetColumn("causality_violations", "late", "arrivals that their receiver had passed already, per run"),
    SheetColumn("position_error_mean_m", "place (mm)", "how wrong the network was about two agents, mean", 1e3),
    SheetColumn("position_error_p95_m", "p95", "its 95th percentile", 1e3),
    SheetColumn("position_error_max_m", "max", "its maximum", 1e3),
    SheetColumn("path_error_mean_m", "path (mm)", "how far off the agents are, mean over time", 1e3),
    SheetColumn("path_error_max_m", "max", "its maximum", 1e3),
    SheetColumn("exchanges_per_s", "per s", "exchanges per simulated second"),
    SheetColumn("wall_agents", "agents (%)", "share of wall time in physics and programs", 100),
    SheetColumn("wall_network", "network", "in the network", 100),
    SheetColumn("wall_exchange", "exchange", "in the coordinator", 100),
    SheetColumn("wall_wait", "wait", "in federates that only waited", 100),
    SheetColumn("real_time_factor", "speed", "simulated time over wall time"),
    *FORMATION,
)
_ROUNDING: Final = 1e-6
_TIME: Final = ("policy", *(column.name for column in COLUMNS[3:9]))
_PLACE: Final = ("policy", *(column.name for column in COLUMNS[9:14]))
_COST: Final = ("policy", *(column.name for column in COLUMNS[14:20]))
_FOLLOWERS: Final = ("policy", *(column.name for column in FORMATION))


def run(arguments: argparse.Namespace) -> int:
    """Run the scenario by each policy, print how wrong each was, and draw error against cost."""
    if arguments.orders:
        return orders.run(arguments)
    if arguments.bias:
        return bias.run(arguments)
    if arguments.bound:
        return bound.run(arguments)
    scenario = settings.scenario(arguments)
    policies = settings.policies(arguments)
    seeds = settings.seeds(arguments, scenario)
    windows_s = settings.windows_s(arguments, scenario)
    draw = None if arguments.figure is None else settings.figure(arguments.figure, "--figure")
    build(scenario)  # what cannot be run is told before anything runs
    settings.note_shared_beats(scenario, policies, windows_s, len(seeds))
    with working() as sink:
        found = _all_rows(scenario, policies, seeds, windows_s, sink)
    _sheet(scenario, found, seeds).show(arguments.format)
    for window_s, row in found:
        if row.failure:
            show_note(f"{settings.in_words(row.policy, settings.with_window(scenario, window_s))}: {row.failure}")
        if (broken := _broken_bound(scenario, row)) is not None:
            show_note(broken)
    if draw is not None:
        from sim_backends.cosim.commands import figures  # noqa: PLC0415 (matplotlib takes half a second)

        panel = None
        if has_followers(scenario):
            panel = figures.growth((row for one, row in found if one == windows_s[-1]), f"{windows_s[-1] * 1e3:g} ms")
        draw(figures.error_against_cost(figures.cost_points(row for _, row in found), panel))
    return 0


def _all_rows(
    scenario: CosimScenario, policies: Sequence[str], seeds: Sequence[int], windows_s: Sequence[float], sink: Sink
) -> list[tuple[float, Row]]:
    """Return a row for each policy, and one for each window of those that have one."""
    found: list[tuple[float, Row]] = []
    tell = teller(sink)
    for number, window_s in enumerate(windows_s):
        chosen = [name for name in policies if number == 0 or settings.has_window(name)]
        make = partial(_make, settings.with_window(scenario, window_s))
        runs = len({*chosen, EventDriven.name}) * len(seeds)
        told = partial(tell, f"window {window_s * 1e3:g} ms", runs)
        told(0)
        done = outcomes(make, chosen, seeds, progress=told)
        found += [(window_s, row) for row in rows(done, partial(formation, scenario)) if row.policy in chosen]
    return sorted(found, key=lambda one: policies.index(one[1].policy))


def _broken_bound(scenario: CosimScenario, row: Row) -> str | None:
    """Return a note where `error_bounded` did not keep a bound in metres; None if it did, or another one runs."""
    chosen = scenario.policy
    if row.policy != ErrorBounded.name or row.errors is None or chosen.bound_db is not None:
        return None
    largest_m = row.errors.position_error_m.largest
    if math.isnan(largest_m) or largest_m <= chosen.bound * (1 + _ROUNDING):
        return None
    return (
        f"{row.policy} was wrong about a place by {largest_m * 1e3:.3g} mm, more than its bound of "
        f"{chosen.bound * 1e3:.3g} mm: agents changed their velocity by more than the physics' limits_m_s2 say"
    )


def _make(scenario: CosimScenario, policy: str, seed: int) -> Simulation:
    return build(scenario, policy=policy, seed=seed, measures_all=True)


def _sheet(scenario: CosimScenario, found: Sequence[tuple[float, Row]], seeds: Sequence[int]) -> Sheet:
    name = f"{scenario.name}, {scenario.topology}, {format_count(len(seeds), 'seed')}"
    window_s = {one for one, _ in found}
    if len(window_s) == 1:
        name += f", window {window_s.pop() * 1e3:g} ms"
        window: tuple[str, ...] = ()
    else:
        window = ("window_s",)
    return Sheet(
        COLUMNS,
        [_row(*one) for one in found],
        [
            SheetPart(f"{name}: packets against the exact reference, {EventDriven.name}", (*window, *_TIME)),
            SheetPart("positions", (*window, *_PLACE)),
            *([SheetPart("followers", (*window, *_FOLLOWERS))] if has_followers(scenario) else []),
            SheetPart("cost", (*window, *_COST)),
        ],
    )


def _row(window_s: float, row: Row) -> Sequence[Value]:
    told: tuple[Value, ...] = (row.policy, window_s if settings.has_window(row.policy) else None, len(row.by_seed))
    if row.errors is None or row.formation is None:
        return told + (None,) * (len(COLUMNS) - len(told))
    return (*told, *_numbers(row.errors), *formation_values(row.formation))


def _numbers(errors: Errors) -> tuple[Value, ...]:
    time_s, place_m, path_m = errors.delivery_error_s, errors.position_error_m, errors.path_error_m
    wall_s = sum(errors.wall_s.values()) or math.nan
    return (
        *(time_s.mean, time_s.p95, time_s.largest),
        errors.delay_added_s,
        errors.fate_disagreement,
        errors.causality_violations,
        *(place_m.mean, place_m.p95, place_m.largest),
        *(path_m.mean, path_m.largest),
        errors.exchanges_per_s,
        *(errors.wall_s[part] / wall_s for part in ("agents", "network", "exchange", "wait")),
        errors.real_time_factor,
    )
