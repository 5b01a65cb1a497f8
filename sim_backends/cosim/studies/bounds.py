"""How many exchanges a bound costs: by `error_bounded`, and by the fixed window that keeps the same bound."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim_backends.cosim.comparison import displaced_m
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.scheduled import Scheduled
from sim_backends.cosim.run import Run


@dataclass(frozen=True)
class CertainCost:
    """What a bound costs by `error_bounded`, and by the fixed window that keeps it whatever bodies do.

    Attributes:
        bounded_exchanges: The exchanges of `error_bounded`.
        shortest_s: Its shortest window: a fixed one may not be longer to keep the bound whatever bodies do.
        exchanges: The exchanges of that fixed window.
    """

    bounded_exchanges: int
    shortest_s: float
    exchanges: int

    @property
    def factor(self) -> float:
        """By how much `error_bounded` needs fewer exchanges."""
        return self.exchanges / self.bounded_exchanges


def certain_cost(bounded: Run) -> CertainCost:
    """Return what a bound costs.

    Args:
        bounded: The run by `error_bounded`.
    """
    lengths_ns = np.diff(bounded.windows_ns, prepend=0)
    # The last one was cut at the end of the run.
    shortest_s = float(lengths_ns[:-1].min(initial=lengths_ns[0])) / 1e9
    return CertainCost(len(lengths_ns), shortest_s, math.ceil(bounded.windows_ns[-1] / 1e9 / shortest_s))


@dataclass(frozen=True)
class BoundCost:
    """What a bound costs in one scenario.

    Attributes:
        bound_m: The bound.
        largest_m: The largest error of position in the run by `error_bounded`.
        certain: Its exchanges, and those of the fixed window that keeps the bound for certain.
        window_s: The longest fixed window that turns out to keep the bound in this run, to 5 %; nan where none does.
        fixed_exchanges: Its exchanges.
    """

    bound_m: float
    largest_m: float
    certain: CertainCost
    window_s: float
    fixed_exchanges: int

    @property
    def factor(self) -> float:
        """The same beside the fixed window that, as is known afterwards, would have done; nan where none would.

        Below 1 the bodies did less than they might have done, and `error_bounded` cannot know it before.
        """
        return self.fixed_exchanges / self.certain.bounded_exchanges if self.fixed_exchanges else math.nan


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
    window_s, fixed = _longest_fixed(run, bound_m, step_s, longest_s)
    return BoundCost(bound_m, largest_m(bounded), certain_cost(bounded), window_s, len(fixed.windows_ns))


def _longest_fixed(
    run: Callable[[SyncPolicy], Run], bound_m: float, shortest_s: float, longest_s: float
) -> tuple[float, Run]:
    """Return the longest fixed window whose run keeps a bound, to 5 %, and that run; nan and none for none."""
    found = longest_s, run(Scheduled(longest_s))
    if largest_m(found[1]) <= bound_m:
        return found
    found = shortest_s, run(Scheduled(shortest_s))
    if largest_m(found[1]) > bound_m:
        return math.nan, Run()
    breaks_s = longest_s
    while breaks_s > 1.05 * found[0]:
        window_s = math.sqrt(found[0] * breaks_s)
        tried = run(Scheduled(window_s))
        if largest_m(tried) > bound_m:
            breaks_s = window_s
        else:
            found = window_s, tried
    return found


def largest_m(run: Run) -> float:
    """Return the largest error of position of a run; 0 without packets."""
    return max((displaced_m(fate) for fate in run.fates.values()), default=0.0)
