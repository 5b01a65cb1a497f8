"""Compares a run, packet by packet, with the exact reference.

The exact reference is a run of the same scenario and seed with the policy `event_driven`, which exchanges all data
without delay.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from sim_backends.cosim.packet_ledger import position_error_m
from sim_backends.cosim.run_record import Run
from sim_backends.radio.core.random_streams import PacketIdentity

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spread:
    """A distribution as three numbers; all are nan for an empty sample.

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
    """The errors and the cost of a run. A value for which there are no packets is nan.

    Attributes:
        packets: Number of packets whose fate (arrived or dropped) is decided in both runs.
        delivery_error_s: Absolute difference of delivery times, over packets that arrived in both runs.
        position_error_m: Error of the positions that the network assumed when a packet was sent: the largest
            error, over all pairs of agents that transmit, forward or interfere in this run, of the relative position.
            The true positions are the positions on the continuous trajectories. If the network uses the same
            state for a step of length h, its mean error at speed v is therefore v h / 2.
        path_error_m: Distance of agents from their positions in the reference, over time; above 0 only if programs
            steer by received data.
        fate_disagreement: Share of these `packets` that arrived in one run only.
        first_disagreement: The first of these packets by time of sending, or None.
        first_disagreement_s: Time when that packet was sent, or nan.
        causality_violations: Number of arrivals at a time that was already in the past of the receiver.
        late_s: For all arrivals: time from the arrival to the receiver's simulated time, if that is later; else 0.
        delay_added_s: Mean delay that the policy added, before a packet entered the network and after its delivery.
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


def compare_runs(reference: Run, run: Run, path_errors_m: Floats | None = None) -> Errors:
    """Return the errors of a run relative to the exact reference.

    Args:
        reference: The run by an exact policy.
        run: A run of the same scenario and seed, of the same duration.
        path_errors_m: Distance of each agent from its position in the reference, at equal times, any shape, nan if it
            was absent; None if positions were not sampled.
    """
    fate_pairs = [(fate, run.fates[identity]) for identity, fate in reference.fates.items() if identity in run.fates]
    decided_pairs = [
        (reference_fate, fate) for reference_fate, fate in fate_pairs if reference_fate.is_decided and fate.is_decided
    ]
    differing_packets = [
        reference_fate.packet
        for reference_fate, fate in decided_pairs
        if bool(reference_fate.reason) != bool(fate.reason)
    ]
    counted_ns = [
        (reference_fate.counted_ns, fate.counted_ns)
        for reference_fate, fate in decided_pairs
        if reference_fate.counted_ns is not None and fate.counted_ns is not None
    ]
    late_ns = [fate.late_ns for fate in run.fates.values() if fate.arrived_ns is not None]
    simulated_s = run.windows_ns[-1] / 1e9 if run.windows_ns else math.nan
    first = min(differing_packets, key=lambda packet: packet.sent_ns, default=None)
    return Errors(
        packets=len(decided_pairs),
        delivery_error_s=_spread([abs(expected_ns - actual_ns) / 1e9 for expected_ns, actual_ns in counted_ns]),
        position_error_m=_spread([position_error_m(fate) for fate in run.fates.values()]),
        path_error_m=_spread([] if path_errors_m is None else path_errors_m[~np.isnan(path_errors_m)]),
        fate_disagreement=len(differing_packets) / len(decided_pairs) if decided_pairs else math.nan,
        first_disagreement=None if first is None else first.identity,
        first_disagreement_s=math.nan if first is None else first.sent_ns / 1e9,
        causality_violations=sum(time_ns > 0 for time_ns in late_ns),
        late_s=_spread([time_ns / 1e9 for time_ns in late_ns]),
        delay_added_s=delay_added_s(run),
        exchanges_per_s=len(run.windows_ns) / simulated_s,
        wall_s=dict(run.wall_s),
        real_time_factor=simulated_s / (sum(run.wall_s.values()) or math.nan),
    )


def mean_errors(all_errors: Sequence[Errors]) -> Errors:
    """Return the combined errors of several runs, for example of all seeds.

    Numbers are means over the runs that have them, with three exceptions: `packets` is a sum, a maximum is the
    largest of all runs, and the first disagreement is the earliest of all runs.

    Args:
        all_errors: The errors of each run, at least one.
    """
    first = min(all_errors, key=lambda errors: (math.isnan(errors.first_disagreement_s), errors.first_disagreement_s))

    def mean(value: Callable[[Errors], float]) -> float:
        values = [number for errors in all_errors if not math.isnan(number := value(errors))]
        return math.fsum(values) / len(values) if values else math.nan

    def spread(name: str) -> Spread:
        maxima = [number for errors in all_errors if not math.isnan(number := getattr(errors, name).largest)]
        return Spread(
            mean(lambda errors: getattr(errors, name).mean),
            mean(lambda errors: getattr(errors, name).p95),
            max(maxima, default=math.nan),
        )

    spreads = {field.name: spread(field.name) for field in fields(Errors) if field.type is Spread}
    return Errors(
        packets=sum(errors.packets for errors in all_errors),
        **spreads,
        fate_disagreement=mean(lambda errors: errors.fate_disagreement),
        first_disagreement=first.first_disagreement,
        first_disagreement_s=first.first_disagreement_s,
        causality_violations=mean(lambda errors: errors.causality_violations),
        delay_added_s=mean(lambda errors: errors.delay_added_s),
        exchanges_per_s=mean(lambda errors: errors.exchanges_per_s),
        wall_s={
            part: math.fsum(errors.wall_s[part] for errors in all_errors) / len(all_errors)
            for part in all_errors[0].wall_s
        },
        real_time_factor=mean(lambda errors: errors.real_time_factor),
    )


def delay_added_s(run: Run) -> float:
    """Return the mean delay that the policy added before and after the network; nan if no packet arrived."""
    added_ns = [
        fate.packet.enters_ns - fate.packet.sent_ns + fate.counted_ns - fate.arrived_ns
        for fate in run.fates.values()
        if fate.arrived_ns is not None and fate.counted_ns is not None
    ]
    return float(np.mean(added_ns)) / 1e9 if added_ns else math.nan


def lost_share(run: Run) -> float:
    """Return the share of lost packets among the packets whose fate is decided; nan without such packets."""
    losses = [bool(fate.reason) for fate in run.fates.values() if fate.is_decided]
    return sum(losses) / len(losses) if losses else math.nan


def _spread(values: Sequence[float] | Floats) -> Spread:
    if not len(values):
        return Spread(math.nan, math.nan, math.nan)
    array = np.asarray(values, dtype=np.float64)
    return Spread(float(array.mean()), float(np.quantile(array, 0.95)), float(array.max()))
