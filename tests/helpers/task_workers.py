"""Workers that run tasks: a Dask cluster and a SLURM node on loopback, and functions that kill random workers."""

import json
import os
import random
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from tests.helpers.host import descendants, process_file
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until

ENVIRONMENT: Final = {**os.environ, "PYTHONPATH": str(ROOT)}
START_S: Final = 120.0

PAIR: Final = """\
name: pair
summary: two robots and a stream over a fixed link
world: lawn
duration: 100ms
radio: {loss: 10%, delay: 5ms}
policy: {name: sliding_window, window: 10ms}
agents:
  a: {robot: husky, along: 0m, radio: {}}
  b: {robot: husky, along: 10m, radio: {}}
traffic:
  - {kind: stream, name: pose, from: a, to: b, rate: 97Hz, size_bytes: 100}
"""
"""A scenario whose run takes some tens of milliseconds."""


def worker_processes(parent: int) -> list[int]:
    """Return the descendants of a process that run tasks of `multiprocessing`, including Dask workers."""
    return [pid for pid in descendants(parent) if b"spawn_main" in process_file(pid, "cmdline")]


def kill_random(pids: Sequence[int], generator: random.Random) -> bool:
    """Kill a random process of `pids`; return False if there is none."""
    if not pids:
        return False
    with suppress(ProcessLookupError):
        os.kill(generator.choice(sorted(pids)), signal.SIGKILL)
    return True


def sweep_while_workers_die(
    arguments: Sequence[str], folder: Path, end_worker: Callable[[int], bool], *, deaths: int, runs_between: int = 4
) -> tuple[int, list[dict[str, object]], int]:
    """Run `fieldkit cosim sweep`; return its exit code, its events, and the number of terminated workers.

    Args:
        arguments: Arguments after `sweep`.
        folder: Working folder.
        end_worker: Terminates a worker of the process with this id; returns True if there was one.
        deaths: Number of workers to terminate.
        runs_between: Number of runs between two terminations.
    """
    command = [sys.executable, "-m", "fieldkit", "cosim", "sweep", *arguments, "--json"]
    events: list[dict[str, object]] = []
    terminated_count = 0
    with subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            events.append(json.loads(line))
            run_count = sum(event["event"] == "sweep_run_ended" for event in events)
            if terminated_count < deaths and run_count >= (terminated_count + 1) * runs_between:
                terminated_count += end_worker(process.pid)
    return process.returncode, events, terminated_count


@contextmanager
def dask_scheduler(folder: Path) -> Iterator[Path]:
    """Start a Dask scheduler on loopback, and yield its scheduler file."""
    file = folder / "scheduler.json"
    with _dask(folder, "scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)):
        wait_until(file.exists, Deadline.after(START_S))
        yield file


@contextmanager
def dask_cluster(folder: Path, workers: int) -> Iterator[tuple[Path, list[int]]]:
    """Start a Dask cluster on loopback; yield its scheduler file and the process ids of its nannies."""
    with dask_scheduler(folder) as file, ExitStack() as stack:
        nannies = [
            stack.enter_context(_dask(folder, "worker", "--scheduler-file", str(file), "--nthreads", "1"))
            for _ in range(workers)
        ]
        yield file, [nanny.pid for nanny in nannies]


@contextmanager
def _dask(folder: Path, *arguments: str) -> "Iterator[subprocess.Popen[bytes]]":
    log = (folder / f"{arguments[0]}.log").open("ab")
    command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:], "--no-dashboard"]
    with log, subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, stdout=log, stderr=log) as process:
        try:
            yield process
        finally:
            child_pids = descendants(process.pid)
            process.send_signal(signal.SIGINT)
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                for pid in (*child_pids, process.pid):
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)


_SLURM_CONFIGURATION: Final = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort=26817
SlurmdPort=26818
AuthInfo=socket={folder}/munge/socket
SlurmUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=1
KillWait=2
ReturnToService=2
MpiDefault=none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE
"""


@contextmanager
def slurm_node(folder: Path) -> Iterator[dict[str, str]]:
    """Start Debian's SLURM on this machine as its only node, as root; yield the environment for its commands."""
    for name in ("munge", "state", "spool"):
        (folder / name).mkdir(mode=0o700)
    key = folder / "munge" / "key"
    key.write_bytes(random.SystemRandom().randbytes(64))
    key.chmod(0o400)
    configuration = folder / "slurm.conf"
    configuration.write_text(
        _SLURM_CONFIGURATION.format(host=socket.gethostname().split(".")[0], folder=folder, cpus=os.cpu_count()),
        encoding="utf-8",
    )
    environment = {**ENVIRONMENT, "SLURM_CONF": str(configuration)}
    munge = [f"--{name}={folder}/munge/{name}" for name in ("socket", "pid-file", "log-file", "seed-file")]
    programs = (
        ["munged", "--foreground", "--force", f"--key-file={key}", *munge],
        ["slurmctld", "-D"],
        ["slurmd", "-D"],
    )
    with ExitStack() as stack:
        log = stack.enter_context((folder / "slurm.log").open("ab"))
        for command in programs:
            process = stack.enter_context(
                subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=folder)
            )
            stack.callback(process.wait, 60)
            stack.callback(process.terminate)
            if command[0] == "munged":
                wait_until((folder / "munge" / "socket").exists, Deadline.after(START_S))
        wait_until(lambda: "idle" in slurm(environment, "sinfo"), Deadline.after(START_S))
        try:
            yield environment
        finally:
            slurm(environment, "scancel", "--user=root")
            wait_until(lambda: not slurm(environment, "squeue", "--noheader").strip(), Deadline.after(START_S))


def slurm(environment: dict[str, str], *command: str) -> str:
    """Return the output of a command of SLURM."""
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return process.stdout
