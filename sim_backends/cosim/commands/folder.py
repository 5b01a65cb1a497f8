"""The folder of runs: recordings, each with a trial.csv that fieldkit reads like that of a trial."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.commands import trial_rows
from sim_backends.cosim.commands.results import SeedResult
from sim_backends.cosim.scenario.schema import CosimScenario

TRIAL_CSV: Final = "trial.csv"


class RunFolder:
    """The folder of the runs of one scenario with one sync policy: a recording, or one per seed.

    Args:
        path: The folder, which must be empty or not exist; it is created.
        scenario: The scenario.
        policy: The sync policy, as text.
        seeds: The seeds of the runs.

    Attributes:
        path: The folder.

    Raises:
        ConfigurationError: The folder is not empty, or cannot be created.
    """

    def __init__(self, path: Path, scenario: CosimScenario, policy: str, seeds: Sequence[int]) -> None:
        self.path = path
        self._scenario = scenario
        self._policy = policy
        self._seeds = tuple(seeds)
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
        """Return the folder of the recording with a seed."""
        digits = len(str(max(self._seeds)))
        return self.path if len(self._seeds) == 1 else self.path / f"seed-{seed:0{digits}}"

    def write_rows(self, result: SeedResult) -> None:
        """Write the rows of a run that has ended into the folder of its recording.

        Raises:
            ConfigurationError: They cannot be written.
        """
        number = self._seeds.index(result.seed) + 1
        table = trial_rows.table(self.path.resolve().name, self._scenario, self._policy, number, result)
        path = self.recording(result.seed) / TRIAL_CSV
        try:
            files.write(path, table.encode())
        except OSError as error:
            raise ConfigurationError(
                f"cannot be written: {error.strerror}", where=str(path), remedy="free some space and run it again"
            ) from error
