"""Errors of a run against the exact reference of the same scenario, packet by packet (the coupled errors)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backends.cosim.run import Fate, Run
from sim_backends.radio.random_streams import PacketIdentity


@dataclass(frozen=True)
class Spread:
    """A distribution in three numbers.

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
        position_error_m: How far off the network took the sender to be from the receiver, beside where it was in the
            same run when it sent; the distance between the two is off by no more.
        fate_disagreement: Share of packets that arrived in one run and not in the other.
        first_disagreement: The packet that was sent first of these; None for none.
        causality_violations: Arrivals that their receiver had passed already.
        delay_added_s: Mean of what the policy added to a delay: before the network got a packet, and after it
            had delivered it.
        exchanges_per_s: Windows per simulated second.
        wall_s: Wall time by part.
        real_time_factor: Simulated time over wall time.
    """

    packets: int
    delivery_error_s: Spread
    position_error_m: Spread
    fate_disagreement: float
    first_disagreement: PacketIdentity | None
    causality_violations: int
    delay_added_s: float
    exchanges_per_s: float
    wall_s: dict[str, float]
    real_time_factor: float


def errors(reference: Run, run: Run) -> Errors:
    """Return how a run differs from the exact reference.

    Args:
        reference: Of an exact policy.
        run: Of the same scenario and seed, as far as the reference goes.
    """
    both = [(fate, run.fates[identity]) for identity, fate in reference.fates.items() if identity in run.fates]
    known = [(one, other) for one, other in both if one.is_known and other.is_known]
    differing = [one.packet for one, other in known if bool(one.reason) != bool(other.reason)]
    arrived = [
        (one.counted_ns, other.counted_ns)
        for one, other in known
        if one.counted_ns is not None and other.counted_ns is not None
    ]
    added_ns = [
        fate.packet.enters_ns - fate.packet.sent_ns + fate.counted_ns - fate.arrived_ns
        for fate in run.fates.values()
        if fate.arrived_ns is not None and fate.counted_ns is not None
    ]
    simulated_s = run.windows_ns[-1] / 1e9 if run.windows_ns else math.nan
    first = min(differing, key=lambda packet: packet.sent_ns, default=None)
    return Errors(
        packets=len(known),
        delivery_error_s=_spread(np.array([abs(one - other) / 1e9 for one, other in arrived])),
        position_error_m=_spread(np.array([displaced_m(fate) for fate in run.fates.values()])),
        fate_disagreement=len(differing) / len(known) if known else math.nan,
        first_disagreement=None if first is None else first.identity,
        causality_violations=sum(fate.late_ns > 0 for fate in run.fates.values()),
        delay_added_s=float(np.mean(added_ns)) / 1e9 if added_ns else math.nan,
        exchanges_per_s=len(run.windows_ns) / simulated_s,
        wall_s=dict(run.wall_s),
        real_time_factor=simulated_s / (sum(run.wall_s.values()) or math.nan),
    )


def displaced_m(fate: Fate) -> float:
    """Return how far off the network took the sender to be from the receiver, beside where it was when it sent."""
    known, true = (
        tuple(one - other for one, other in zip(ends[0].position_m, ends[1].position_m, strict=True))
        for ends in (fate.known, fate.true)
    )
    return math.dist(known, true)


def _spread(values: NDArray[np.float64]) -> Spread:
    if not len(values):
        return Spread(math.nan, math.nan, math.nan)
    return Spread(float(values.mean()), float(np.quantile(values, 0.95)), float(values.max()))
