"""Counts the exchanges (windows) needed to keep a bound: with `error_bounded`, and with the longest fixed window."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.cosim.comparison import delay_added_s
from sim_backends.cosim.packet_ledger import position_error_m
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.policies.window_policies import Scheduled
from sim_backends.cosim.run_record import Run

_TOLERANCE: Final = 1.02
"""The search ends when the window is known within this factor."""


@dataclass(frozen=True)
class BoundCost:
    """The cost of a bound in one run of a scenario.

    Attributes:
        largest_m: The largest position error of the run with `error_bounded`.
        exchanges: The number of exchanges of that run.
        added_s: Mean delay that `error_bounded` added to a packet; nan if no packet arrived.
        window_s: The longest fixed window that keeps the bound in this run, with a tolerance of 2 %; nan if there is
            none.
        fixed_exchanges: Number of exchanges with that window; 0 if there is none.
    """

    largest_m: float
    exchanges: int
    added_s: float
    window_s: float
    fixed_exchanges: int

    @property
    def factor(self) -> float:
        """Ratio of the exchanges with that window to those with `error_bounded`; nan if no window keeps the bound."""
        return self.fixed_exchanges / self.exchanges if self.fixed_exchanges else math.nan


@dataclass(frozen=True)
class FixedCost:
    """The error and the cost of one fixed window in one run.

    Attributes:
        largest_m: The largest position error.
        exchanges: The number of exchanges.
    """

    largest_m: float
    exchanges: int


def bound_cost(
    run: Callable[[SyncPolicy], Run], bound_m: float, *, step_s: float, longest_s: float = 0.1
) -> BoundCost:
    """Return the cost of a bound in a scenario with one seed.

    Fixed windows use the policy `scheduled`. Packets enter and arrive as with `error_bounded`, but the network
    assumes that agents stay where they were at the beginning of the window. No window is longer than `longest_s`.

    Args:
        run: Runs the same scenario and seed with a policy.
        bound_m: Largest allowed error of the network's relative position of two agents.
        step_s: The physics step, which is the shortest window.
        longest_s: The longest window.
    """
    bounded_run = run(ErrorBounded(bound_m, longest_s))
    window_s, fixed = _longest_fixed(lambda window_s: fixed_cost(run, window_s), bound_m, step_s, longest_s)
    return BoundCost(
        largest_m(bounded_run), len(bounded_run.windows_ns), delay_added_s(bounded_run), window_s, fixed.exchanges
    )


def fixed_cost(run: Callable[[SyncPolicy], Run], window_s: float) -> FixedCost:
    """Return the cost of a fixed window in a scenario with one seed.

    Args:
        run: Runs the same scenario and seed with a policy.
        window_s: The window.
    """
    result = run(Scheduled(window_s))
    return FixedCost(largest_m(result), len(result.windows_ns))


def longest_sufficient_window(
    longest_s: Sequence[float], costs: Callable[[float], Sequence[FixedCost]], bound_m: float
) -> tuple[float, Sequence[FixedCost]]:
    """Return the longest fixed window that keeps a bound in all runs, and its cost in each run.

    This is the window that a user would choose for further runs; it is determined within 2 %. If no window keeps the
    bound in one of the runs, the result is nan and an empty sequence.

    Args:
        longest_s: The longest window that keeps the bound in each run; nan for a run without such a window.
        costs: Returns the cost of a window in each run.
        bound_m: The bound.
    """
    window_s = min(longest_s, key=lambda run_longest_s: -math.inf if math.isnan(run_longest_s) else run_longest_s)
    # A window may keep the bound by chance in one run, so even the shortest of these windows may exceed it in another
    # run.
    while not math.isnan(window_s):
        all_costs = costs(window_s)
        if all(cost.largest_m <= bound_m for cost in all_costs):
            return window_s, all_costs
        window_s /= _TOLERANCE
    return math.nan, ()


def _longest_fixed(
    cost: Callable[[float], FixedCost], bound_m: float, shortest_s: float, longest_s: float
) -> tuple[float, FixedCost]:
    """Return the longest fixed window that keeps a bound, and its cost; nan values if there is none."""
    best = longest_s, cost(longest_s)
    if best[1].largest_m <= bound_m:
        return best
    best = shortest_s, cost(shortest_s)
    if best[1].largest_m > bound_m:
        return math.nan, FixedCost(math.nan, 0)
    too_long_s = longest_s
    while too_long_s > _TOLERANCE * best[0]:
        window_s = math.sqrt(best[0] * too_long_s)  # the geometric mean, because the tolerance is a factor
        window_cost = cost(window_s)
        if window_cost.largest_m > bound_m:
            too_long_s = window_s
        else:
            best = window_s, window_cost
    return best


def largest_m(run: Run) -> float:
    """Return the largest position error of a run; 0 without packets."""
    return max((position_error_m(fate) for fate in run.fates.values()), default=0.0)
