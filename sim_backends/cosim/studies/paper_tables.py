"""The paper's tables of delay and loss: what is run for each row, and how it compares with what was printed.

A row of tables 1 to 3 is one transmission of 10 s of accelerometer data. Its delay is the sum of the delays of its
packets, as the paper defines its "average delay" (section "Simulation Results"), its loss the share of them that did
not arrive.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from sim_backends.cosim.studies.agreement import Agreement, Printed, agreement
from sim_backends.cosim.studies.flow_samples import FlowSample, Setup
from sim_backends.cosim.studies.intervals import IntervalEstimate, mean
from sim_backends.cosim.studies.paper_setups import RADIOS, master_based, masterless, mesh, the_flow
from sim_backends.cosim.studies.printed_values import DISTANCES_M, EMANE, PRINTED

TABLES: Final = (*PRINTED, "emane")

_LABELS: Final = {"topic": "topic", "ros1": "tcp", "ros1-udp": "udp"}
"""Protocols as the paper calls them."""


Labels = Mapping[str, str | int]
"""What tells rows of a table from each other: line of sight, distance and protocol, or which radio, and when."""


@dataclass(frozen=True)
class PaperCell:
    """A number of a table.

    Attributes:
        printed: As the paper has it.
        ours: Mean over seeds with its interval at 95 %, in SI units.
        seeds: With how many of them there was a number.
    """

    printed: Printed
    ours: IntervalEstimate
    seeds: int

    @property
    def agreement(self) -> Agreement:
        """How ours stands to the printed one."""
        return agreement(self.printed, self.ours)

    @property
    def agrees_by_mean(self) -> bool:
        """Whether the mean itself rounds to what is printed, and not only some value of its interval."""
        alone = IntervalEstimate(self.ours.value, np.nan, np.nan)
        return agreement(self.printed, alone) is Agreement.AGREES

    @property
    def off(self) -> float:
        """By how much ours is above the printed one; nan without ours."""
        return self.ours.value - self.printed.value


@dataclass(frozen=True)
class PaperRow:
    """A row of a table.

    Attributes:
        labels: Of the row.
        delay: Sum of the delays of a transmission, or mean round trip, in seconds.
        loss: Share that did not arrive.
        reason: Why most of what did not arrive did not; empty where all did.
    """

    labels: Labels
    delay: PaperCell
    loss: PaperCell
    reason: str


class RowSource(NamedTuple):
    """Where a row is taken from.

    Attributes:
        labels: Of the row.
        setup: Name of what is run.
        flow: Which flow of it.
        printed: The paper's delay and loss.
    """

    labels: Labels
    setup: str
    flow: str
    printed: tuple[Printed, Printed]


@dataclass(frozen=True)
class PaperTable:
    """What is run for a table, and how its rows come of that.

    Attributes:
        setups: What is run, by name.
        sources: Of the rows.
        delay_s: What of a sample is a delay of this table.
    """

    setups: Mapping[str, Setup]
    sources: Sequence[RowSource]
    delay_s: Callable[[FlowSample], float]

    def rows(self, samples: Mapping[str, Sequence[Mapping[str, FlowSample]]]) -> list[PaperRow]:
        """Return its rows.

        Args:
            samples: What `flow_samples` returned for the setups.
        """
        return [self._row(one, [of_seed[one.flow] for of_seed in samples[one.setup]]) for one in self.sources]

    def _row(self, source: RowSource, samples: Sequence[FlowSample]) -> PaperRow:
        delay, loss = source.printed
        reasons = sum((Counter(sample.reasons) for sample in samples), Counter())
        return PaperRow(
            source.labels,
            _cell(delay, [self.delay_s(sample) for sample in samples], most=np.inf),
            _cell(loss, [sample.loss for sample in samples], most=1.0),
            max(sorted(reasons), key=reasons.__getitem__, default=""),
        )


def paper_table(table: str, changes: Mapping[str, Any]) -> PaperTable:
    """Return one of the paper's tables as something to run.

    Args:
        table: One of `TABLES`.
        changes: Other values of the scenario's file, as of `load_scenario`.

    Raises:
        ConfigurationError: The changes cannot be made.
    """
    return _emane(changes) if table == "emane" else _transmissions(table, changes)


def _cell(printed: Printed, values: Sequence[float], most: float) -> PaperCell:
    """Return a cell by the values of all seeds, nan where there is none; none is below 0 or above `most`."""
    known = np.array([value for value in values if np.isfinite(value)])
    ours = mean(known)
    low, high = np.clip((ours.low, ours.high), 0, most).tolist()
    return PaperCell(printed, IntervalEstimate(ours.value, low, high), len(known))


def _transmissions(table: str, changes: Mapping[str, Any]) -> PaperTable:
    """Return one of tables 1 to 3."""
    setups: dict[str, Setup] = {}
    sources: list[RowSource] = []
    for (line, protocol), columns in PRINTED[table].items():
        for distance_m, *printed in zip(DISTANCES_M, columns.delays_s, columns.losses, strict=True):
            name = f"{line} {distance_m} m {protocol}"
            if table == "3":
                setups[name] = master_based(line, distance_m, protocol, changes)
            else:
                setups[name] = masterless(line, distance_m, changes, flying=table == "2")
            labels: Labels = {"line": str(line), "distance_m": distance_m, "protocol": _LABELS[protocol]}
            sources.append(RowSource(labels, name, the_flow(setups[name]), (printed[0], printed[1])))
    return PaperTable(setups, sources, lambda sample: sample.delay_sum_s)


def _emane(changes: Mapping[str, Any]) -> PaperTable:
    """Return the experiment with EMANE."""
    setups = {name: mesh(radio, changes) for name, radio in RADIOS.items()}
    sources = [
        RowSource({"radio": name, "when": when}, name, f"{when}/node-10", printed)
        for name in setups
        for when, printed in EMANE.items()
    ]
    return PaperTable(setups, sources, lambda sample: sample.delay_mean_s)
