"""What the paper claims of its middleware: an adaptive window against a fixed one, masterless against master-based.

Both are measured in the rows of its tables 1 and 3, with the same seeds, and told as changes: of the delay of a
packet that arrives, and of the share that does not arrive.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from fieldkit.core.model import Scenario as Sight
from sim_backends.cosim.policies.sliding_window import SlidingWindow
from sim_backends.cosim.studies.agreement import Agreement, Printed, agreement
from sim_backends.cosim.studies.flow_samples import FlowSample, Setup
from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, jackknife, mean
from sim_backends.cosim.studies.paper_setups import Changes, master_based, masterless, the_flow
from sim_backends.cosim.studies.printed_values import CLAIMS, DISTANCES_M, FIXED, MASTER, PRINTED

ADAPTIVE: Final = "adaptive"
"""The paper's own system; it is compared with `FIXED` and `MASTER`."""

ROWS: Final = tuple((line, distance_m) for line in Sight for distance_m in DISTANCES_M)
"""Lines and distances at which each is run."""

LINES: Final[Mapping[str, tuple[Sight, ...]]] = {"all": tuple(Sight), **{str(line): (line,) for line in Sight}}
"""Which of them a claim is about, by a name."""


class Claim(NamedTuple):
    """A change from one system to another in some rows.

    Attributes:
        than: The system that the paper's own is compared with.
        lines: One of `LINES`.
        quantity: `delay`, of which the change is relative, or `loss`.
        claimed: In the paper's words; None where it says nothing.
        tabled: By the paper's own tables; nan where they do not say.
        ours: As measured, with its interval at 95 %.
        rows: How many rows it is taken from: a delay needs packets that arrived in both systems.
    """

    than: str
    lines: str
    quantity: str
    claimed: Printed | None
    tabled: float
    ours: IntervalEstimate
    rows: int

    @property
    def agreement(self) -> Agreement | None:
        """How ours stands to the paper's words, if there are any."""
        return None if self.claimed is None else agreement(self.claimed, self.ours)


def claim_setups(changes: Changes) -> dict[str, Setup]:
    """Return what is run for the claims, by a name.

    Args:
        changes: Other values of the scenario's file, as of `load_scenario`.

    Raises:
        ConfigurationError: The changes cannot be made.
    """
    found: dict[str, Setup] = {}
    for line, distance_m in ROWS:
        own = found[_name(ADAPTIVE, line, distance_m)] = masterless(line, distance_m, changes)
        found[_name(FIXED, line, distance_m)] = Setup(own.scenario, SlidingWindow.name)
        found[_name(MASTER, line, distance_m)] = master_based(line, distance_m, "ros1", changes)
    return found


def claims(setups: Mapping[str, Setup], samples: Mapping[str, Sequence[Mapping[str, FlowSample]]]) -> list[Claim]:
    """Return all claims.

    Args:
        setups: As of `claim_setups`.
        samples: What `flow_samples` returned for them.
    """
    flows = {name: [of_seed[the_flow(setup)] for of_seed in samples[name]] for name, setup in setups.items()}
    found: list[Claim] = []
    for than in (FIXED, MASTER):
        for lines, chosen in LINES.items():
            rows = [row for row in ROWS if row[0] in chosen]
            own, rival = ([flows[_name(system, *row)] for row in rows] for system in (ADAPTIVE, than))
            claimed = CLAIMS.get((than, lines), (None, None))
            tabled = _tabled(chosen) if than == MASTER else (math.nan, math.nan)
            delay, used = delay_change(_delays_s(own), _delays_s(rival))
            loss = mean((_losses(own) - _losses(rival)).mean(axis=0))
            found.append(Claim(than, lines, "delay", claimed[0], tabled[0], delay, used))
            found.append(Claim(than, lines, "loss", claimed[1], tabled[1], loss, len(rows)))
    return found


def delay_change(own_s: Floats, rival_s: Floats) -> tuple[IntervalEstimate, int]:
    """Return the relative change of delays, and from how many rows it comes.

    In each row it is that of the means over those seeds with which packets arrived in both systems, of which there
    have to be two; the change of all is the geometric mean of those of the rows, so that each counts alike. The
    interval is that of its logarithm.

    Args:
        own_s: Mean delay of a packet, shape (rows, seeds); nan where none arrived.
        rival_s: Likewise.
    """
    both = np.isfinite(own_s) & np.isfinite(rival_s)
    seeds = own_s.shape[1]
    used = both.sum(axis=1) >= min(2, seeds)
    if not used.any():
        return IntervalEstimate(math.nan, math.nan, math.nan), 0
    own_s, rival_s = (np.where(both, values_s, np.nan)[used] for values_s in (own_s, rival_s))

    def change(kept: Sequence[int]) -> float:
        ratios = np.nanmean(own_s[:, kept], axis=1) / np.nanmean(rival_s[:, kept], axis=1)
        return float(np.log(ratios).mean())

    every = range(seeds)
    without = [change([*every[:one], *every[one + 1 :]]) for one in every] if seeds > 1 else []
    found = jackknife(change(every), np.array(without))
    return IntervalEstimate(*(math.expm1(number) for number in (found.value, found.low, found.high))), int(used.sum())


def _tabled(lines: Sequence[Sight]) -> tuple[float, float]:
    """Return the changes of delay and loss from the paper's table 3, by TCP, to its table 1."""
    own, rival = [PRINTED["1"][line, "topic"] for line in lines], [PRINTED["3"][line, "ros1"] for line in lines]
    delay, _ = delay_change(*(_printed([columns.delays_s for columns in one]) for one in (own, rival)))
    losses = (_printed([columns.losses for columns in one]) for one in (own, rival))
    return delay.value, float(np.subtract(*losses).mean())


def _printed(columns: Sequence[Sequence[Printed]]) -> Floats:
    """Return printed numbers as those of one seed, shape (rows, 1)."""
    return np.array([[number.value] for column in columns for number in column], np.float64)


def _delays_s(rows: Sequence[Sequence[FlowSample]]) -> Floats:
    return np.array([[sample.delay_mean_s for sample in row] for row in rows], np.float64)


def _losses(rows: Sequence[Sequence[FlowSample]]) -> Floats:
    return np.array([[sample.loss for sample in row] for row in rows], np.float64)


def _name(system: str, line: Sight, distance_m: int) -> str:
    return f"{system}, {line} {distance_m} m"
