"""Choose where tasks run: in processes of this machine, or on the workers of a Dask cluster.

Either choice gives a `concurrent.futures.Executor`, to which the module `fieldkit.core.tasks` submits tasks.
"""

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fieldkit.core.processes import WorkerExecutor


def usable_processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


@dataclass(frozen=True)
class Workers:
    """The choice of workers by the options `--jobs` and `--cluster`.

    Attributes:
        jobs: Number of processes on this machine; None for the number of processors that this process may use.
        cluster: Address of a Dask scheduler, or its scheduler file; empty for processes on this machine.
    """

    jobs: int | None = None
    cluster: str = ""

    @property
    def is_default(self) -> bool:
        """True if neither a number of processes nor a cluster was chosen."""
        return self.jobs is None and not self.cluster

    def processes(self, tasks: int) -> int:
        """Return the number of processes on this machine for a number of tasks; 0 if a cluster runs them."""
        return 0 if self.cluster else min(self.jobs or usable_processors(), tasks)

    def open(self, tasks: int) -> "WorkerExecutor":
        """Return an executor for a number of tasks.

        Raises:
            ConfigurationError: The package for clusters is not installed.
            LinkError: The scheduler of the cluster does not answer.
        """
        if self.cluster:
            from fieldkit.core.cluster import ClusterExecutor  # noqa: PLC0415 (takes 1 s, and needs an optional package)

            return ClusterExecutor(self.cluster)
        from fieldkit.core.processes import LocalProcesses  # noqa: PLC0415 (imports multiprocessing, 20 ms)

        return LocalProcesses(self.processes(tasks))
