"""The order of every method: local errors over windows of many lengths, on several processors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Final

from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.base import PolicyError, SyncPolicy
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.cosim.policies.scheduled import Scheduled
from sim_backends.cosim.policies.sliding_window import SlidingWindow
from sim_backends.cosim.policies.time_stepped import TimeStepped
from sim_backends.cosim.policies.velocity_aware import VelocityAware
from sim_backends.cosim.policies.velocity_aware_raw import VelocityAwareRaw
from sim_backends.cosim.studies.local_errors import LocalErrors, local_errors, pooled
from sim_backends.cosim.studies.seeds import Task, run_many

_LONGEST_S: Final = 10.0
"""So long that no window of a study is cut short by it."""


def _velocity_aware(window_s: float) -> SyncPolicy:
    return VelocityAware(window_s, _LONGEST_S)


def _error_bounded(window_s: float) -> SyncPolicy:
    # The bound that two agents reach in that time at 1 m/s; errors are drawn over the windows that come of it.
    return ErrorBounded(window_s, _LONGEST_S)


METHODS: Final[Mapping[str, Callable[[float], SyncPolicy]]] = MappingProxyType(
    {
        TimeStepped.name: TimeStepped,
        Scheduled.name: Scheduled,
        SlidingWindow.name: SlidingWindow,
        VelocityAwareRaw.name: VelocityAwareRaw,
        VelocityAware.name: _velocity_aware,
        ErrorBounded.name: _error_bounded,
    }
)
"""Makes each policy that is not exact from the length of a window in seconds, or what comes near it."""


@dataclass(frozen=True)
class Orders:
    """Local errors of methods over seeds.

    Attributes:
        errors: Of each method that could be run.
        failures: Why the others could not.
    """

    errors: Mapping[str, LocalErrors]
    failures: Mapping[str, PolicyError]


def orders(
    make: Callable[[SyncPolicy, int], Coordinator],
    windows_s: Sequence[float],
    begins_ns: Sequence[int],
    seeds: Sequence[int],
    *,
    methods: Sequence[str] = tuple(METHODS),
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Orders:
    """Return the local errors of methods in a scenario, over windows of several lengths.

    Args:
        make: Builds the scenario for a policy and a seed; can be pickled.
        windows_s: The lengths, a decade of them at least.
        begins_ns: When windows begin, in each seed's run; as `spread_over` gives them.
        seeds: The seeds, whose windows count together.
        methods: Names in `METHODS`.
        workers: As of `run_many`.
        progress: As of `run_many`.

    Raises:
        FieldkitError: A run failed otherwise than by a method having no window.
    """
    tasks = [Task(name, seed) for name in methods for seed in seeds]
    work = partial(_of_one, make, tuple(windows_s), tuple(begins_ns))
    found = dict(zip(tasks, run_many(work, tasks, workers=workers, progress=progress), strict=True))
    errors: dict[str, LocalErrors] = {}
    failures: dict[str, PolicyError] = {}
    for name in methods:
        of_seeds = [found[Task(name, seed)] for seed in seeds]
        refused = [one for one in of_seeds if isinstance(one, PolicyError)]
        if refused:
            failures[name] = refused[0]
        else:
            errors[name] = pooled(one for one in of_seeds if isinstance(one, LocalErrors))
    return Orders(errors, failures)


def _of_one(
    make: Callable[[SyncPolicy, int], Coordinator],
    windows_s: Sequence[float],
    begins_ns: Sequence[int],
    task: Task,
) -> LocalErrors | PolicyError:
    try:
        found = local_errors(lambda policy: make(policy, task.seed), {"": METHODS[task.policy]}, windows_s, begins_ns)
    except PolicyError as error:
        return error
    return found[""]
