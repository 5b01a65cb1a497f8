"""The paper's tables of delay and loss: the setup of each row, and its comparison with the printed numbers.

A row of tables 1 to 3 is one transmission of 10 s of accelerometer data. Its delay is the sum of the delays of its
packets, as the paper defines its "average delay" (section "Simulation Results"); its loss is the share of packets
that did not arrive.
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
"""The paper's names of protocols."""


Labels = Mapping[str, str | int]
"""The labels of a row: line of sight, distance and protocol, or which radio, and when."""


@dataclass(frozen=True)
class PaperCell:
    """A number of a table.

    Attributes:
        printed: The paper's number.
        ours: Mean over seeds with its 95 % interval, in SI units.
        seeds: Number of seeds that had a value.
    """

    printed: Printed
    ours: IntervalEstimate
    seeds: int

    @property
    def agreement(self) -> Agreement:
        """The relation of our number to the printed one."""
        return agreement(self.printed, self.ours)

    @property
    def agrees_by_mean(self) -> bool:
        """True if the mean itself rounds to the printed number, and not only a value in its interval."""
        alone = IntervalEstimate(self.ours.value, np.nan, np.nan)
        return agreement(self.printed, alone) is Agreement.AGREES

    @property
    def off(self) -> float:
        """Difference of our number from the printed one; nan without ours."""
        return self.ours.value - self.printed.value


@dataclass(frozen=True)
class PaperRow:
    """A row of a table.

    Attributes:
        labels: Labels of the row.
        delay: Sum of the delays of a transmission, or mean round trip, in seconds.
        loss: Share of packets that did not arrive.
        reason: The most frequent reason why packets did not arrive; empty if all arrived.
    """

    labels: Labels
    delay: PaperCell
    loss: PaperCell
    reason: str


class RowSource(NamedTuple):
    """The source of a row.

    Attributes:
        labels: Labels of the row.
        setup: Name of the setup.
        flow: Name of the flow in it.
        printed: The paper's delay and loss.
    """

    labels: Labels
    setup: str
    flow: str
    printed: tuple[Printed, Printed]


@dataclass(frozen=True)
class PaperTable:
    """The setups of a table, and the sources of its rows.

    Attributes:
        setups: The setups by name.
        sources: The sources of the rows.
        delay_s: Returns the delay of a sample, as this table defines it.
    """

    setups: Mapping[str, Setup]
    sources: Sequence[RowSource]
    delay_s: Callable[[FlowSample], float]

    def rows(self, samples: Mapping[str, Sequence[Mapping[str, FlowSample]]]) -> list[PaperRow]:
        """Return the rows.

        Args:
            samples: The result of `flow_samples` for the setups.
        """
        return [
            self._row(source, [of_seed[source.flow] for of_seed in samples[source.setup]]) for source in self.sources
        ]

    def _row(self, source: RowSource, samples: Sequence[FlowSample]) -> PaperRow:
        delay, loss = source.printed
        reasons = sum((Counter(sample.reasons) for sample in samples), Counter())
        return PaperRow(
            source.labels,
            _cell(delay, [self.delay_s(sample) for sample in samples], highest=np.inf),
            _cell(loss, [sample.loss for sample in samples], highest=1.0),
            max(sorted(reasons), key=reasons.__getitem__, default=""),
        )


def paper_table(table: str, changes: Mapping[str, Any]) -> PaperTable:
    """Return one of the paper's tables.

    Args:
        table: One of `TABLES`.
        changes: Changes of the scenario's file, as for `load_scenario`.

    Raises:
        ConfigurationError: The changes are invalid.
    """
    return _emane(changes) if table == "emane" else _transmissions(table, changes)


def _cell(printed: Printed, values: Sequence[float], highest: float) -> PaperCell:
    """Return a cell for the values of all seeds, nan if unknown; its interval is clipped to 0 to `highest`."""
    finite = np.array([value for value in values if np.isfinite(value)])
    ours = mean(finite)
    low, high = np.clip((ours.low, ours.high), 0, highest).tolist()
    return PaperCell(printed, IntervalEstimate(ours.value, low, high), len(finite))


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
