"""Measures the changes that the paper claims for its middleware.

The paper is the publication that fieldkit reproduces (cited in docs/index.md). It claims that an adaptive window is
better than a fixed one, and that masterless communication is better than communication through a ROS master. Both
claims are examined by simulations of the rows of its tables 1 and 3, with the same seeds. The measures are the change
of the mean delay of packets that arrive, and the change of the share of packets that do not arrive.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from fieldkit.core.model import Scenario as Sight
from sim_backends.cosim.policies.window_policies import SlidingWindow
from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, jackknife, mean
from sim_backends.cosim.studies.paper_setups import Changes, FlowSample, Setup, master_based, masterless, only_flow
from sim_backends.cosim.studies.paper_tables import (
    CLAIMS,
    DISTANCES_M,
    FIXED,
    MASTER,
    PRINTED,
    Agreement,
    Printed,
    compare,
)

ADAPTIVE: Final = "adaptive"
"""The system of the paper, with a window that adapts; it is compared with `FIXED` and `MASTER`."""

ROWS: Final = tuple((sight, distance_m) for sight in Sight for distance_m in DISTANCES_M)
"""The sight conditions (with or without line of sight) and the distances at which each system is run."""

SIGHT_GROUPS: Final[Mapping[str, tuple[Sight, ...]]] = {
    "all": tuple(Sight),
    **{str(sight): (sight,) for sight in Sight},
}
"""The sight conditions that a claim covers, by name of the group."""


class Claim(NamedTuple):
    """The change from another system to the paper's system, in some rows.

    Attributes:
        compared_system: The system with which the paper's system is compared.
        sight_group: The sight conditions that the claim covers, as a key of `SIGHT_GROUPS`.
        quantity: `delay`, with a relative change, or `loss`, with a difference.
        claimed_change: The change that the paper states, or None if it does not state this change.
        change_in_tables: The change according to the tables of the paper; nan if the tables do not contain it.
        measured_change: The change in the simulations of this program, with its 95 % interval.
        rows: Number of rows that the change is based on. For a delay, packets must have arrived in both systems.
    """

    compared_system: str
    sight_group: str
    quantity: str
    claimed_change: Printed | None
    change_in_tables: float
    measured_change: IntervalEstimate
    rows: int

    @property
    def agreement(self) -> Agreement | None:
        """The relation of the measured change to the stated one; None if the paper does not state this change."""
        return None if self.claimed_change is None else compare(self.claimed_change, self.measured_change)


def claim_setups(changes: Changes) -> dict[str, Setup]:
    """Return the setups to run for the claims, by name.

    Args:
        changes: Values that replace values of the scenario file, by dotted key.

    Raises:
        ConfigurationError: The changes are invalid.
    """
    setups: dict[str, Setup] = {}
    for sight, distance_m in ROWS:
        adaptive = setups[_name(ADAPTIVE, sight, distance_m)] = masterless(sight, distance_m, changes)
        setups[_name(FIXED, sight, distance_m)] = Setup(adaptive.scenario, SlidingWindow.name)
        setups[_name(MASTER, sight, distance_m)] = master_based(sight, distance_m, "ros1", changes)
    return setups


def compute_claims(
    setups: Mapping[str, Setup], samples: Mapping[str, Sequence[Mapping[str, FlowSample]]]
) -> list[Claim]:
    """Return all claims.

    Args:
        setups: The result of `claim_setups`.
        samples: The result of `flow_samples` for these setups.
    """
    flows = {
        name: [flow_samples[only_flow(setup)] for flow_samples in samples[name]] for name, setup in setups.items()
    }
    all_claims: list[Claim] = []
    for compared_system in (FIXED, MASTER):
        for sight_group, sights in SIGHT_GROUPS.items():
            rows = [row for row in ROWS if row[0] in sights]
            adaptive_flows, other_system_flows = (
                [flows[_name(system, *row)] for row in rows] for system in (ADAPTIVE, compared_system)
            )
            claimed_changes = CLAIMS.get((compared_system, sight_group), (None, None))
            changes_in_tables = (
                _changes_in_paper_tables(sights) if compared_system == MASTER else (math.nan, math.nan)
            )
            delay, delay_rows = delay_change(_delays_s(adaptive_flows), _delays_s(other_system_flows))
            loss = mean((_losses(adaptive_flows) - _losses(other_system_flows)).mean(axis=0))
            all_claims.append(
                Claim(
                    compared_system, sight_group, "delay", claimed_changes[0], changes_in_tables[0], delay, delay_rows
                )
            )
            all_claims.append(
                Claim(compared_system, sight_group, "loss", claimed_changes[1], changes_in_tables[1], loss, len(rows))
            )
    return all_claims


def delay_change(adaptive_s: Floats, other_s: Floats) -> tuple[IntervalEstimate, int]:
    """Return the relative change of delays, and the number of rows that it is based on.

    Each row compares the mean delays of the two systems over those seeds for which packets arrived in both. A row is
    omitted if there are fewer than two such seeds, or none if there is only one seed. The total change is the
    geometric mean over the rows, so that each row has the same weight; it is nan if all rows are omitted. The
    interval is computed for the logarithm of the change.

    Args:
        adaptive_s: Mean delay of a packet in the paper's system, shape (rows, seeds); nan if none arrived.
        other_s: Mean delay of a packet in the compared system, with the same shape.
    """
    arrived_in_both = np.isfinite(adaptive_s) & np.isfinite(other_s)
    seeds = adaptive_s.shape[1]
    used_rows = arrived_in_both.sum(axis=1) >= min(2, seeds)
    if not used_rows.any():
        return IntervalEstimate(math.nan, math.nan, math.nan), 0
    adaptive_s, other_s = (
        np.where(arrived_in_both, values_s, np.nan)[used_rows] for values_s in (adaptive_s, other_s)
    )

    def log_change(columns: Sequence[int]) -> float:
        ratios = np.nanmean(adaptive_s[:, columns], axis=1) / np.nanmean(other_s[:, columns], axis=1)
        return float(np.log(ratios).mean())

    all_seeds = range(seeds)
    leave_one_out = (
        [log_change([*all_seeds[:seed], *all_seeds[seed + 1 :]]) for seed in all_seeds] if seeds > 1 else []
    )
    estimate = jackknife(log_change(all_seeds), np.array(leave_one_out))
    change = IntervalEstimate(*(math.expm1(number) for number in (estimate.value, estimate.low, estimate.high)))
    return change, int(used_rows.sum())


def _changes_in_paper_tables(sights: Sequence[Sight]) -> tuple[float, float]:
    """Return the changes of delay and loss from the paper's table 3, with TCP, to its table 1."""
    adaptive_columns, other_columns = (
        [PRINTED["1"][sight, "topic"] for sight in sights],
        [PRINTED["3"][sight, "ros1"] for sight in sights],
    )
    delay, _ = delay_change(
        *(_printed_numbers([columns.delays_s for columns in system]) for system in (adaptive_columns, other_columns))
    )
    losses = (
        _printed_numbers([columns.losses for columns in system]) for system in (adaptive_columns, other_columns)
    )
    return delay.value, float(np.subtract(*losses).mean())


def _printed_numbers(columns: Sequence[Sequence[Printed]]) -> Floats:
    """Return printed numbers in the form of the results of one seed, shape (rows, 1)."""
    return np.array([[number.value] for column in columns for number in column], np.float64)


def _delays_s(rows: Sequence[Sequence[FlowSample]]) -> Floats:
    return np.array([[sample.delay_mean_s for sample in row] for row in rows], np.float64)


def _losses(rows: Sequence[Sequence[FlowSample]]) -> Floats:
    return np.array([[sample.loss for sample in row] for row in rows], np.float64)


def _name(system: str, sight: Sight, distance_m: int) -> str:
    return f"{system}, {sight} {distance_m} m"
