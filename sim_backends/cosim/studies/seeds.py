"""Many runs in parallel processes; results do not depend on the number of processes."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TypeVar

from fieldkit.core.errors import FieldkitError

Result = TypeVar("Result")


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
        work: Called in another process, unless there is only one worker; it and its results must be picklable.
        tasks: The tasks.
        workers: Number of processes; None for the number of processors that this process may use.
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
    workers = min(workers or len(os.sched_getaffinity(0)), len(tasks))
    return _in_parallel(work, tasks, workers) if workers > 1 else _in_sequence(work, tasks)


def _in_sequence(work: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
    for number, task in enumerate(tasks):
        yield number, _run_task(work, task)


def _in_parallel(work: Callable[[Task], Result], tasks: Sequence[Task], workers: int) -> Iterator[tuple[int, Result]]:
    """Yield results when they are available; if the generator is closed early, the processes exit immediately."""
    stop_reader, stop_writer = multiprocessing.Pipe(duplex=False)
    executor = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_exit_with_parent, initargs=(stop_reader,)
    )
    futures: list[Future[Result]] = []
    with stop_reader:
        try:
            futures.extend(executor.submit(_run_task, work, task) for task in tasks)
            numbers = {future: number for number, future in enumerate(futures)}
            for future in as_completed(futures):
                yield numbers[future], future.result()
            executor.shutdown()
        except BrokenProcessPool:
            broken_tasks = [str(task) for task, future in zip(tasks, futures, strict=False) if _is_broken(future)]
            raise FieldkitError(
                "a process was killed",
                where=" or ".join(broken_tasks[:workers]),
                remedy="if memory ran out, use fewer workers",
            ) from None
        finally:
            stop_writer.close()
            executor.shutdown(cancel_futures=True)


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
