"""Trials in memory: their repeats, cells (the repeats of one condition) and packets as Arrow tables."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from fieldkit.analysis.cells import Cell, Estimate, aggregate
from fieldkit.analysis.comparable import mixtures
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.analysis.repeats import SOURCE
from fieldkit.core.columns import Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, did_you_mean
from fieldkit.core.executors import Workers
from fieldkit.core.model import Protocol
from fieldkit.export import table
from fieldkit.export.table import Table
from fieldkit.measure.transfers import fates
from fieldkit.report.trial_folders import Evidence, load_evidence
from fieldkit.trial import planned_evidence
from fieldkit.trial.stored import sources
from fieldkit.trial.stored.sources import Sources


@dataclass(frozen=True)
class CellFigure:
    """A figure with its 95 % interval.

    Attributes:
        name: The column that it is calculated from.
        unit: Its unit.
        n: Number of valid repeats that have it.
        value: The figure.
        low: Lower end of the interval; minus infinity without an interval, for example for a single repeat.
        high: Upper end; infinity without an interval, or if censored repeats leave it open.
    """

    name: str
    unit: str
    n: int
    value: float
    low: float
    high: float


class TrialCell:
    """The repeats under one condition: `cell.file_loss.high`, or `cell["up.file_loss"]` for a step with a name.

    Args:
        cell: The cell.

    Attributes:
        condition: The condition, by column.
        n_valid: Number of valid repeats, from which all figures are computed.
        n_void: Number of void attempts: not valid, for example because a step failed or evidence is incomplete.
        n_failed: Number of failed attempts: not valid, and not followed by another attempt.
    """

    def __init__(self, cell: Cell) -> None:
        self.condition: Mapping[str, str | float | None] = cell.key
        self.n_valid, self.n_void, self.n_failed = cell.n_valid, cell.n_void, cell.n_failed
        self._estimates = cell.estimates

    def __getitem__(self, name: str) -> CellFigure:
        """Return a figure.

        Raises:
            ConfigurationError: No valid repeat has it.
        """
        if name not in self._estimates:
            remedy = did_you_mean(name, self._estimates, f"its figures: {', '.join(self._estimates) or 'none'}")
            raise ConfigurationError(f"none of {self.n_valid} valid repeats has a figure {name!r}", remedy=remedy)
        return _figure(self._estimates[name])

    def __getattr__(self, name: str) -> CellFigure:
        """Return a figure, like `cell[name]`."""
        if name.startswith("_"):
            raise AttributeError(name)
        return self[name]

    def __iter__(self) -> Iterator[CellFigure]:
        """Yield every figure."""
        return map(_figure, self._estimates.values())

    def __repr__(self) -> str:
        condition = ", ".join(
            f"{name}={value!r}" for name, value in self.condition.items() if value not in {None, ""}
        )
        return f"<fieldkit cell {condition}: {self.n_valid} valid>"


def _figure(estimate: Estimate) -> CellFigure:
    return CellFigure(
        name=estimate.quantity.name,
        unit=estimate.quantity.unit,
        n=estimate.n,
        value=estimate.value,
        low=-math.inf if estimate.low is None else estimate.low,
        high=math.inf if estimate.high is None else estimate.high,
    )


_SOURCE: Column = Column(SOURCE, "text", "Folder of the trial, or CSV file, that a row was read from.")


class Trials:
    """Attempts at the repeats of one or more trials, as loaded by `fieldkit.load`.

    Tables are `pyarrow.Table`. Their method `.to_pandas()` returns a data frame if pandas is installed
    (`pip install "fieldkit[pandas]"`); fieldkit does not require it. The unit and meaning of each column are in the
    metadata of its field. Missing values are null, never 0.
    """

    def __init__(self, trial_sources: Sources) -> None:
        self._sources = trial_sources
        self._attempts = trial_sources.read(undeclared=True)
        self._evidence: dict[str, Evidence] = {}

    @cached_property
    def repeats(self) -> Table:
        """A row per attempt at a repeat, including void and failed ones, as in `fieldkit export --format parquet`."""
        return table.repeats_table(self._attempts)

    def cells(self, by: str | Iterable[str] = DEFAULT_BY, quantities: str | Iterable[str] | None = None) -> Table:
        """Return a row per condition and quantity with value and 95 % interval, as printed by `fieldkit aggregate`.

        Args:
            by: One or more columns that define a condition.
            quantities: One or more columns: numbers are aggregated, and the values of text columns are counted. None
                for all.

        Raises:
            ConfigurationError: There is no such column, or it cannot be aggregated.
        """
        selected_quantities, words = self._sources.select(_names(quantities or ()), option="quantities")
        keys = self._sources.condition(",".join(_names(by)), option="by")
        self._warn_of_mixtures(keys)
        columns_by_name = {column.name: column for column in (*self._attempts.columns, _SOURCE)}
        cells = aggregate(self._attempts, keys, quantities=selected_quantities, words=words)
        return table.cells_table([columns_by_name[name] for name in keys], cells)

    def cell(self, **condition: str | float) -> TrialCell:
        """Return the figures of the only cell that matches a condition: `trials.cell(protocol="udp").file_loss.high`.

        Args:
            condition: Values by column.

        Raises:
            ConfigurationError: There is no such column, no such cell, or several.
        """
        keys = self._sources.condition(",".join((*DEFAULT_BY, *condition)), option="cell")
        self._warn_of_mixtures(keys)
        cells = aggregate(self._attempts, keys)
        matches = [cell for cell in cells if all(cell.key[name] == value for name, value in condition.items())]
        if len(matches) == 1:
            return TrialCell(matches[0])
        candidates = matches or cells
        values = {name: dict.fromkeys(cell.key[name] for cell in candidates) for name in keys}
        differences = "; ".join(
            f"{name}: {', '.join(map(repr, distinct))}" for name, distinct in values.items() if len(distinct) > 1
        )
        conditions = ", ".join(f"{name}={value!r}" for name, value in condition.items())
        text = f"{len(matches) or 'no'} cells have {conditions}" if conditions else f"there are {len(cells)} cells"
        raise ConfigurationError(
            f"{text}; the condition must select exactly one",
            where=self._sources.where,
            remedy=f"they differ in {differences}" if differences else "there is one cell: leave out the condition",
        )

    def packets(self, repeat: str, step: str | None = None) -> Table:
        """Return a row per packet sent by the transfers of an attempt, in the order of sending.

        Args:
            repeat: Name of the attempt's folder below `repeats/`: `udp-07`, or `udp-07.void1` for an attempt that was
                repeated; `TRIAL/udp-07` if several trials have an attempt of this name.
            step: Name of the transfer's step, `""` for one without a name; None for all in order.

        Raises:
            ConfigurationError: There is no such attempt or transfer, or several.
            EvidenceError: The attempt's evidence is missing, changed or insufficient.
        """
        row = self._attempts.row(repeat)
        evidence, evidence_row = self._evidence_of(row)
        attempt, plan = evidence.attempt(evidence_row), evidence.plan(evidence_row)
        source = self._attempts.texts[SOURCE][row]
        if attempt is None or plan is None:
            remedy = "load the folder of a trial with unchanged raw evidence"
            raise EvidenceError(
                "; ".join((f"the evidence of {repeat} is not available", *evidence.limitations)),
                where=source,
                remedy=remedy,
            )
        transfers = {
            transfer.name: transfer
            for transfer in planned_evidence.transfers(plan, Protocol(self._attempts.texts["protocol"][row]))
        }
        if step is not None and step not in transfers:
            names_text = ", ".join(map(repr, transfers)) or "none"
            raise ConfigurationError(
                f"no transfer of {plan.procedure.name} is named {step!r}",
                where=source,
                remedy=did_you_mean(step, transfers, f"its transfers: {names_text}"),
            )
        selected_transfers = transfers if step is None else {step: transfers[step]}
        return table.packets_table(
            {name: fates.read_sent_packets(attempt, transfer) for name, transfer in selected_transfers.items()}
        )

    def __len__(self) -> int:
        """Return the number of attempts."""
        return len(self._attempts)

    def __repr__(self) -> str:
        trials = len(set(self._attempts.texts["trial"]))
        return f"<fieldkit.Trials: {len(self)} attempts of {trials} trials at {self._sources.where}>"

    def _warn_of_mixtures(self, keys: Sequence[str]) -> None:
        for mixture in mixtures(self._attempts, keys):
            _note(mixture.removesuffix("."), stacklevel=4)

    def _evidence_of(self, row: int) -> tuple[Evidence, int]:
        """Return the evidence of the table that a row was read from, and the row's index in the table."""
        source = self._attempts.texts[SOURCE][row]
        rows = np.flatnonzero(self._attempts.texts[SOURCE] == source)
        if source not in self._evidence:
            self._evidence[source] = load_evidence(self._attempts.where(rows))
        return self._evidence[source], int(np.searchsorted(rows, row))


