"""The folder in which runs are kept: the scenario as it was run, and a trial.csv that grows by a repeat per run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.commands import trial_rows
from sim_backends.cosim.commands.execution import Outcome
from sim_backends.cosim.scenario.schema import CosimScenario

TRIAL_CSV: Final = "trial.csv"


class RunFolder:
    """A folder of runs of one scenario with one sync policy.

    Args:
        path: The folder; it is made, and may be there if it is empty.
        scenario: What is run.
        policy: Name of the sync policy.

    Attributes:
        path: As given.

    Raises:
        ConfigurationError: There is something of this name, or it cannot be made.
    """

    def __init__(self, path: Path, scenario: CosimScenario, policy: str) -> None:
        self.path = path
        self._scenario = scenario
        self._policy = policy
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

    def keep(self, done: Sequence[Outcome]) -> None:
        """Write the rows of the runs that have ended, all of them: a kill leaves those of the runs before.

        Raises:
            OSError: They cannot be written; what was there stays.
        """
        table = trial_rows.table(self.path.resolve().name, self._scenario, self._policy, done)
        files.write(self.path / TRIAL_CSV, table.encode())
