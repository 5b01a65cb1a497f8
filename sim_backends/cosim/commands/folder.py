"""The folder in which runs are kept: recordings, and beside each a trial.csv that fieldkit reads as a trial's."""

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
        path: The folder; it is made, and may be there if it is empty.
        scenario: What is run.
        policy: The sync policy in words.
        seeds: The seeds with which it is run.

    Attributes:
        path: As given.

    Raises:
        ConfigurationError: There is something of this name, or it cannot be made.
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
                    "something is in this folder, which is not overwritten",
                    where=str(path),
                    remedy="choose another --out",
                )
            files.write(path / f"{scenario.name}.yaml", schema.dump(scenario).encode())
        except OSError as error:
            raise ConfigurationError(
                f"cannot be written: {error.strerror}", where=str(path), remedy="choose another --out"
            ) from error

    def of(self, seed: int) -> Path:
        """Return the folder of the recording of the run with a seed."""
        digits = len(str(max(self._seeds)))
        return self.path if len(self._seeds) == 1 else self.path / f"seed-{seed:0{digits}}"

    def keep(self, result: SeedResult) -> None:
        """Write the rows of a run that has ended beside its recording.

        Raises:
            ConfigurationError: They cannot be written.
        """
        number = self._seeds.index(result.seed) + 1
        table = trial_rows.table(self.path.resolve().name, self._scenario, self._policy, number, result)
        path = self.of(result.seed) / TRIAL_CSV
        try:
            files.write(path, table.encode())
        except OSError as error:
            raise ConfigurationError(
                f"cannot be written: {error.strerror}", where=str(path), remedy="free some space and run it again"
            ) from error
