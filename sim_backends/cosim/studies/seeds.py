"""Many runs in parallel processes; results do not depend on the number of processes."""

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Final, TypeVar

from fieldkit.core.errors import FieldkitError

Result = TypeVar("Result")

_ALONE_S: Final = 1.0
"""About the processor time that the start of two processes takes: shorter work runs faster in one process."""
_BUSY_FACTOR: Final = 5
"""On a busy machine, a second of processor time takes longer; work that waits for other programs needs little."""


@dataclass(frozen=True)
class Task:
    """One run.

    Attributes:
        policy: Name of its sync policy.
        seed: Seed of its random draws.
        setup: Name of its setup; empty if there is only one.
    """

    policy: str
    seed: int
    setup: str = ""

    def __str__(self) -> str:
        return f"{self.setup and f'{self.setup}, '}policy {self.policy}, seed {self.seed}"


def run_many(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Result]:
    """Return the result of `work` for each task, in the order of the tasks.

    After the first error, and after Ctrl-C, all tasks are stopped.

    Args:
        work: Called in this or another process; it and its results must be picklable.
        tasks: The tasks.
        workers: Number of processes; None for the number of processors that this process may use, which are started
            if the work takes longer than a second.
        progress: Called with the number of finished tasks.

    Raises:
        FieldkitError: A task failed, or its process died; the error names the task. Errors of fieldkit keep their
            class.
    """
    results: dict[int, Result] = {}
    for number, result in as_completed_tasks(work, tasks, workers=workers):
        results[number] = result
        if progress is not None:
            progress(len(results))
    return [results[number] for number in range(len(tasks))]


def as_completed_tasks(
    work: Callable[[Task], Result], tasks: Sequence[Task], *, workers: int | None = None
) -> Iterator[tuple[int, Result]]:
    """Yield the number and the result of each task when it has finished; otherwise like `run_many`."""
    number_of_workers = min(workers or len(os.sched_getaffinity(0)), len(tasks))
    if number_of_workers <= 1:
        return _in_sequence(work, tasks)
    return _in_parallel(work, tasks, number_of_workers, alone_s=_ALONE_S if workers is None else 0.0)


def _in_sequence(work: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
    for number, task in enumerate(tasks):
        yield number, _run_task(work, task)


def _in_parallel(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int, *, alone_s: float
) -> Iterator[tuple[int, Result]]:
    """Yield results when they are available; if the generator is closed early, the processes exit immediately.

    Args:
        work: As for `run_many`.
        tasks: As for `run_many`.
        workers: Number of processes.
        alone_s: For this processor time, tasks run in this process; then those that have not started run in others.
    """
    stop_reader, stop_writer = multiprocessing.Pipe(duplex=False)
    executor = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_exit_with_parent, initargs=(stop_reader,)
    )
    waiting = deque(range(len(tasks)))
    changing = threading.Lock()
    futures: dict[Future[Result], int] = {}

    def submit_waiting() -> None:
        if _is_long(alone_s, stopped):
            with changing, suppress(BrokenProcessPool):  # a submitted task has the same error
                while waiting:
                    future = executor.submit(_run_task, work, tasks[waiting[0]])
                    futures[future] = waiting.popleft()

    stopped = threading.Event()
    starter = threading.Thread(target=submit_waiting)
    with stop_reader:
        try:
            starter.start()
            while alone_s > 0:
                with changing:
                    if not waiting:
                        break
                    number = waiting.popleft()
                yield number, _run_task(work, tasks[number])
            if waiting:
                starter.join()
            for future in as_completed(futures):
                yield futures[future], future.result()
            executor.shutdown()
        except BrokenProcessPool:
            broken_tasks = [str(tasks[number]) for future, number in futures.items() if _is_broken(future)]
            raise FieldkitError(
                "a process was killed",
                where=" or ".join(broken_tasks[:workers]),
                remedy="if memory ran out, use fewer workers",
            ) from None
        finally:
            stopped.set()
            starter.join()
            stop_writer.close()
            executor.shutdown(cancel_futures=True)


def _is_long(alone_s: float, stopped: threading.Event) -> bool:
    """Wait for the processor time `alone_s` of this process, at most for `_BUSY_FACTOR` times as long.

    Returns:
        False if `stopped` was set before.
    """
    start_s, passed_s = time.process_time(), 0.0
    while passed_s < _BUSY_FACTOR * alone_s and time.process_time() - start_s < alone_s:
        if stopped.wait(alone_s / 10):
            return False
        passed_s += alone_s / 10
    return not stopped.is_set()


def _is_broken(future: Future[Result]) -> bool:
    return future.done() and isinstance(future.exception(), BrokenProcessPool)


def _exit_with_parent(stop_reader: Connection) -> None:
    """Ignore Ctrl-C, and exit when the other end of the pipe is closed, for example because the parent has exited."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def wait() -> None:
        stop_reader.poll(None)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _run_task(work: Callable[[Task], Result], task: Task) -> Result:
    """Return the result of a task.

    Raises:
        FieldkitError: The task failed; the error names it.
    """
    try:
        return work(task)
    except FieldkitError as error:
        error.where = f"{task}: {error.where}" if error.where else str(task)
        raise
    except Exception as error:
        remedy = "this is a bug in the program; run it with a single worker to locate it"
        raise FieldkitError(f"{type(error).__name__}: {error}", where=str(task), remedy=remedy) from error
