"""Local errors: what one window of a method does wrong that begins in the exact reference's own state.

As with solvers of differential equations: the reference goes on exactly; at many times a fork of it takes one window
by the method and goes on exactly from there. What then differs from the reference is that window's own doing, and not
the heritage of windows before. Halve the window, and the errors shrink by its order.

A window is charged with the packets that it touches: those that in the reference were sent, or arrived, within it.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.errors import FieldkitError
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.geometry import displaced_m
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.run import Fate, Run
from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, jackknife
from sim_backends.radio.random_streams import PacketIdentity
from sim_backends.world.motion import State

MEASURES: Final = ("delivery_s", "late_s", "position_m", "fates", "path_m")
"""Delivery-time error; by how much receivers had passed an arrival; how far off the network took sender and receiver
to be from each other; share of packets with another fate; how far off agents are at the window's end."""

TAIL_NS: Final = 200_000_000
"""How long forks go on behind the window, so that the fates of what it touched are known."""
_LONGEST_NS: Final = 3_600_000_000_000
"""No window is as long, where anything still happens."""


@dataclass(frozen=True)
class LocalErrors:
    """Local errors of one method, for several parameters of it, over windows that begin at the same times.

    Attributes:
        window_s: Lengths of the windows, shape (parameters, begins).
        sums: Of each of `MEASURES`, the sum over what each window touched, same shape.
        counts: How many packets, or agents, these are.
    """

    window_s: Floats
    sums: Mapping[str, Floats]
    counts: Mapping[str, Floats]

    def mean(self, measure: str) -> Floats:
        """Return the mean error for each parameter; nan where nothing was touched."""
        sums, counts = self.sums[measure].sum(axis=1), self.counts[measure].sum(axis=1)
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

    def order(self, measure: str) -> IntervalEstimate:
        """Return by which power of the window an error shrinks: the slope on logarithmic axes, with its interval.

        The interval is over the times at which windows began; nan where no error was seen for two lengths.
        """
        sums, counts = self.sums[measure], self.counts[measure]
        value = _slope(self.window_s.mean(axis=1), sums.sum(axis=1), counts.sum(axis=1))
        begins = range(sums.shape[1])
        without = [
            _slope(*(np.delete(of, one, axis=1).sum(axis=1) for of in (self.window_s, sums, counts)))
            for one in begins
        ]
        return jackknife(value, np.array(without))


def pooled(several: Iterable[LocalErrors]) -> LocalErrors:
    """Return the local errors of one method over the windows of several runs, for example of several seeds."""
    all_of = list(several)
    return LocalErrors(
        np.concatenate([one.window_s for one in all_of], axis=1),
        {measure: np.concatenate([one.sums[measure] for one in all_of], axis=1) for measure in MEASURES},
        {measure: np.concatenate([one.counts[measure] for one in all_of], axis=1) for measure in MEASURES},
    )


def local_errors(
    make: Callable[[SyncPolicy], Coordinator],
    methods: Mapping[str, Callable[[float], SyncPolicy]],
    parameters: Sequence[float],
    begins_ns: Sequence[int],
    tail_ns: int = TAIL_NS,
) -> dict[str, LocalErrors]:
    """Return the local errors of each method.

    Args:
        make: Builds the co-simulation of one scenario and seed.
        methods: Make a policy from a parameter, the length of a window in seconds or what stands for it.
        parameters: These.
        begins_ns: When windows begin, in rising order; whole steps of the physics.
        tail_ns: How long forks go on behind the window; a packet whose fate is still unknown then does not count.

    Raises:
        PolicyError: A method has no window for a situation.
        FieldkitError: A fork changed what it was forked from: something in the scenario cannot be copied.
    """
    shape = len(parameters), len(begins_ns)
    found = {
        name: LocalErrors(
            np.zeros(shape), *({measure: np.zeros(shape) for measure in MEASURES} for _ in ("sums", "counts"))
        )
        for name in methods
    }
    reference = make(EventDriven())
    for column, begin_ns in enumerate(begins_ns):
        _forget(reference.advance(begin_ns))
        exact: dict[int, _Behind] = {}
        for name, method in methods.items():
            for row, parameter in enumerate(parameters):
                fork = reference.fork()
                fork.policy = method(parameter)
                end_ns = fork.advance(begin_ns + _LONGEST_NS, most_windows=1).windows_ns[-1]
                if end_ns == begin_ns + _LONGEST_NS:
                    continue  # nothing will ever happen
                if end_ns not in exact:
                    exactly = reference.fork()
                    exactly.advance(end_ns)
                    exact[end_ns] = _behind(exactly, end_ns, tail_ns)
                tried = _behind(fork, end_ns, tail_ns)
                found[name].window_s[row, column] = (end_ns - begin_ns) / 1e9
                for measure, values in _differences(begin_ns, end_ns, exact[end_ns], tried).items():
                    found[name].sums[measure][row, column] = sum(values)
                    found[name].counts[measure][row, column] = len(values)
    _check_untouched(make, begins_ns, reference)
    return found


