"""Errors in distribution: does a method give other losses, delays and distances than the reference, over seeds.

Where contention and rate choice are chaotic, two runs differ packet by packet though neither is wrong. What has to
agree is what a study would publish: shares and means over seeds. Each is paired by seed with the reference, so that
what seeds have in common drops out.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim_backends.cosim.comparison import lost_share
from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, mean, repeats_needed
from sim_backends.cosim.studies.outcomes import Outcomes, RunOutcome


def delay_s(outcome: RunOutcome) -> float:
    """Return the mean delay of packets that arrived, as their receivers count it; nan for none."""
    delays_ns = [
        fate.counted_ns - fate.packet.sent_ns for fate in outcome.run.fates.values() if fate.counted_ns is not None
    ]
    return sum(delays_ns) / len(delays_ns) / 1e9 if delays_ns else math.nan


def apart_m(outcome: RunOutcome) -> float:
    """Return how far agents are apart, in the mean over time and all pairs; nan for one alone."""
    places_m = outcome.tracks.places_m
    first, second = np.triu_indices(places_m.shape[1], k=1)
    if not len(first):
        return math.nan
    return float(np.linalg.norm(places_m[:, first] - places_m[:, second], axis=2).mean())


MEASURES: Final[Mapping[str, Callable[[RunOutcome], float]]] = {
    "loss": lambda outcome: lost_share(outcome.run),
    "delay_s": delay_s,
    "apart_m": apart_m,
}
"""What is compared, by name."""


@dataclass(frozen=True)
class Bias:
    """One measure by one policy, over seeds.

    Attributes:
        values: Of each seed, in their order; nan where the run has none.
        mean: Their mean.
        bias: Mean of the differences from the reference's with the same seed.
        deviation: Standard deviation of these differences.
        seeds_needed: How many seeds it takes to see the bias; None where none was seen.
    """

    values: Floats
    mean: IntervalEstimate
    bias: IntervalEstimate
    deviation: float
    seeds_needed: int | None


def biases(found: Outcomes) -> dict[str, dict[str, Bias]]:
    """Return the bias of each policy that could be run with all seeds, and of each measure."""
    complete = [name for name, runs in found.runs.items() if len(runs) == len(found.seeds)]
    return {
        policy: {name: _bias(found, policy, measure) for name, measure in MEASURES.items()} for policy in complete
    }


def _bias(found: Outcomes, policy: str, measure: Callable[[RunOutcome], float]) -> Bias:
    values = np.array([measure(found.runs[policy][seed]) for seed in found.seeds])
    differences = values - np.array([measure(found.reference[seed]) for seed in found.seeds])
    known = differences[np.isfinite(differences)]
    bias = mean(known)
    deviation = float(known.std(ddof=1)) if len(known) > 1 else math.nan
    needed = None if math.isnan(deviation) else repeats_needed(bias.value, deviation)
    return Bias(values, mean(values[np.isfinite(values)]), bias, deviation, needed)
