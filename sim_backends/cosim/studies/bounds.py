"""How many exchanges a bound costs: by `error_bounded`, and by the fixed window that keeps the same bound."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from sim_backends.cosim.comparison import displaced_m
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.scheduled import Scheduled
from sim_backends.cosim.run import Run


@dataclass(frozen=True)
class BoundCost:
    """What a bound costs in one scenario.

    Attributes:
        bound_m: The bound.
        largest_m: The largest error of position in the run by `error_bounded`.
        bounded_exchanges: Its exchanges.
        window_s: The longest fixed window that keeps the bound too, to 5 %; nan where none does.
        fixed_exchanges: Its exchanges.
    """

    bound_m: float
    largest_m: float
    bounded_exchanges: int
    window_s: float
    fixed_exchanges: int

    @property
    def factor(self) -> float:
        """By how much `error_bounded` needs fewer exchanges; nan where no fixed window keeps the bound."""
        return self.fixed_exchanges / self.bounded_exchanges if self.fixed_exchanges else math.nan


def bound_cost(
    run: Callable[[SyncPolicy], Run], bound_m: float, *, step_s: float, longest_s: float = 0.1
) -> BoundCost:
    """Return what a bound costs in a scenario.

    Fixed windows are those of `scheduled`, which gives the network what `error_bounded` gives it, at its window's
    begin; none is longer than what `error_bounded` may take.

    Args:
        run: Runs the scenario, always the same, by a policy.
        bound_m: By how much two agents may displace each other within a window.
        step_s: The physics' own step, which is the shortest window.
        longest_s: The longest window.
    """
    bounded = run(ErrorBounded(bound_m, longest_s))
    window_s, fixed = longest_s, run(Scheduled(longest_s))
    if largest_m(fixed) > bound_m:
        keeps_s, breaks_s = step_s, longest_s
        fixed = run(Scheduled(keeps_s))
        if largest_m(fixed) > bound_m:
            return BoundCost(bound_m, largest_m(bounded), len(bounded.windows_ns), math.nan, 0)
        while breaks_s > 1.05 * keeps_s:
            window_s = math.sqrt(keeps_s * breaks_s)
            tried = run(Scheduled(window_s))
            if largest_m(tried) > bound_m:
                breaks_s = window_s
            else:
                keeps_s, fixed = window_s, tried
        window_s = keeps_s
    return BoundCost(bound_m, largest_m(bounded), len(bounded.windows_ns), window_s, len(fixed.windows_ns))


def largest_m(run: Run) -> float:
    """Return the largest error of position of a run; 0 without packets."""
    return max((displaced_m(fate) for fate in run.fates.values()), default=0.0)