def _names(names: str | Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _note(sentence: str, stacklevel: int = 2) -> None:
    warnings.warn(sentence, stacklevel=stacklevel)


def load(*paths: str | PathLike[str], rebuild: bool = False, where: str = "", use_index: bool = True) -> Trials:
    """Return the trials at some paths.

    Notes of `fieldkit aggregate`, for example about an omitted trial, are issued as `UserWarning`.

    Args:
        paths: Folders of trials, folders with trials below, or CSV files with the columns of trial.csv.
        rebuild: True to compute values from the raw evidence instead of reading trial.csv; nothing is written.
        where: Condition of the attempts to use, `distance_m < 20 and topology == "master"`; empty for all.
        use_index: Whether to read many tables from an index in the user's cache; the result is the same.

    Raises:
        ConfigurationError: A path does not exist or has no trial, or a file is not a table of repeats. It is a
            `fieldkit.core.errors.FieldkitError`, with a message, a location and a remedy.
        EvidenceError: A table is damaged, no repeat has ended, or `where` selects no attempt.
    """
    if not paths:
        raise ConfigurationError("no path is given", remedy='write for example fieldkit.load("trials")')
    # Worker processes would import the main module of a script, and run it again if it has no `__main__` guard.
    workers = sources.ALL_PROCESSORS if rebuild else Workers(jobs=1)
    trial_sources = sources.find(
        [Path(path) for path in paths], _note, rebuild=rebuild, workers=workers, use_index=use_index
    )
    return Trials(trial_sources.with_filter(where))
