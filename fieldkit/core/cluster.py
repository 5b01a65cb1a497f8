"""The workers of a Dask cluster as an executor. Only this module imports `distributed`."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, ClassVar, Final, ParamSpec, TypeVar

from typing_extensions import override

from fieldkit import __version__
from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.core.processes import WorkerExecutor

try:
    from distributed import Client, KilledWorker
except ImportError as error:
    raise ConfigurationError(
        f"a Dask cluster needs the package distributed: {error}", remedy='pip install "fieldkit[cluster]"'
    ) from error

# Warnings of distributed about lost workers are suppressed, because `tasks` reports lost workers.
logging.getLogger("distributed").setLevel(logging.ERROR)

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_CONNECT_S: Final = 15.0
_REFRESH_S: Final = 1.0
"""Minimum time between two queries of the number of workers."""


class ClusterExecutor(WorkerExecutor):
    """Workers of a Dask scheduler, which need the same version of fieldkit.

    Args:
        address: Address of the scheduler, `tcp://HOST:PORT`, or its scheduler file, which ends in `.json`.

    Raises:
        ConfigurationError: The scheduler file does not exist.
        LinkError: The scheduler does not answer.
    """

    MIN_SUBMISSION_LIMIT: ClassVar[int] = 100  # enough to hide the network delay; the scheduler queues them

    def __init__(self, address: str) -> None:
        if address.endswith(".json") and not Path(address).is_file():
            raise ConfigurationError(
                "there is no scheduler file", where=address, remedy=f"dask scheduler --scheduler-file {address}"
            )
        connection = {"scheduler_file": address} if address.endswith(".json") else {"address": address}
        try:
            client: Any = Client  # Client has no type annotations
            self._client = client(**connection, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise LinkError(
                f"no Dask scheduler answers at {address}",
                remedy="start one with `dask scheduler`, and give the address that it prints",
            ) from error
        self._executor = self._client.get_executor(pure=False)
        self._capacity, self._capacity_read_s = 0, -_REFRESH_S

    @override
    def submit(
        self, fn: Callable[Parameters, Result], /, *args: Parameters.args, **kwargs: Parameters.kwargs
    ) -> Future[Result]:
        future: Future[Result] = self._executor.submit(_run_same_version, __version__, fn, *args, **kwargs)
        return future

    @override
    def capacity(self) -> int:
        if time.monotonic() - self._capacity_read_s >= _REFRESH_S:
            try:
                self._capacity = sum(self._client.nthreads().values())
            except (OSError, TimeoutError):  # the futures report the lost connection
                self._capacity = 0
            self._capacity_read_s = time.monotonic()
        return self._capacity

    @override
    def is_worker_death(self, error: BaseException) -> bool:
        return isinstance(error, KilledWorker)

    @override
    def is_broken(self) -> bool:
        return False  # the scheduler moves the tasks of a dead worker to another worker

    @override
    def stop(self) -> None:
        self._executor.shutdown(wait=False)
        self._client.close(timeout=_CONNECT_S)


def _run_same_version(
    version: str, work: Callable[Parameters, Result], /, *args: Parameters.args, **kwargs: Parameters.kwargs
) -> Result:
    """Return the result of a task on a worker.

    Raises:
        ConfigurationError: The worker has another version of fieldkit.
    """
    if version != __version__:
        raise ConfigurationError(
            f"a worker has fieldkit {__version__}, and this machine has {version}",
            remedy=f'install the same version on the workers: pip install "fieldkit[cluster]=={version}"',
        )
    return work(*args, **kwargs)
