"""Local errors: the errors of a sync policy in single windows that start from the state of the exact reference.

They are measured as for solvers of differential equations. The reference runs exactly. At many times, a fork (a copy)
of the reference runs one window with the policy and then continues exactly. Differences from the reference are then
caused by that window only, and not by earlier windows. If the window is halved, the errors decrease according to the
order of the policy: with order n, to a share of 1/2^n.

A window affects the packets that, in the reference, were sent or arrived within it.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.errors import FieldkitError
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.packet_ledger import position_error_m
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.run_record import Fate, Run
from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, jackknife
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.world.motion import State

MEASURES: Final = ("delivery_s", "late_s", "position_m", "fates", "path_m")
"""The measured errors.

- `delivery_s`: error of the delivery time.
- `late_s`: time by which an arrival was in the receiver's past.
- `position_m`: largest error of the relative positions that the network assumed for a packet (`Fate`).
- `fates`: share of packets that arrived either in the fork or in the reference, but not in both.
- `path_m`: position error of agents at the end of the window.
"""

TAIL_NS: Final = 200_000_000
"""Time for which forks continue after the window, so that the fates of the affected packets are decided."""
_LONGEST_NS: Final = 3_600_000_000_000
"""A time that is longer than any window that ends with an event."""


@dataclass(frozen=True)
class LocalErrors:
    """Local errors of one policy for several parameters, over windows that begin at the same times.

    Attributes:
        window_s: Lengths of the windows, shape (parameters, times at which windows begin); 0 for a window that no
            event ended.
        sums: For each of `MEASURES`, the sum over the affected packets or agents, same shape.
        counts: The number of these packets or agents, same shape.
    """

    window_s: Floats
    sums: Mapping[str, Floats]
    counts: Mapping[str, Floats]

    def mean(self, measure: str) -> Floats:
        """Return the mean error for each parameter; nan if the windows affected no packet or agent."""
        sums, counts = self.sums[measure].sum(axis=1), self.counts[measure].sum(axis=1)
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

    def order(self, measure: str) -> IntervalEstimate:
        """Return the order of an error: the exponent n if the error is proportional to the n-th power of the window.

        It is the slope of a line that is fitted to the mean errors on logarithmic axes. Its interval is a jackknife
        interval over the times at which windows begin. The result is nan if fewer than two lengths had an error.
        """
        sums, counts = self.sums[measure], self.counts[measure]
        value = _slope(self.window_s.mean(axis=1), sums.sum(axis=1), counts.sum(axis=1))
        begin_indices = range(sums.shape[1])
        leave_one_out = [
            _slope(*(np.delete(values, begin, axis=1).sum(axis=1) for values in (self.window_s, sums, counts)))
            for begin in begin_indices
        ]
        return jackknife(value, np.array(leave_one_out))


def pool(errors_by_run: Iterable[LocalErrors]) -> LocalErrors:
    """Return the local errors of one policy over the windows of several runs, for example of several seeds."""
    runs = list(errors_by_run)
    return LocalErrors(
        np.concatenate([run.window_s for run in runs], axis=1),
        {measure: np.concatenate([run.sums[measure] for run in runs], axis=1) for measure in MEASURES},
        {measure: np.concatenate([run.counts[measure] for run in runs], axis=1) for measure in MEASURES},
    )


def local_errors(
    make_coordinator: Callable[[SyncPolicy], Coordinator],
    policies: Mapping[str, Callable[[float], SyncPolicy]],
    parameters: Sequence[float],
    starts_ns: Sequence[int],
    tail_ns: int = TAIL_NS,
) -> dict[str, LocalErrors]:
    """Return the local errors of each policy.

    Args:
        make_coordinator: Builds the co-simulation of one scenario and seed.
        policies: Functions that return a policy for a parameter: the length of a window in seconds, or its
            equivalent.
        parameters: The parameters.
        starts_ns: Start times of windows, ascending; whole physics steps.
        tail_ns: Time for which forks continue after the window; packets whose fate is undecided then are ignored.

    Raises:
        PolicyError: A policy cannot determine a window.
        FieldkitError: A fork changed the run from which it was forked, because an object was not copied.
    """
    shape = len(parameters), len(starts_ns)

    def zeros() -> dict[str, Floats]:
        return {measure: np.zeros(shape) for measure in MEASURES}

    results = {name: LocalErrors(np.zeros(shape), zeros(), zeros()) for name in policies}
    reference = make_coordinator(EventDriven())
    for column, start_ns in enumerate(starts_ns):
        _delete_decided(reference.advance(start_ns))
        exact_by_end: dict[int, _Outcome] = {}
        for name, make_policy in policies.items():
            for row, parameter in enumerate(parameters):
                fork = reference.fork()
                fork.policy = make_policy(parameter)
                end_ns = fork.advance(start_ns + _LONGEST_NS, max_windows=1).windows_ns[-1]
                if end_ns == start_ns + _LONGEST_NS:
                    continue  # there are no more events
                if end_ns not in exact_by_end:
                    exact_fork = reference.fork()
                    exact_fork.advance(end_ns)
                    exact_by_end[end_ns] = _run_to_outcome(exact_fork, end_ns, tail_ns)
                actual = _run_to_outcome(fork, end_ns, tail_ns)
                results[name].window_s[row, column] = (end_ns - start_ns) / 1e9
                for measure, values in _differences(start_ns, end_ns, exact_by_end[end_ns], actual).items():
                    results[name].sums[measure][row, column] = sum(values)
                    results[name].counts[measure][row, column] = len(values)
    _check_unchanged(make_coordinator, starts_ns, reference)
    return results


def low_discrepancy_times_ns(start_ns: int, end_ns: int, count: int, step_ns: int) -> list[int]:
    """Return up to `count` evenly distributed times at whole steps; their phases within any period are nearly random.

    Before they are rounded to steps, they are multiples of the golden ratio modulo 1, as shares of the interval. This
    is the sequence of lowest discrepancy in one dimension.
    """
    golden = (5**0.5 - 1) / 2
    times_ns = {round((start_ns + (end_ns - start_ns) * (golden * k % 1)) / step_ns) * step_ns for k in range(count)}
    return sorted(times_ns)


@dataclass(frozen=True)
class _Outcome:
    """The fates of packets some time after a window, and the states of the agents at its end."""

    fates: Mapping[PacketIdentity, Fate]
    states: Mapping[str, State]


def _run_to_outcome(fork: Coordinator, end_ns: int, tail_ns: int) -> _Outcome:
    """Continue a fork, which has reached the end of a window, with the exact policy, and return its outcome."""
    states = fork.situation.states
    fork.policy = EventDriven()
    return _Outcome(fork.advance(end_ns + tail_ns).fates, states)


def _differences(start_ns: int, end_ns: int, exact: _Outcome, actual: _Outcome) -> dict[str, list[float]]:
    """Return each error of a window for all packets and agents that it affected."""
    differences: dict[str, list[float]] = {measure: [] for measure in MEASURES}
    for identity, fate in exact.fates.items():
        actual_fate = actual.fates.get(identity)
        was_sent_in_window = start_ns < fate.packet.sent_ns <= end_ns
        arrived_in_window = fate.arrived_ns is not None and start_ns < fate.arrived_ns <= end_ns
        if (
            not (was_sent_in_window or arrived_in_window)
            or actual_fate is None
            or not (fate.is_decided and actual_fate.is_decided)
        ):
            continue
        if was_sent_in_window:
            differences["position_m"].append(position_error_m(actual_fate))
        differences["fates"].append(float(bool(fate.reason) != bool(actual_fate.reason)))
        if fate.counted_ns is not None and actual_fate.counted_ns is not None:
            differences["delivery_s"].append(abs(fate.counted_ns - actual_fate.counted_ns) / 1e9)
            differences["late_s"].append(actual_fate.late_ns / 1e9)
    differences["path_m"] = [
        math.dist(state.position_m, actual.states[name].position_m)
        for name, state in exact.states.items()
        if name in actual.states
    ]
    return differences


def _slope(window_s: Floats, sums: Floats, counts: Floats) -> float:
    """Return the slope of mean errors over windows on logarithmic axes, by least squares."""
    is_positive = sums > 0
    if np.count_nonzero(is_positive) < 2:
        return math.nan
    means = sums[is_positive] / counts[is_positive]
    return float(np.polyfit(np.log(window_s[is_positive]), np.log(means), 1)[0])


def _delete_decided(run: Run) -> None:
    """Delete the packets whose fate is decided, so that forks do not copy them."""
    for identity in [identity for identity, fate in run.fates.items() if fate.is_decided]:
        del run.fates[identity]
    run.windows_ns.clear()


def _check_unchanged(
    make_coordinator: Callable[[SyncPolicy], Coordinator], starts_ns: Sequence[int], reference: Coordinator
) -> None:
    """Check that no fork has changed the reference, by comparison with a run that was not forked."""
    without_forks = make_coordinator(EventDriven())
    for start_ns in starts_ns:
        _delete_decided(without_forks.advance(start_ns))
    if without_forks.run.digest != reference.run.digest:
        raise FieldkitError(
            "a fork changed the run from which it was forked, so the measured errors are wrong",
            remedy="make all data of federates and programs copyable by copy.deepcopy, and use no closures",
        )
