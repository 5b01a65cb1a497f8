"""Writes the folder of the runs of a scenario: recordings, each with a trial.csv in the format of trials."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files
from fieldkit.core.columns import csv_text
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.commands.flow_rows import flow_rows
from sim_backends.cosim.commands.reproduced_rows import ReproducedRows
from sim_backends.cosim.commands.results import SeedResult
from sim_backends.cosim.scenario.schema import CosimScenario

TRIAL_CSV: Final = "trial.csv"


class RunFolder:
    """The folder of the runs of one scenario with one sync policy: one recording, or one recording per seed.

    Args:
        path: The folder, which must be empty or not exist; it is created, and the scenario is written to it.
        scenario: The scenario.
        policy: The sync policy, as text.
        seeds: The seeds of the runs.

    Attributes:
        path: The folder.

    Raises:
        ConfigurationError: The folder is not empty, or cannot be created, or the scenario does not agree with the
            procedure of the trial that it reproduces.
    """

    def __init__(self, path: Path, scenario: CosimScenario, policy: str, seeds: Sequence[int]) -> None:
        self.path = path
        self._scenario = scenario
        self._policy = policy
        self._seeds = tuple(seeds)
        self._reproduced = None if scenario.trial is None else ReproducedRows(scenario, scenario.trial, policy)
        try:
            path.mkdir(parents=True, exist_ok=True)
            if next(path.iterdir(), None) is not None:
                raise ConfigurationError(
                    "this folder is not empty, and is not overwritten",
                    where=str(path),
                    remedy="choose another --out",
                )
            files.write(path / f"{scenario.name}.yaml", schema.dump(scenario).encode())
        except OSError as error:
            raise ConfigurationError(
                f"cannot be written: {error.strerror}", where=str(path), remedy="choose another --out"
            ) from error

    def recording(self, seed: int) -> Path:
        """Return the folder of the recording with a seed: `path` itself if there is only one seed."""
        digits = len(str(max(self._seeds)))
        return self.path if len(self._seeds) == 1 else self.path / f"seed-{seed:0{digits}}"

    def write_rows(self, result: SeedResult) -> None:
        """Write the rows of a run, complete or not, into the folder of its recording.

        Raises:
            ConfigurationError: The file cannot be written.
        """
        number = self._seeds.index(result.seed) + 1
        path = self.recording(result.seed) / TRIAL_CSV
        trial = self.path.resolve().name
        reproduced_rows = self._reproduced
        trial_rows = [] if reproduced_rows is None else list(reproduced_rows.rows(trial, number, result, path.parent))
        excluded_flows = () if reproduced_rows is None else reproduced_rows.flows
        other_rows = flow_rows(trial, self._scenario, self._policy, number, result, excluded_flows=excluded_flows)
        rows = [*trial_rows, *other_rows]
        names = list(dict.fromkeys(name for row in rows for name in row))
        try:
            files.write(path, csv_text(names, ([row.get(name) for name in names] for row in rows)).encode())
        except OSError as error:
            raise ConfigurationError(
                f"cannot be written: {error.strerror}", where=str(path), remedy="free some space and run it again"
            ) from error
