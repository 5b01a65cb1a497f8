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
        seed: Of its random draws.
        setup: Which of several setups is run; empty where there is one.
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
    """Return what `work` makes of each task, in the order of the tasks.

    The first error, and Ctrl-C, end all that is under way.

    Args:
        work: Called in another process, unless there is one worker: what it is made of, and what it returns, can be
            pickled.
        tasks: The tasks.
        workers: How many processes; None for as many as there are processors for this one.
        progress: Called with how many tasks are done.

    Raises:
        FieldkitError: A task failed, or its process died; names the task. Errors of the harness keep their family.
    """
    results: dict[int, Result] = {}
    for number, result in as_they_end(work, tasks, workers=workers):
        results[number] = result
        if progress is not None:
            progress(len(results))
    return [results[number] for number in range(len(tasks))]


def as_they_end(
    work: Callable[[Task], Result], tasks: Sequence[Task], *, workers: int | None = None
) -> Iterator[tuple[int, Result]]:
    """Yield what `work` makes of each task with the task's number, as they end; else as `run_many`."""
    workers = min(workers or len(os.sched_getaffinity(0)), len(tasks))
    return _side_by_side(work, tasks, workers) if workers > 1 else _one_by_one(work, tasks)


def _one_by_one(work: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
    for number, task in enumerate(tasks):
        yield number, _done(work, task)


def _side_by_side(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int
) -> Iterator[tuple[int, Result]]:
    """Yield results as they come; if the generator ends early, the processes end immediately."""
    stop_reader, stop_writer = multiprocessing.Pipe(duplex=False)
    executor = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_end_with, initargs=(stop_reader,)
    )
    futures: list[Future[Result]] = []
    with stop_reader:
        try:
            futures.extend(executor.submit(_done, work, task) for task in tasks)
            numbers = {future: number for number, future in enumerate(futures)}
            for future in as_completed(futures):
                yield numbers[future], future.result()
            executor.shutdown()
        except BrokenProcessPool:
            under_way = [str(task) for task, future in zip(tasks, futures, strict=False) if _is_broken(future)]
            raise FieldkitError(
                "a process was killed",
                where=" or ".join(under_way[:workers]),
                remedy="if memory ran out, use fewer workers",
            ) from None
        finally:
            stop_writer.close()
            executor.shutdown(cancel_futures=True)


def _is_broken(future: Future[Result]) -> bool:
    return future.done() and isinstance(future.exception(), BrokenProcessPool)


def _end_with(stop_reader: Connection) -> None:
    """Let this process ignore Ctrl-C and end when the other end of the pipe closes, as when its caller is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def wait() -> None:
        stop_reader.poll(None)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _done(work: Callable[[Task], Result], task: Task) -> Result:
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
        remedy = "this is a fault of the program; a single worker shows where"
        raise FieldkitError(f"{type(error).__name__}: {error}", where=str(task), remedy=remedy) from error
