"""Many runs at once, in processes of their own: the same results in any order, and nothing left behind.

The processes are plain children that get tasks by a pipe. Those of `multiprocessing` would leave its resource tracker
behind for as long as the caller lives, and do not end when the caller is killed.
"""

import os
import pickle
import selectors
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from queue import SimpleQueue
from subprocess import PIPE, Popen
from typing import IO, Any, Final, TypeVar

from fieldkit.core.errors import FieldkitError

Result = TypeVar("Result")

_SERVE: Final = f"from {__name__} import serve; serve()"


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
        try:
            yield number, work(task)
        except Exception as error:
            raise _named(error, task) from error


def _side_by_side(work: Callable[[Task], Any], tasks: Sequence[Task], workers: int) -> Iterator[tuple[int, Any]]:
    """Yield results as they come."""
    waiting = iter(enumerate(tasks))
    with ExitStack() as ends, selectors.DefaultSelector() as ready:
        for number, task in islice(waiting, workers):
            process = ends.enter_context(_process())
            _tell(process, work)
            _tell(process, task)
            ready.register(_stream(process.stdout), selectors.EVENT_READ, (process, number))
        while ready.get_map():
            for key, _ in ready.select():
                process, number = key.data
                yield number, _answer(process, tasks[number])
                following = next(waiting, None)
                if following is None:
                    ready.unregister(process.stdout)
                else:
                    _tell(process, following[1])
                    ready.modify(process.stdout, selectors.EVENT_READ, (process, following[0]))


def _answer(process: "Popen[bytes]", task: Task) -> Any:  # noqa: ANN401 (whatever the work returns)
    try:
        result, error = pickle.load(_stream(process.stdout))  # noqa: S301 (from a process that we started)
    except EOFError:
        remedy = "if memory ran out, use fewer workers"
        raise FieldkitError("its process was killed", where=str(task), remedy=remedy) from None
    if error is not None:
        raise error
    return result


@contextmanager
def _process() -> Iterator["Popen[bytes]"]:
    """Start a process that serves, out of reach of the terminal's Ctrl-C, and end it."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", _SERVE]
    with Popen(command, stdin=PIPE, stdout=PIPE, env=environment, start_new_session=True) as process:
        try:
            yield process
        finally:
            process.kill()
            with suppress(BrokenPipeError):
                _stream(process.stdin).close()


def _tell(process: "Popen[bytes]", what: object) -> None:
    stream = _stream(process.stdin)
    with suppress(BrokenPipeError):  # it died, which is seen where its answer does not come
        stream.write(pickle.dumps(what))
        stream.flush()


def _stream(pipe: IO[bytes] | None) -> IO[bytes]:
    assert pipe is not None
    return pipe


def _named(error: Exception, task: Task) -> FieldkitError:
    """Return an error that names its task."""
    if isinstance(error, FieldkitError):
        error.where = f"{task}: {error.where}" if error.where else str(task)
        return error
    remedy = "this is a fault of the program; a single worker tells where"
    return FieldkitError(f"{type(error).__name__}: {error}", where=str(task), remedy=remedy)


def serve() -> None:
    """Do tasks that come by the standard input, until it ends: whatever ends the caller ends this process too."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what work prints must not get among the answers
    todo: SimpleQueue[Any] = SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, todo), daemon=True).start()
    work = todo.get()
    while True:
        task = todo.get()
        try:
            answer = pickle.dumps((work(task), None))
        except Exception as error:  # noqa: BLE001 (the caller raises it)
            answer = pickle.dumps((None, _named(error, task)))
        answers.write(answer)
        answers.flush()


def _listen(told: IO[bytes], todo: "SimpleQueue[Any]") -> None:
    try:
        while True:
            todo.put(pickle.load(told))  # noqa: S301 (from the process that started this one)
    finally:
        os._exit(0)
