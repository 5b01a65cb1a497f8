"""The paper's claims about its middleware: an adaptive window against a fixed one, masterless against master-based.

Both claims are measured in the rows of its tables 1 and 3, with the same seeds. The measures are the change of the
mean delay of packets that arrive, and the change of the share of packets that do not arrive.
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
    agreement,
)

ADAPTIVE: Final = "adaptive"
"""The paper's own system, which is compared with `FIXED` and `MASTER`."""

ROWS: Final = tuple((line, distance_m) for line in Sight for distance_m in DISTANCES_M)
"""The lines and distances at which each system is run."""

LINES: Final[Mapping[str, tuple[Sight, ...]]] = {"all": tuple(Sight), **{str(line): (line,) for line in Sight}}
"""The lines to which a claim applies, by name."""


class Claim(NamedTuple):
    """The change from another system to the paper's system, in some rows.

    Attributes:
        compared_system: The system with which the paper's system is compared.
        lines: One of `LINES`.
        quantity: `delay`, with a relative change, or `loss`, with a difference.
        claimed_change: The change that the paper states; None if it states none.
        tabled_change: The change according to the paper's own tables; nan if the tables do not contain it.
        ours: The measured change, with its 95 % interval.
        rows: Number of rows that it is based on: for a delay, packets must have arrived in both systems.
    """

    compared_system: str
    lines: str
    quantity: str
    claimed_change: Printed | None
    tabled_change: float
    ours: IntervalEstimate
    rows: int

    @property
    def agreement(self) -> Agreement | None:
        """The relation of our change to the stated one; None if the paper states none."""
        return None if self.claimed_change is None else agreement(self.claimed_change, self.ours)


def claim_setups(changes: Changes) -> dict[str, Setup]:
    """Return the setups to run for the claims, by name.

    Args:
        changes: Changes of the scenario's file, as for `load_scenario`.

    Raises:
        ConfigurationError: The changes are invalid.
    """
    setups: dict[str, Setup] = {}
    for line, distance_m in ROWS:
        adaptive = setups[_name(ADAPTIVE, line, distance_m)] = masterless(line, distance_m, changes)
        setups[_name(FIXED, line, distance_m)] = Setup(adaptive.scenario, SlidingWindow.name)
        setups[_name(MASTER, line, distance_m)] = master_based(line, distance_m, "ros1", changes)
    return setups


def claims(setups: Mapping[str, Setup], samples: Mapping[str, Sequence[Mapping[str, FlowSample]]]) -> list[Claim]:
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
        for lines, claim_lines in LINES.items():
            rows = [row for row in ROWS if row[0] in claim_lines]
            our_flows, other_system_flows = (
                [flows[_name(system, *row)] for row in rows] for system in (ADAPTIVE, compared_system)
            )
            claimed_changes = CLAIMS.get((compared_system, lines), (None, None))
            tabled_changes = (
                _changes_in_paper_tables(claim_lines) if compared_system == MASTER else (math.nan, math.nan)
            )
            delay, row_count = delay_change(_delays_s(our_flows), _delays_s(other_system_flows))
            loss = mean((_losses(our_flows) - _losses(other_system_flows)).mean(axis=0))
            all_claims.append(
                Claim(compared_system, lines, "delay", claimed_changes[0], tabled_changes[0], delay, row_count)
            )
            all_claims.append(
                Claim(compared_system, lines, "loss", claimed_changes[1], tabled_changes[1], loss, len(rows))
            )
    return all_claims


def delay_change(ours_s: Floats, other_s: Floats) -> tuple[IntervalEstimate, int]:
    """Return the relative change of delays, and the number of rows that it is based on.

    In each row, it compares the means over the seeds with which packets arrived in both systems; at least two such
    seeds are needed. The total is the geometric mean over the rows, so that each has the same weight. The interval is
    computed for the logarithm of the change.

    Args:
        ours_s: Mean delay of a packet in the paper's system, shape (rows, seeds); nan if none arrived.
        other_s: The same for the other system.
    """
    arrived_in_both = np.isfinite(ours_s) & np.isfinite(other_s)
    seeds = ours_s.shape[1]
    used_rows = arrived_in_both.sum(axis=1) >= min(2, seeds)
    if not used_rows.any():
        return IntervalEstimate(math.nan, math.nan, math.nan), 0
    ours_s, other_s = (np.where(arrived_in_both, values_s, np.nan)[used_rows] for values_s in (ours_s, other_s))

    def log_change(columns: Sequence[int]) -> float:
        ratios = np.nanmean(ours_s[:, columns], axis=1) / np.nanmean(other_s[:, columns], axis=1)
        return float(np.log(ratios).mean())

    all_seeds = range(seeds)
    leave_one_out = (
        [log_change([*all_seeds[:seed], *all_seeds[seed + 1 :]]) for seed in all_seeds] if seeds > 1 else []
    )
    estimate = jackknife(log_change(all_seeds), np.array(leave_one_out))
    change = IntervalEstimate(*(math.expm1(number) for number in (estimate.value, estimate.low, estimate.high)))
    return change, int(used_rows.sum())


def _changes_in_paper_tables(lines: Sequence[Sight]) -> tuple[float, float]:
    """Return the changes of delay and loss from the paper's table 3, with TCP, to its table 1."""
    our_columns, other_columns = (
        [PRINTED["1"][line, "topic"] for line in lines],
        [PRINTED["3"][line, "ros1"] for line in lines],
    )
    delay, _ = delay_change(
        *(_printed_numbers([columns.delays_s for columns in system]) for system in (our_columns, other_columns))
    )
    losses = (_printed_numbers([columns.losses for columns in system]) for system in (our_columns, other_columns))
    return delay.value, float(np.subtract(*losses).mean())


def _printed_numbers(columns: Sequence[Sequence[Printed]]) -> Floats:
    """Return printed numbers in the form of the results of one seed, shape (rows, 1)."""
    return np.array([[number.value] for column in columns for number in column], np.float64)


def _delays_s(rows: Sequence[Sequence[FlowSample]]) -> Floats:
    return np.array([[sample.delay_mean_s for sample in row] for row in rows], np.float64)


def _losses(rows: Sequence[Sequence[FlowSample]]) -> Floats:
    return np.array([[sample.loss for sample in row] for row in rows], np.float64)


def _name(system: str, line: Sight, distance_m: int) -> str:
    return f"{system}, {line} {distance_m} m"
