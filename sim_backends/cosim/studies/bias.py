"""Errors in distribution: the difference of losses, delays and distances from the reference, over seeds.

With chaotic contention and rate selection, two runs differ packet by packet although neither is wrong. What must
agree are the results that a study would publish: shares and means over seeds. Each run is paired with the reference
of the same seed, which cancels the variation between seeds.
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
    """Return the mean delay of packets that arrived, as their receivers count it; nan if none arrived."""
    delays_ns = [
        fate.counted_ns - fate.packet.sent_ns for fate in outcome.run.fates.values() if fate.counted_ns is not None
    ]
    return sum(delays_ns) / len(delays_ns) / 1e9 if delays_ns else math.nan


def mean_separation_m(outcome: RunOutcome) -> float:
    """Return the mean distance between agents over time and all pairs; nan for a single agent."""
    places_m = outcome.tracks.places_m
    first, second = np.triu_indices(places_m.shape[1], k=1)
    if not len(first):
        return math.nan
    return float(np.linalg.norm(places_m[:, first] - places_m[:, second], axis=2).mean())


MEASURES: Final[Mapping[str, Callable[[RunOutcome], float]]] = {
    "loss": lambda outcome: lost_share(outcome.run),
    "delay_s": delay_s,
    "apart_m": mean_separation_m,
}
"""The compared measures, by name."""


@dataclass(frozen=True)
class Bias:
    """The bias of one measure with one policy, over seeds.

    Attributes:
        values: The measure for each seed, in order; nan if a run has none.
        mean: Their mean.
        bias: Mean of the differences from the reference with the same seed.
        deviation: Standard deviation of these differences.
        seeds_needed: Number of seeds needed to detect the bias; None if the bias is 0 or unknown.
    """

    values: Floats
    mean: IntervalEstimate
    bias: IntervalEstimate
    deviation: float
    seeds_needed: int | None


def biases(outcomes: Outcomes) -> dict[str, dict[str, Bias]]:
    """Return the bias of each measure for each policy that could be run with all seeds."""
    complete = [name for name, runs in outcomes.runs.items() if len(runs) == len(outcomes.seeds)]
    return {
        policy: {name: _bias(outcomes, policy, measure) for name, measure in MEASURES.items()} for policy in complete
    }


def _bias(outcomes: Outcomes, policy: str, measure: Callable[[RunOutcome], float]) -> Bias:
    values = np.array([measure(outcomes.runs[policy][seed]) for seed in outcomes.seeds])
    differences = values - np.array([measure(outcomes.reference[seed]) for seed in outcomes.seeds])
    finite = differences[np.isfinite(differences)]
    bias = mean(finite)
    deviation = float(finite.std(ddof=1)) if len(finite) > 1 else math.nan
    needed = None if math.isnan(deviation) else repeats_needed(bias.value, deviation)
    return Bias(values, mean(values[np.isfinite(values)]), bias, deviation, needed)
