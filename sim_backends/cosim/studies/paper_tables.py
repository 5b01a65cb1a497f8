"""The tables of the paper (cited in docs/index.md): the printed values, and their agreement with simulations."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from fieldkit.core.model import Scenario as Sight
from sim_backends.cosim.studies.intervals import IntervalEstimate, mean
from sim_backends.cosim.studies.paper_setups import (
    RADIOS,
    FlowSample,
    Setup,
    master_based,
    masterless,
    mesh,
    only_flow,
)


class Agreement(StrEnum):
    """The relation of a measured number to a printed one."""

    AGREES = "agrees"
    ABOVE = "above"
    BELOW = "below"
    NO_VALUE = "no value"


@dataclass(frozen=True)
class Printed:
    """A number as it was printed.

    Attributes:
        text: Its digits, in the printed unit.
        per_si: Factor from SI units to the printed unit: 100 for %, 1000 for ms.
        step: Precision of the number, in the printed unit; if empty, one unit of its last digit.
    """

    text: str
    per_si: int = 1
    step: str = ""

    @property
    def value(self) -> float:
        """The number, in SI units."""
        return float(Decimal(self.text) / self.per_si)

    @property
    def bounds(self) -> tuple[float, float]:
        """The smallest and the largest number, in SI units, that would be printed with this text."""
        exponent = Decimal(self.text).as_tuple().exponent
        assert isinstance(exponent, int)  # not infinity or nan
        step = Decimal(self.step) if self.step else Decimal(1).scaleb(exponent)
        low, high = Decimal(self.text) - step / 2, Decimal(self.text) + step / 2
        return float(low / self.per_si), float(high / self.per_si)


def compare(printed: Printed, measured: IntervalEstimate) -> Agreement:
    """Return the relation of an estimate to a printed number, both in SI units.

    They agree if the printed number, at its precision, is within the interval of the estimate, or if the value of the
    estimate rounds to it.
    """
    if math.isnan(measured.value):
        return Agreement.NO_VALUE
    low, high = printed.bounds
    if max(measured.value, _or_value(measured.high, measured.value)) < low:
        return Agreement.BELOW
    if min(measured.value, _or_value(measured.low, measured.value)) > high:
        return Agreement.ABOVE
    return Agreement.AGREES


def _or_value(bound: float, value: float) -> float:
    """Return a bound of an interval, or the value if the bound is unknown."""
    return value if math.isnan(bound) else bound


DISTANCES_M: Final = (20, 40, 60, 80, 100)
"""The distances of every table."""


class PrintedColumns(NamedTuple):
    """Two columns of a table: a number for each of `DISTANCES_M`.

    Attributes:
        delays_s: Sums of delays.
        losses: Shares of lost packets.
    """

    delays_s: tuple[Printed, ...]
    losses: tuple[Printed, ...]


def _columns(delays_s: str, losses_percent: str) -> PrintedColumns:
    """Return columns from their digits.

    A delay of `1` is printed in columns with values such as `0.8`, and means `1.0`. All 40 losses are multiples of
    10 %, so their precision is assumed to be 10 %.
    """
    return PrintedColumns(
        tuple(Printed(text, step="" if "." in text else "0.1") for text in delays_s.split()),
        tuple(Printed(text, per_si=100, step="10") for text in losses_percent.split()),
    )


PRINTED: Final[Mapping[str, Mapping[tuple[Sight, str], PrintedColumns]]] = MappingProxyType(
    {
        # Section "Simulation Results", table `ugv`: masterless, UGV to UGV.
        "1": {
            (Sight.LOS, "topic"): _columns("0.01 0.1 0.4 0.4 0.6", "0 0 0 10 10"),
            (Sight.NLOS, "topic"): _columns("0.2 0.5 0.8 1 1", "0 10 10 20 30"),
        },
        # Section "Simulation Results", table `uav`: masterless, UGV to UAV.
        "2": {
            (Sight.LOS, "topic"): _columns("0.1 0.2 0.2 0.5 0.6", "0 10 10 20 30"),
            (Sight.NLOS, "topic"): _columns("0.5 0.7 0.8 1.3 1.6", "0 20 20 60 90"),
        },
        # Section "Discussion", table `ros1`: master-based, UGV to UGV.
        "3": {
            (Sight.LOS, "ros1-udp"): _columns("0.01 0.08 0.42 0.46 0.5", "0 0 10 30 40"),
            (Sight.LOS, "ros1"): _columns("0.01 0.1 0.48 0.6 0.8", "0 0 10 10 20"),
            (Sight.NLOS, "ros1-udp"): _columns("0.18 0.4 0.54 0.96 1", "10 30 50 60 60"),
            (Sight.NLOS, "ros1"): _columns("0.2 0.5 0.8 1 1.4", "10 10 30 40 50"),
        },
    }
)
"""The columns by table, and by line of sight and protocol."""

EMANE: Final[Mapping[str, tuple[Printed, Printed]]] = MappingProxyType(
    {
        "before": (Printed("5.377", per_si=1000), Printed("0", per_si=100)),
        "after": (Printed("54.309", per_si=1000), Printed("0", per_si=100)),
    }
)
"""Section "Discussion": mean round trip and share of lost requests of 100 pings, before and after node 10 moved."""

FIXED: Final = "fixed window"
"""A compared system: the system of the paper, but with a window that does not adapt."""
MASTER: Final = "master-based"
"""A compared system, which uses a ROS 1 master, with TCP."""

CLAIMS: Final[Mapping[tuple[str, str], tuple[Printed, Printed]]] = MappingProxyType(
    {
        # Abstract and conclusion.
        (FIXED, "all"): (Printed("-12", per_si=100), Printed("-10", per_si=100)),
        # Abstract and introduction.
        (MASTER, "all"): (Printed("-12", per_si=100), Printed("-10", per_si=100)),
        # Sections "Simulation Results" and "Discussion".
        (MASTER, Sight.LOS): (Printed("-20", per_si=100), Printed("-10", per_si=100)),
        (MASTER, Sight.NLOS): (Printed("-40", per_si=100), Printed("-20", per_si=100)),
    }
)
"""Relative change of delay, and change of loss in percentage points, by compared system and sight group."""


TABLES: Final = (*PRINTED, "emane")

_LABELS: Final = {"topic": "topic", "ros1": "tcp", "ros1-udp": "udp"}
"""The paper's names of protocols."""


