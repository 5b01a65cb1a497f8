"""How many exchanges a bound costs: by `error_bounded`, and by the fixed window that keeps the same bound."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.cosim.comparison import delay_added_s
from sim_backends.cosim.geometry import displaced_m
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.scheduled import Scheduled
from sim_backends.cosim.run import Run

_FINENESS: Final = 1.02
"""A window is found when one that is longer by this factor breaks the bound."""


@dataclass(frozen=True)
class BoundCost:
    """What a bound costs in one run of a scenario.

    Attributes:
        largest_m: The largest error of position in the run by `error_bounded`.
        exchanges: Its exchanges.
        added_s: What it added to a delay, mean; nan where nothing arrived.
        window_s: The longest fixed window that turns out to keep the bound in this run, to 2 %; nan where none does.
        fixed_exchanges: Its exchanges; 0 for none.
    """

    largest_m: float
    exchanges: int
    added_s: float
    window_s: float
    fixed_exchanges: int

    @property
    def factor(self) -> float:
        """By how much `error_bounded` needs fewer exchanges; nan where no fixed window keeps the bound."""
        return self.fixed_exchanges / self.exchanges if self.fixed_exchanges else math.nan


@dataclass(frozen=True)
class FixedCost:
    """What one fixed window costs in one run.

    Attributes:
        largest_m: The largest error of position.
        exchanges: The exchanges.
    """

    largest_m: float
    exchanges: int


def bound_cost(
    run: Callable[[SyncPolicy], Run], bound_m: float, *, step_s: float, longest_s: float = 0.1
) -> BoundCost:
    """Return what a bound costs in a scenario with one seed.

    Fixed windows are those of `scheduled`, in which packets enter and arrive as by `error_bounded`, while agents
    stand for the network where they were at the window's begin; none is longer than what `error_bounded` may take.

    Args:
        run: Runs the scenario, always the same, by a policy.
        bound_m: By how much the network may be wrong about two agents' places.
        step_s: The physics' own step, which is the shortest window.
        longest_s: The longest window.
    """
    bounded = run(ErrorBounded(bound_m, longest_s))
    window_s, fixed = _longest_fixed(lambda tried_s: fixed_cost(run, tried_s), bound_m, step_s, longest_s)
    return BoundCost(largest_m(bounded), len(bounded.windows_ns), delay_added_s(bounded), window_s, fixed.exchanges)


def fixed_cost(run: Callable[[SyncPolicy], Run], window_s: float) -> FixedCost:
    """Return what a fixed window costs in a scenario with one seed; `run` as of `bound_cost`."""
    done = run(Scheduled(window_s))
    return FixedCost(largest_m(done), len(done.windows_ns))


def kept_by_all(
    found_s: Sequence[float], costs: Callable[[float], Sequence[FixedCost]], bound_m: float
) -> tuple[float, Sequence[FixedCost]]:
    """Return the longest fixed window, to 2 %, that keeps a bound in all runs, and what it costs in each.

    It is the one that somebody would have to choose before the next run; nan and nothing where there is none.

    Args:
        found_s: The longest that keeps it in each run.
        costs: Returns what a window costs in each run.
        bound_m: The bound.
    """
    window_s = min(found_s, key=lambda one: -math.inf if math.isnan(one) else one)
    # One that is long enough to break it may yet keep it by chance, so that a shorter one breaks it in another run.
    while not math.isnan(window_s):
        found = costs(window_s)
        if all(one.largest_m <= bound_m for one in found):
            return window_s, found
        window_s /= _FINENESS
    return math.nan, ()


def _longest_fixed(
    cost: Callable[[float], FixedCost], bound_m: float, shortest_s: float, longest_s: float
) -> tuple[float, FixedCost]:
    """Return the longest fixed window that keeps a bound, and what it costs; nan and nothing for none."""
    found = longest_s, cost(longest_s)
    if found[1].largest_m <= bound_m:
        return found
    found = shortest_s, cost(shortest_s)
    if found[1].largest_m > bound_m:
        return math.nan, FixedCost(math.nan, 0)
    breaks_s = longest_s
    while breaks_s > _FINENESS * found[0]:
        window_s = math.sqrt(found[0] * breaks_s)
        tried = cost(window_s)
        if tried.largest_m > bound_m:
            breaks_s = window_s
        else:
            found = window_s, tried
    return found


def largest_m(run: Run) -> float:
    """Return the largest error of position of a run; 0 without packets."""
    return max((displaced_m(fate) for fate in run.fates.values()), default=0.0)
