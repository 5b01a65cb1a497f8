"""Executes many runs in parallel, with results that do not depend on the number of workers."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar, cast

from fieldkit.core.errors import FieldkitError
from fieldkit.core.executors import Workers
from fieldkit.core.tasks import WorkerDiedError, completed

Result = TypeVar("Result")

ALL_PROCESSORS: Final = Workers()

_FEW_PACKETS: Final = 400
"""Number of packets whose simulation takes about as long as the start of two processes: 2 s of processor time."""


def workers_for(packets: float, workers: Workers = ALL_PROCESSORS) -> Workers:
    """Return the workers that the user chose; without a choice, only this process if that is faster.

    Args:
        packets: Approximate number of packets in all runs.
        workers: The workers that the user chose, or the default.
    """
    return Workers(1) if workers.is_default and packets <= _FEW_PACKETS else workers


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
        setup = f"{self.setup}, " if self.setup else ""
        return f"{setup}policy {self.policy}, seed {self.seed}"


def run_many(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: Workers = ALL_PROCESSORS,
    progress: Callable[[int], None] | None = None,
) -> list[Result]:
    """Return the result of `work` for each task, in the order of the tasks.

    After the first error, and after Ctrl-C, all tasks are stopped.

    Args:
        work: Executes a task; it must be picklable.
        tasks: The tasks.
        workers: The workers that run the tasks.
        progress: Called with the number of finished tasks, or None.

    Raises:
        FieldkitError: A task failed, or its worker process terminated repeatedly; the error names the task. Errors of
            fieldkit keep their class.
    """
    results: dict[int, Result] = {}
    for number, result in as_completed_tasks(work, tasks, workers=workers):
        results[number] = result
        if progress is not None:
            progress(len(results))
    return [results[number] for number in range(len(tasks))]


def as_completed_tasks(
    work: Callable[[Task], Result], tasks: Sequence[Task], *, workers: Workers = ALL_PROCESSORS
) -> Iterator[tuple[int, Result]]:
    """Yield the number and the result of each task when it has finished.

    The arguments and the errors are those of `run_many`.
    """
    for end in completed(partial(_run_task, work), tasks, workers):
        if isinstance(end.error, WorkerDiedError):
            end.error.where = str(tasks[end.number])
        if end.error is not None:
            raise end.error
        yield end.number, cast("Result", end.result)


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
