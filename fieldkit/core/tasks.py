"""Run many tasks on an executor. A limited number is submitted at a time; results are returned as they complete.

A task whose worker died is run again. If a process of this machine dies, all submitted tasks are lost, and it is
unknown which of them is the cause; a task that was lost repeatedly is therefore run alone.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from fieldkit.core.errors import FieldkitError, LinkError
from fieldkit.core.executors import Workers
from fieldkit.core.units import format_count

Task = TypeVar("Task")
Result = TypeVar("Result")

MAX_DEATHS: Final = 5
"""A task has failed if its worker died this number of times."""
ALONE_AFTER: Final = 2
"""A task is run alone if its worker died this number of times."""

_PER_WORKER: Final = 2
"""Submitted tasks per worker: one that runs and one that waits, so that no worker is idle."""
_POLL_S: Final = 1.0
"""Interval at which the number of workers of a cluster is read."""


class WorkerDiedError(FieldkitError):
    """The worker of a task died `MAX_DEATHS` times."""


@dataclass(frozen=True)
class TaskEnd(Generic[Result]):
    """Result or error of a finished task.

    Attributes:
        number: Index of the task.
        result: Its result; None if it failed.
        error: The exception that it raised, or a `WorkerDiedError`; None if it has a result.
    """

    number: int
    result: Result | None = None
    error: Exception | None = None


def ignore(_: str) -> None:
    """Discard a note."""


def completed(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    workers: Workers,
    note: Callable[[str], None] = ignore,
) -> Iterator[TaskEnd[Result]]:
    """Yield the end of each task, in the order of completion. Closing the generator early stops all tasks.

    Args:
        work: The function that runs a task. It is called in another process, unless `workers` is a single process on
            this machine, or there is only one task for processes on this machine. The function, the tasks and the
            results must be picklable.
        tasks: The tasks.
        workers: The workers on which they run.
        note: Receives a sentence when a worker died or when no worker is connected.

    Raises:
        ConfigurationError: For the same reasons as `Workers.open`.
        LinkError: The scheduler of the cluster does not answer, or the connection was lost.
    """
    if tasks and workers.processes(len(tasks)) != 1:
        yield from _Submission(work, tasks, workers, note).ends()
        return
    for number, task in enumerate(tasks):
        try:
            result = work(task)
        except Exception as error:  # noqa: BLE001 (returned to the caller)
            yield TaskEnd(number, error=error)
        else:
            yield TaskEnd(number, result)


class _Submission(Generic[Task, Result]):
    """Runs the tasks of one call of `completed` on an executor; see `completed` for the arguments."""

    def __init__(
        self, work: Callable[[Task], Result], tasks: Sequence[Task], workers: Workers, note: Callable[[str], None]
    ) -> None:
        self._work, self._tasks, self._workers, self._note = work, tasks, workers, note
        self._waiting = deque(range(len(tasks)))
        self._run_alone: deque[int] = deque()
        self._deaths: Counter[int] = Counter()
        self._submitted: dict[Future[Result], int] = {}
        self._executor = workers.open(len(tasks))
        self._has_no_worker = False
        self._lost_count = 0

    def ends(self) -> Iterator[TaskEnd[Result]]:
        """Submit the tasks, and yield the end of each as it completes."""
        try:
            while self._waiting or self._run_alone or self._submitted:
                self._submit()
                done, _ = wait(self._submitted, _POLL_S, FIRST_COMPLETED)
                for future in done:
                    if (end := self._finish(future)) is not None:
                        yield end
                if self._executor.is_broken():
                    if self._submitted:
                        continue  # all futures of a broken executor end soon; wait for them first
                    self._executor.stop()
                    self._executor = self._workers.open(len(self._tasks))
                if self._lost_count:
                    self._note(f"a worker died; {format_count(self._lost_count, 'task')} will be run again")
                    self._lost_count = 0
        finally:
            self._executor.stop()

    def _submit(self) -> None:
        """Submit tasks up to the limit; a task that is run alone waits for all others."""
        capacity = self._executor.capacity()
        if not capacity and not self._has_no_worker:
            self._note(f"no worker is connected to {self._workers.cluster} yet; waiting for one")
        self._has_no_worker = not capacity
        limit = max(_PER_WORKER * capacity, self._executor.MIN_SUBMISSION_LIMIT)
        while not self._executor.is_broken():
            if self._run_alone:
                if self._submitted:
                    return
                tasks = self._run_alone
            else:
                tasks = self._waiting
            if not tasks or len(self._submitted) >= limit:
                return
            try:
                future = self._executor.submit(self._work, self._tasks[tasks[0]])
            except BrokenExecutor:
                return
            self._submitted[future] = tasks.popleft()
            if tasks is self._run_alone:
                return

    def _finish(self, future: Future[Result]) -> TaskEnd[Result] | None:
        """Return the end of the task of a finished future, or None if the task is run again."""
        number = self._submitted.pop(future)
        try:
            return TaskEnd(number, future.result())
        except CancelledError:
            raise LinkError(
                f"the connection to the scheduler {self._workers.cluster} was lost",
                remedy="start the scheduler and its workers, then run the same command again",
            ) from None
        except Exception as error:  # noqa: BLE001 (returned to the caller)
            if not self._executor.is_worker_death(error):
                return TaskEnd(number, error=error)
        self._deaths[number] += 1
        if self._deaths[number] >= MAX_DEATHS:
            remedy = "if memory ran out, use fewer workers: --jobs 1"
            what = f"its worker died {format_count(MAX_DEATHS, 'time')}"
            return TaskEnd(number, error=WorkerDiedError(what, remedy=remedy))
        (self._run_alone if self._deaths[number] >= ALONE_AFTER else self._waiting).appendleft(number)
        self._lost_count += 1
        return None