Labels = Mapping[str, str | int]
"""The labels of a row: line of sight, distance and protocol; or the radio and the time."""


@dataclass(frozen=True)
class PaperCell:
    """A number of a table.

    Attributes:
        printed: The paper's number.
        measured: The result of the simulations: mean over seeds with its 95 % interval, in SI units.
        seeds: Number of seeds that had a value.
    """

    printed: Printed
    measured: IntervalEstimate
    seeds: int

    @property
    def agreement(self) -> Agreement:
        """The relation of the measured number to the printed one."""
        return compare(self.printed, self.measured)

    @property
    def agrees_by_mean(self) -> bool:
        """True if the mean rounds to the printed number, not only another value in its interval."""
        mean_only = IntervalEstimate(self.measured.value, np.nan, np.nan)
        return compare(self.printed, mean_only) is Agreement.AGREES

    @property
    def difference(self) -> float:
        """Measured number minus the printed one; nan if the measured number is unknown."""
        return self.measured.value - self.printed.value


@dataclass(frozen=True)
class PaperRow:
    """A row of a table.

    Attributes:
        labels: Labels of the row.
        delay: Sum of the delays of a transmission, or mean round trip, in seconds.
        loss: Share of packets that did not arrive.
        reason: The most frequent reason why packets did not arrive (`FlowSample.reasons`); empty without reasons.
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
        flow: Name of the flow in the setup.
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
            self._row(source, [flow_samples[source.flow] for flow_samples in samples[source.setup]])
            for source in self.sources
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
        changes: Values that replace values of the scenario file, by dotted key.

    Raises:
        ConfigurationError: The changes are invalid.
    """
    return _emane(changes) if table == "emane" else _transmissions(table, changes)


def _cell(printed: Printed, values: Sequence[float], highest: float) -> PaperCell:
    """Return a cell for the values of all seeds, nan if unknown; its interval is clipped to [0, `highest`]."""
    finite = np.array([value for value in values if np.isfinite(value)])
    estimate = mean(finite)
    low, high = np.clip((estimate.low, estimate.high), 0, highest).tolist()
    return PaperCell(printed, IntervalEstimate(estimate.value, low, high), len(finite))


def _transmissions(table: str, changes: Mapping[str, Any]) -> PaperTable:
    """Return one of tables 1 to 3."""
    setups: dict[str, Setup] = {}
    sources: list[RowSource] = []
    for (sight, protocol), columns in PRINTED[table].items():
        for distance_m, *printed in zip(DISTANCES_M, columns.delays_s, columns.losses, strict=True):
            name = f"{sight} {distance_m} m {protocol}"
            if table == "3":
                setups[name] = master_based(sight, distance_m, protocol, changes)
            else:
                setups[name] = masterless(sight, distance_m, changes, flying=table == "2")
            labels: Labels = {"line": str(sight), "distance_m": distance_m, "protocol": _LABELS[protocol]}
            sources.append(RowSource(labels, name, only_flow(setups[name]), (printed[0], printed[1])))
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
