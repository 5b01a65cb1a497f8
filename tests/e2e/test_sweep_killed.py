"""A sweep whose workers are killed has the same result as on one core, and repeats no completed run."""

import json
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from tests.helpers.host import is_running
from tests.helpers.nightly import mark_nightly
from tests.helpers.runs import run_here
from tests.helpers.sshd import wait_until
from tests.helpers.task_workers import (
    ENVIRONMENT,
    PAIR,
    dask_cluster,
    dask_scheduler,
    kill_random,
    slurm,
    slurm_node,
    sweep_while_workers_die,
    worker_processes,
)

SWEEP = ("pair.yaml", "--over", "policy=sliding_window,scheduled", "window=7ms,13ms", "--seeds", "8")
RUNS = 32


def dataset(folder: Path) -> dict[str, bytes]:
    """Return the bytes of each file of a sweep's dataset."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.glob("results/**/*.parquet")}


def finished_runs(folder: Path) -> dict[str, float]:
    """Return the time of the last change of each result."""
    return {path.name: path.stat().st_mtime for path in folder.glob("runs/*.json")}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    (folder / "pair.yaml").write_text(PAIR, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def one_core(lab: Path) -> Mapping[str, bytes]:
    """The dataset of the sweep, from one core without interruption."""
    sweep_run = run_here(lab, "cosim", "sweep", *SWEEP, "--jobs", "1", "-o", "one")
    assert (sweep_run.code, f"{RUNS} of {RUNS} runs are done" in sweep_run.out) == (0, True), sweep_run.err
    assert len(finished_runs(lab / "one")) == RUNS
    return dataset(lab / "one")


def test_a_sweep_is_completed_although_processes_are_killed(lab: Path, one_core: Mapping[str, bytes]) -> None:
    generator = random.Random(1)
    code, events, deaths = sweep_while_workers_die(
        [*SWEEP, "--jobs", "2", "-o", "local"],
        lab,
        lambda pid: kill_random(worker_processes(pid), generator),
        deaths=3,
    )
    assert (code, deaths, events[-1]["done"]) == (0, 3, RUNS)
    assert any("a worker died" in str(event.get("text")) for event in events)
    assert dataset(lab / "local") == one_core


def test_a_sweep_is_completed_although_workers_of_dask_are_killed(
    lab: Path, one_core: Mapping[str, bytes], tmp_path: Path
) -> None:
    generator = random.Random(2)
    with dask_cluster(tmp_path, 2) as (scheduler, nannies):

        def end_worker(_: int) -> bool:
            return kill_random([pid for nanny in nannies for pid in worker_processes(nanny)], generator)

        code, events, deaths = sweep_while_workers_die(
            [*SWEEP, "--cluster", str(scheduler), "-o", "dask"], lab, end_worker, deaths=2
        )
    assert (code, deaths, events[-1]["done"]) == (0, 2, RUNS)
    assert dataset(lab / "dask") == one_core


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("slurmctld") is None, reason="needs slurm-wlm and munge of Debian")
def test_a_sweep_is_completed_although_slurm_jobs_are_cancelled(
    lab: Path, one_core: Mapping[str, bytes], tmp_path: Path
) -> None:
    generator = random.Random(3)
    with slurm_node(tmp_path) as environment, dask_scheduler(tmp_path) as scheduler:
        worker = f"exec {sys.executable} -m distributed.cli.dask_worker --scheduler-file {scheduler} --nthreads 1"
        job = tmp_path / "worker.sh"
        job.write_text(f"#!/bin/sh\n{worker} --no-dashboard\n", encoding="utf-8")
        slurm(environment, "sbatch", "--array=1-20%2", f"--output={tmp_path}/job-%a.log", str(job))

        def end_worker(_: int) -> bool:
            jobs = slurm(environment, "squeue", "--noheader", "--states=R", "--format=%i").split()
            return bool(jobs) and slurm(environment, "scancel", generator.choice(jobs)) == ""

        code, events, deaths = sweep_while_workers_die(
            [*SWEEP, "--cluster", str(scheduler), "-o", "slurm"], lab, end_worker, deaths=2
        )
    assert (code, deaths, events[-1]["done"]) == (0, 2, RUNS)
    assert dataset(lab / "slurm") == one_core


@pytest.mark.parametrize("signal_number", mark_nightly([signal.SIGINT, signal.SIGKILL]))
def test_a_stopped_sweep_can_be_continued_and_repeats_no_run(
    signal_number: signal.Signals, lab: Path, one_core: Mapping[str, bytes]
) -> None:
    out = f"stopped-{signal_number.name}"
    command = [sys.executable, "-m", "fieldkit", "cosim", "sweep", *SWEEP, "--jobs", "2", "-o", out]
    with subprocess.Popen(command, cwd=lab, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        wait_until(lambda: len(finished_runs(lab / out)) >= 3, Deadline.after(120))
        workers = worker_processes(process.pid)
        process.send_signal(signal_number)
        _, messages = process.communicate(timeout=60)
    previous_runs = finished_runs(lab / out)
    assert 3 <= len(previous_runs) < RUNS
    wait_until(lambda: not any(map(is_running, workers)), Deadline.after(60))
    if signal_number is signal.SIGINT:
        assert process.returncode == 130
        assert f"to continue: fieldkit cosim sweep {' '.join(SWEEP[:-2])}" in messages
        assert "Traceback" not in messages
    sweep_run = run_here(lab, "cosim", "sweep", *SWEEP, "--jobs", "1", "-o", out, "--json")
    assert sweep_run.code == 0, sweep_run.err
    planned_event = json.loads(sweep_run.out.splitlines()[0])
    assert (planned_event["event"], planned_event["done"]) == ("sweep_planned", len(previous_runs))
    assert {name: at for name, at in finished_runs(lab / out).items() if name in previous_runs} == previous_runs
    assert dataset(lab / out) == one_core


def test_a_completed_sweep_is_not_run_again(lab: Path, one_core: Mapping[str, bytes]) -> None:
    run = partial(run_here, lab, "cosim", "sweep", *SWEEP, "--jobs", "1", "-o", "one")
    second_run = run()
    assert (second_run.code, "32 are done" in second_run.out) == (0, True)
    assert dataset(lab / "one") == one_core
