"""Errors of a run against the exact reference of the same scenario, packet by packet (the coupled errors)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from sim_backends.cosim.geometry import displaced_m
from sim_backends.cosim.run import Run
from sim_backends.radio.random_streams import PacketIdentity

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spread:
    """A distribution in three numbers; nan where there is nothing.

    Attributes:
        mean: Its mean.
        p95: Its 95th percentile.
        largest: Its maximum.
    """

    mean: float
    p95: float
    largest: float


@dataclass(frozen=True)
class Errors:
    """How wrong a run is, and what it cost. Where no packet tells, values are nan.

    Attributes:
        packets: Packets whose fate is known in both runs.
        delivery_error_s: Magnitude of the difference of delivery times, over packets that arrived in both.
        position_error_m: By how much the network was wrong, when a packet was sent, about where two of the agents
            that transmit, forward or interfere were to each other in the same run, the largest; of the continuous
            trajectories, so that states which are held for a step h count with v h / 2.
        path_error_m: How far off agents are, over time; above 0 only where their programs steer by what they receive.
        fate_disagreement: Share of packets that arrived in one run and not in the other.
        first_disagreement: The packet that was sent first of these; None for none.
        first_disagreement_s: When it was sent; nan for none.
        causality_violations: Arrivals that their receiver had passed already.
        late_s: By how much, over all arrivals.
        delay_added_s: Mean of what the policy added to a delay: before the network got a packet, and after it
            had delivered it.
        exchanges_per_s: Windows per simulated second.
        wall_s: Wall time by part.
        real_time_factor: Simulated time over wall time.
    """

    packets: int
    delivery_error_s: Spread
    position_error_m: Spread
    path_error_m: Spread
    fate_disagreement: float
    first_disagreement: PacketIdentity | None
    first_disagreement_s: float
    causality_violations: float
    late_s: Spread
    delay_added_s: float
    exchanges_per_s: float
    wall_s: dict[str, float]
    real_time_factor: float


def errors(reference: Run, run: Run, apart_m: Floats | None = None) -> Errors:
    """Return how a run differs from the exact reference.

    Args:
        reference: Of an exact policy.
        run: Of the same scenario and seed, as far as the reference goes.
        apart_m: How far each agent is off, at equal times of both runs, any shape; None where nobody looked.
    """
    both = [(fate, run.fates[identity]) for identity, fate in reference.fates.items() if identity in run.fates]
    known = [(one, other) for one, other in both if one.is_known and other.is_known]
    differing = [one.packet for one, other in known if bool(one.reason) != bool(other.reason)]
    arrived = [
        (one.counted_ns, other.counted_ns)
        for one, other in known
        if one.counted_ns is not None and other.counted_ns is not None
    ]
    late_ns = [fate.late_ns for fate in run.fates.values() if fate.arrived_ns is not None]
    simulated_s = run.windows_ns[-1] / 1e9 if run.windows_ns else math.nan
    first = min(differing, key=lambda packet: packet.sent_ns, default=None)
    return Errors(
        packets=len(known),
        delivery_error_s=_spread([abs(one - other) / 1e9 for one, other in arrived]),
        position_error_m=_spread([displaced_m(fate) for fate in run.fates.values()]),
        path_error_m=_spread([] if apart_m is None else apart_m.ravel()),
        fate_disagreement=len(differing) / len(known) if known else math.nan,
        first_disagreement=None if first is None else first.identity,
        first_disagreement_s=math.nan if first is None else first.sent_ns / 1e9,
        causality_violations=sum(one > 0 for one in late_ns),
        late_s=_spread([one / 1e9 for one in late_ns]),
        delay_added_s=delay_added_s(run),
        exchanges_per_s=len(run.windows_ns) / simulated_s,
        wall_s=dict(run.wall_s),
        real_time_factor=simulated_s / (sum(run.wall_s.values()) or math.nan),
    )


def mean_errors(several: Sequence[Errors]) -> Errors:
    """Return the errors of several runs, for example of all seeds, in one.

    Numbers are means over the runs in which they are known, but of maxima the largest, and of first disagreements the
    earliest.

    Args:
        several: The errors of each, at least one.
    """
    first = min(several, key=lambda one: (math.isnan(one.first_disagreement_s), one.first_disagreement_s))

    def mean(value: Callable[[Errors], float]) -> float:
        values = [number for one in several if not math.isnan(number := value(one))]
        return math.fsum(values) / len(values) if values else math.nan

    def spread(of: str) -> Spread:
        largest = [number for one in several if not math.isnan(number := getattr(one, of).largest)]
        return Spread(
            mean(lambda one: getattr(one, of).mean),
            mean(lambda one: getattr(one, of).p95),
            max(largest, default=math.nan),
        )

    spreads = {one.name: spread(one.name) for one in fields(Errors) if one.type is Spread}
    return Errors(
        packets=sum(one.packets for one in several),
        **spreads,
        fate_disagreement=mean(lambda one: one.fate_disagreement),
        first_disagreement=first.first_disagreement,
        first_disagreement_s=first.first_disagreement_s,
        causality_violations=mean(lambda one: one.causality_violations),
        delay_added_s=mean(lambda one: one.delay_added_s),
        exchanges_per_s=mean(lambda one: one.exchanges_per_s),
        wall_s={part: math.fsum(one.wall_s[part] for one in several) / len(several) for part in several[0].wall_s},
        real_time_factor=mean(lambda one: one.real_time_factor),
    )


def delay_added_s(run: Run) -> float:
    """Return what the policy added to a delay, before the network got a packet and behind it, mean; nan for none."""
    added_ns = [
        fate.packet.enters_ns - fate.packet.sent_ns + fate.counted_ns - fate.arrived_ns
        for fate in run.fates.values()
        if fate.arrived_ns is not None and fate.counted_ns is not None
    ]
    return float(np.mean(added_ns)) / 1e9 if added_ns else math.nan


def lost_share(run: Run) -> float:
    """Return the share of packets lost, of those whose fate is known; nan for none."""
    known = [bool(fate.reason) for fate in run.fates.values() if fate.is_known]
    return sum(known) / len(known) if known else math.nan


def _spread(values: Sequence[float] | Floats) -> Spread:
    if not len(values):
        return Spread(math.nan, math.nan, math.nan)
    array = np.asarray(values, dtype=np.float64)
    return Spread(float(array.mean()), float(np.quantile(array, 0.95)), float(array.max()))
