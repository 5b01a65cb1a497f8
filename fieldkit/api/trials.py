"""Trials in memory: their repeats, cells and packets as tables of Arrow."""

import warnings
from collections.abc import Iterable, Sequence
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.comparable import mixtures
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.analysis.repeats import SOURCE
from fieldkit.api.cell import TrialCell
from fieldkit.core.columns import Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, nearest
from fieldkit.core.model import Protocol
from fieldkit.export import table
from fieldkit.export.table import Table
from fieldkit.measure.transfers import crossings
from fieldkit.report.evidence import Evidence, at_hand
from fieldkit.trial import sources
from fieldkit.trial.sources import Sources

_SOURCE: Column = Column(SOURCE, "text", "Folder of the trial, or CSV file, that a row was read from.")


class Trials:
    """Attempts at the repeats of one trial or many, as `fieldkit.load` found them.

    Tables are `pyarrow.Table`: `.to_pandas()` of one gives a data frame where pandas is installed, which fieldkit
    itself does not need (`pip install "fieldkit[pandas]"`). Each column's unit and meaning are in its field's
    metadata. What is missing is null, never 0.
    """

    def __init__(self, found: Sources) -> None:
        self._found = found
        self._attempts = found.read(undeclared=True)
        self._evidence: dict[str, Evidence] = {}

    @cached_property
    def repeats(self) -> Table:
        """A row per attempt at a repeat, void and failed ones too: what `fieldkit export --format parquet` writes."""
        return table.of_repeats(self._attempts)

    def cells(self, by: str | Iterable[str] = DEFAULT_BY, quantities: str | Iterable[str] | None = None) -> Table:
        """Return a row per condition and quantity, with value and 95 % interval: what `fieldkit aggregate` prints.

        Args:
            by: Columns that tell one condition from another, or one of them.
            quantities: Columns to estimate, or whose words to count, or one; None for all.

        Raises:
            ConfigurationError: There is no such column, or no figures are made of it.
        """
        chosen, words = self._found.chosen(_names(quantities or ()), asked="quantities")
        keys = self._found.condition(",".join(_names(by)), asked="by")
        self._tell_mixtures(keys)
        declared = {column.name: column for column in (*self._attempts.columns, _SOURCE)}
        cells = aggregate(self._attempts, keys, quantities=chosen, words=words)
        return table.of_cells([declared[name] for name in keys], cells)

    def cell(self, **condition: str | float) -> TrialCell:
        """Return the figures of the only cell with some values: `trials.cell(protocol="udp").file_loss.high`.

        Args:
            condition: Value by column, of those that tell one condition from another.

        Raises:
            ConfigurationError: There is no such column, or no such cell, or several.
        """
        keys = self._found.condition(",".join((*DEFAULT_BY, *condition)), asked="cell")
        self._tell_mixtures(keys)
        cells = aggregate(self._attempts, keys)
        found = [cell for cell in cells if all(cell.key[name] == value for name, value in condition.items())]
        if len(found) == 1:
            return TrialCell(found[0])
        among = found or cells
        values = {name: dict.fromkeys(cell.key[name] for cell in among) for name in keys}
        apart = "; ".join(f"{name}: {', '.join(map(repr, of))}" for name, of in values.items() if len(of) > 1)
        asked = ", ".join(f"{name}={value!r}" for name, value in condition.items()) or "any condition"
        raise ConfigurationError(
            f"{len(found) or 'no'} cells have {asked}, and not one",
            where=self._found.where,
            remedy=f"they differ in {apart}" if apart else "there is one cell: ask for it without a condition",
        )

    def packets(self, repeat: str, step: str | None = None) -> Table:
        """Return a row per packet that the transfers of an attempt sent, in the order of sending.

        Args:
            repeat: The attempt by its folder below `repeats/`: `udp-07`, or `udp-07.void1` of one that was done
                again; where several trials have one of that name, `TRIAL/udp-07`.
            step: Name of the transfer's step, `""` of one without a name; None for all, one after the other.

        Raises:
            ConfigurationError: There is no such attempt or transfer, or several.
            EvidenceError: The attempt's evidence is not at hand, not as it was kept, or does not tell.
        """
        row = self._attempts.row(repeat)
        evidence, at = self._beside(row)
        attempt, plan = evidence.attempt(at), evidence.plan(at)
        source = self._attempts.texts[SOURCE][row]
        if attempt is None or plan is None:
            remedy = "packets are told from the folder of a trial that has its raw evidence, as it was kept"
            raise EvidenceError(
                "; ".join((f"the evidence of {repeat} is not at hand", *evidence.unread)), where=source, remedy=remedy
            )
        transfers = {
            transfer.name: transfer for transfer in plan.transfers(Protocol(self._attempts.texts["protocol"][row]))
        }
        if step is not None and step not in transfers:
            named = ", ".join(map(repr, transfers)) or "none"
            raise ConfigurationError(
                f"no transfer of {plan.procedure.name} is named {step!r}",
                where=source,
                remedy=nearest(step, transfers, f"its transfers: {named}"),
            )
        wanted = transfers if step is None else {step: transfers[step]}
        return table.of_packets({name: crossings.read(attempt, one) for name, one in wanted.items()})

    def __len__(self) -> int:
        """Return the number of attempts."""
        return len(self._attempts)

    def __repr__(self) -> str:
        trials = len(set(self._attempts.texts["trial"]))
        return f"<fieldkit.Trials: {len(self)} attempts of {trials} trials at {self._found.where}>"

    def _tell_mixtures(self, keys: Sequence[str]) -> None:
        for mixture in mixtures(self._attempts, keys):
            _note(mixture.removesuffix("."), stacklevel=4)

    def _beside(self, row: int) -> tuple[Evidence, int]:
        """Return what lies beside the table that a row was read from, and the row's place in it."""
        source = self._attempts.texts[SOURCE][row]
        rows = np.flatnonzero(self._attempts.texts[SOURCE] == source)
        if source not in self._evidence:
            self._evidence[source] = at_hand(self._attempts.where(rows))
        return self._evidence[source], int(np.searchsorted(rows, row))


def _names(names: str | Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _note(sentence: str, stacklevel: int = 2) -> None:
    warnings.warn(sentence, stacklevel=stacklevel)


def load(*paths: str | PathLike[str], rebuild: bool = False) -> Trials:
    """Return the trials at some paths.

    What `fieldkit aggregate` says as a note, on a trial that is left out for example, is a `UserWarning` here.

    Args:
        paths: Folders of trials, folders with trials somewhere below, or CSV files with the columns of trial.csv.
        rebuild: Whether to measure the raw evidence again instead of reading trial.csv; nothing is written.

    Raises:
        ConfigurationError: A path does not exist or has no trial, or a file is no table of repeats; as a
            `fieldkit.core.errors.FieldkitError` it says what, where, and a remedy.
        EvidenceError: A table is damaged, or no repeat has ended.
    """
    if not paths:
        raise ConfigurationError("no path is given", remedy='write for example fieldkit.load("trials")')
    return Trials(sources.find([Path(path) for path in paths], _note, rebuild=rebuild))