def spread_over(begin_ns: int, end_ns: int, count: int, step_ns: int) -> list[int]:
    """Return times at whole steps, spread evenly, whose place within any period is as good as random.

    They are multiples of the golden ratio modulo 1, the sequence of lowest discrepancy in one dimension.
    """
    golden = (5**0.5 - 1) / 2
    times_ns = {round((begin_ns + (end_ns - begin_ns) * (golden * k % 1)) / step_ns) * step_ns for k in range(count)}
    return sorted(times_ns)


@dataclass(frozen=True)
class _Behind:
    """What is known behind a window: the fates of packets, and where agents were at its end."""

    fates: Mapping[PacketIdentity, Fate]
    states: Mapping[str, State]


def _behind(fork: Coordinator, end_ns: int, tail_ns: int) -> _Behind:
    """Let a fork that has come to the end of a window go on exactly."""
    states = fork.situation.states
    fork.policy = EventDriven()
    return _Behind(fork.advance(end_ns + tail_ns).fates, states)


def _differences(begin_ns: int, end_ns: int, exact: _Behind, tried: _Behind) -> dict[str, list[float]]:
    """Return each error of a window, for all that it touched."""
    found: dict[str, list[float]] = {measure: [] for measure in MEASURES}
    for identity, fate in exact.fates.items():
        other = tried.fates.get(identity)
        sent = begin_ns < fate.packet.sent_ns <= end_ns
        arrived = fate.arrived_ns is not None and begin_ns < fate.arrived_ns <= end_ns
        if not (sent or arrived) or other is None or not (fate.is_known and other.is_known):
            continue
        if sent:
            found["position_m"].append(displaced_m(other))
        found["fates"].append(float(bool(fate.reason) != bool(other.reason)))
        if fate.counted_ns is not None and other.counted_ns is not None:
            found["delivery_s"].append(abs(fate.counted_ns - other.counted_ns) / 1e9)
            found["late_s"].append(other.late_ns / 1e9)
    found["path_m"] = [
        math.dist(state.position_m, tried.states[name].position_m) for name, state in exact.states.items()
    ]
    return found


def _slope(window_s: Floats, sums: Floats, counts: Floats) -> float:
    """Return the slope of mean errors over windows on logarithmic axes, by least squares."""
    seen = sums > 0
    if np.count_nonzero(seen) < 2:
        return math.nan
    return float(np.polyfit(np.log(window_s[seen]), np.log(sums[seen] / counts[seen]), 1)[0])


def _forget(run: Run) -> None:
    """Let forks be copied without the packets whose fate is known already."""
    for identity in [identity for identity, fate in run.fates.items() if fate.is_known]:
        del run.fates[identity]
    run.windows_ns.clear()


def _check_untouched(
    make: Callable[[SyncPolicy], Coordinator], begins_ns: Sequence[int], reference: Coordinator
) -> None:
    alone = make(EventDriven())
    for begin_ns in begins_ns:
        _forget(alone.advance(begin_ns))
    if alone.run.digest != reference.run.digest:
        raise FieldkitError(
            "a fork changed the run that it was forked from, so its errors are not its own",
            remedy="let federates and programs keep nothing that their copies share (copy.deepcopy), nor closures",
        )
