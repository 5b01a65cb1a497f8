"""The executor for tasks in processes of this machine, and the contract of executors whose workers can die."""

import os
import signal
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import ClassVar, ParamSpec, TypeVar

from typing_extensions import override

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


class WorkerExecutor(Executor):
    """An executor that reports the number of its workers and their deaths.

    Attributes:
        MIN_SUBMISSION_LIMIT: Smallest limit for the number of tasks that are submitted but not finished. The limit
            increases with the number of workers.
    """

    MIN_SUBMISSION_LIMIT: ClassVar[int] = 4

    @abstractmethod
    def capacity(self) -> int:
        """Return the number of tasks that can run at the same time; 0 if no worker is connected."""

    @abstractmethod
    def is_worker_death(self, error: BaseException) -> bool:
        """Return True if the error of a future means that its worker died."""

    @abstractmethod
    def is_broken(self) -> bool:
        """Return True if the executor accepts no more tasks because a worker died."""

    @abstractmethod
    def stop(self) -> None:
        """Release the workers. Running and waiting tasks are abandoned."""


class LocalProcesses(ProcessPoolExecutor, WorkerExecutor):
    """Processes on this machine. They ignore Ctrl-C, and exit when the process that started them exits.

    Args:
        count: Number of processes.
    """

    def __init__(self, count: int) -> None:
        context = get_context("spawn")
        self._stop_reader, self._stop_writer = context.Pipe(duplex=False)
        super().__init__(count, context, initializer=_exit_with_parent, initargs=(self._stop_reader,))
        self._count = count
        self._broken_by_death = False

    @override
    def submit(
        self, fn: Callable[Parameters, Result], /, *args: Parameters.args, **kwargs: Parameters.kwargs
    ) -> Future[Result]:
        try:
            with _blocked_interrupts():  # a process that is started here inherits the signal mask
                return super().submit(fn, *args, **kwargs)
        except BrokenExecutor:
            self._broken_by_death = True
            raise

    @override
    def capacity(self) -> int:
        return self._count

    @override
    def is_worker_death(self, error: BaseException) -> bool:
        is_death = isinstance(error, BrokenExecutor)
        self._broken_by_death |= is_death
        return is_death

    @override
    def is_broken(self) -> bool:
        return self._broken_by_death

    @override
    def stop(self) -> None:
        self._stop_writer.close()
        self.shutdown(cancel_futures=True)
        self._stop_reader.close()


@contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Block SIGINT during the body; otherwise Ctrl-C would interrupt the start of a process."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _exit_with_parent(stop_reader: Connection) -> None:
    """Ignore Ctrl-C, and exit when the other end of the pipe is closed, for example because the parent has exited."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))

    def wait() -> None:
        stop_reader.poll(None)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
