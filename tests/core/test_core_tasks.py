"""Tasks on an executor: few are submitted at a time, lost tasks are run again, and a cluster is optional."""

import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from typing_extensions import override

from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.core.executors import Workers
from fieldkit.core.processes import WorkerExecutor
from fieldkit.core.tasks import MAX_DEATHS, TaskEnd, completed


class ScriptedWorkers(WorkerExecutor):
    """Two workers that finish their tasks when four are submitted. Records the largest number of submitted tasks."""

    def __init__(self, *, cancels: bool = False) -> None:
        self.max_submitted = 0
        self.capacities = [0, 2]
        self._cancels = cancels
        self._open: list[tuple[Future[Any], Callable[[], Any]]] = []

    @override
    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._open.append((future, lambda: fn(*args, **kwargs)))
        self.max_submitted = max(self.max_submitted, len(self._open))
        if len(self._open) == 4 or self._cancels:
            for open_future, call in self._open:
                if self._cancels:
                    open_future.cancel()
                    open_future.set_running_or_notify_cancel()
                else:
                    open_future.set_result(call())
            self._open.clear()
        return future

    @override
    def capacity(self) -> int:
        return self.capacities.pop(0) if len(self.capacities) > 1 else self.capacities[0]

    @override
    def is_worker_death(self, error: BaseException) -> bool:
        return False

    @override
    def is_broken(self) -> bool:
        return False

    @override
    def stop(self) -> None:
        self.capacities = [-1]


def use_executor(monkeypatch: pytest.MonkeyPatch, executor: ScriptedWorkers) -> Workers:
    monkeypatch.setattr(Workers, "open", lambda *_: executor)
    return Workers(cluster="tcp://scripted:1")


def test_many_tasks_are_submitted_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    executor, notes = ScriptedWorkers(), list[str]()
    task_ends = list(completed(abs, range(4_000), use_executor(monkeypatch, executor), notes.append))
    assert sorted(task_end.number for task_end in task_ends) == list(range(4_000))
    assert all(task_end.result == task_end.number for task_end in task_ends)
    assert executor.max_submitted == 4
    assert notes == ["no worker is connected to tcp://scripted:1 yet; waiting for one"]
    assert executor.capacities == [-1], "the executor is stopped"


def test_a_lost_scheduler_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LinkError, match="tcp://scripted:1 was lost"):
        list(completed(abs, range(4), use_executor(monkeypatch, ScriptedWorkers(cancels=True))))


def kill_process_once(path: Path) -> str:
    """Kill this process unless the file exists."""
    if path.name == "stays" or path.exists():
        return path.name
    path.touch()
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def test_a_task_whose_process_was_killed_is_run_again(tmp_path: Path) -> None:
    notes: list[str] = []
    tasks = [tmp_path / "stays", tmp_path / "dies", tmp_path / "stays"]
    task_ends = list(completed(kill_process_once, tasks, Workers(2), notes.append))
    assert sorted((task_end.number, task_end.result) for task_end in task_ends) == [
        (0, "stays"),
        (1, "dies"),
        (2, "stays"),
    ]
    assert any("a worker died" in note for note in notes)
    assert MAX_DEATHS > 1


def test_an_error_of_a_task_is_returned_and_the_other_tasks_run() -> None:
    failed_end, second_end = completed(lambda number: 1 // number, [0, 2], Workers(1))
    assert isinstance(failed_end.error, ZeroDivisionError)
    assert second_end == TaskEnd(1, 0)


def test_a_cluster_without_its_package_names_the_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "fieldkit.core.cluster", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigurationError, match="needs the package distributed") as error_info:
        Workers(cluster="tcp://127.0.0.1:1").open(1)
    assert error_info.value.remedy == 'pip install "fieldkit[cluster]"'
