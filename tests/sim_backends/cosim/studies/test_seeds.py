"""Many runs in parallel: any order and number of workers, errors that name their run, and no process that remains."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.executors import Workers
from sim_backends.cosim.studies.seeds import Task, run_many
from sim_backends.radio.core.random_streams import RandomStream
from tests.helpers.host import is_running
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until

EXIT_S = 300.0
"""Longest time until processes have started or exited, on a busy machine."""
TASKS = [Task(policy, seed) for policy in ("one", "other") for seed in (3, 1, 2)]


def random_result(task: Task) -> tuple[str, int, float]:
    """Return a result that depends only on the task; tasks that are submitted first take longest."""
    stream = RandomStream(task.seed, task.policy)
    for number in range(0, 3_000 // task.seed, 256):
        stream.draw(number)
    return task.policy, task.seed, stream.draw(0)


def fail_for_seed_2(task: Task) -> int:
    if task.seed == 2:
        raise ConfigurationError("no window", where="at 3 s", remedy="another")
    return task.seed


def divide_by_zero_for_seed_1(task: Task) -> int:
    return 1 // (task.seed - 1)


def kill_worker_for_seed_1(task: Task) -> int:
    if task.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return task.seed


def test_results_are_in_the_order_of_the_tasks() -> None:
    expected = [random_result(task) for task in TASKS]
    progress_counts: list[int] = []
    assert run_many(random_result, TASKS, workers=Workers(2), progress=progress_counts.append) == expected
    assert progress_counts == [1, 2, 3, 4, 5, 6]


@given(st.permutations(TASKS))
def test_one_worker_and_any_order_give_the_same_results(tasks: list[Task]) -> None:
    results = dict(zip(tasks, run_many(random_result, tasks, workers=Workers(1)), strict=True))
    assert [results[task] for task in TASKS] == [random_result(task) for task in TASKS]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_its_policy_and_seed_and_keeps_its_class(workers: int) -> None:
    with pytest.raises(ConfigurationError, match=r"policy one, seed 2: at 3 s: no window\n  remedy: another"):
        run_many(fail_for_seed_2, [Task("one", 1), Task("one", 2)], workers=Workers(workers))
    with pytest.raises(FieldkitError, match="policy one, seed 1: ZeroDivisionError"):
        run_many(divide_by_zero_for_seed_1, [Task("one", 2), Task("one", 1)], workers=Workers(workers))


def test_the_repeated_death_of_a_process_is_an_error() -> None:
    with pytest.raises(FieldkitError, match=r"seed 1: its worker died \d times") as error_info:
        run_many(kill_worker_for_seed_1, TASKS, workers=Workers(2))
    assert "fewer workers" in error_info.value.remedy


ENDLESS = """
import os, sys, time
from pathlib import Path
from fieldkit.core.executors import Workers
from sim_backends.cosim.studies.seeds import Task, run_many

def work(task):
    Path("started", str(os.getpid())).touch()
    while True:
        time.sleep(0.01)
"""


@pytest.mark.parametrize("stop_signal", [signal.SIGINT, signal.SIGKILL])
def test_workers_exit_when_their_parent_exits(stop_signal: signal.Signals, tmp_path: Path) -> None:
    (tmp_path / "endless.py").write_text(ENDLESS, encoding="utf-8")
    started_folder = tmp_path / "started"
    started_folder.mkdir()
    call = (
        "import endless as e; e.run_many(e.work, [e.Task('one', seed) for seed in (1, 2, 3)], workers=e.Workers(2))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", call],
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}"},
        cwd=tmp_path,
        stderr=subprocess.PIPE,
    ) as process:
        wait_until(lambda: len(list(started_folder.iterdir())) == 2, Deadline.after(EXIT_S))
        process.send_signal(stop_signal)
        _, stderr = process.communicate(timeout=EXIT_S)
    assert process.returncode == -stop_signal
    assert (b"KeyboardInterrupt" in stderr) == (stop_signal == signal.SIGINT)
    wait_until(
        lambda: not any(is_running(int(path.name)) for path in started_folder.iterdir()), Deadline.after(EXIT_S)
    )
