"""Runs of a sweep per second, compared with a bare process pool: `python -m benchmarks.sweep`.

Each round runs the same simulations on 1 and on 2 processes, with `run_sweep` and with a `ProcessPoolExecutor` that
stores no results, in random order. Then the benchmark measures the cost of an empty task on processes and on a Dask
cluster of two workers, and the cost of the state on disk with many finished runs.
"""

import argparse
import random
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import chdir
from multiprocessing import get_context
from pathlib import Path
from typing import Final

from distributed import LocalCluster

from fieldkit.core.executors import Workers
from fieldkit.core.tasks import completed
from sim_backends.cosim.sweeps.factors import parse_factors
from sim_backends.cosim.sweeps.sweep_dataset import write_dataset
from sim_backends.cosim.sweeps.sweep_folder import SweepFolder
from sim_backends.cosim.sweeps.sweep_plan import SweepPlan, plan_sweep
from sim_backends.cosim.sweeps.sweep_runner import execute, run_sweep

SCENARIO: Final = """\
name: pair
summary: two robots and a stream over Wi-Fi
world: lawn
duration: {duration}
policy: {{name: sliding_window, window: 10ms}}
agents:
  a: {{robot: husky, along: 0m, radio: {{}}}}
  b: {{robot: husky, along: 10m, radio: {{}}}}
traffic:
  - {{kind: stream, name: pose, from: a, to: b, rate: 97Hz, size_bytes: 100}}
"""
COUNTS: Final = (1, 2)
"""Numbers of processes for the runs per second."""
PROCESSES: Final = 2
"""Number of processes for empty tasks."""
WINDOWS: Final = "window=7ms,13ms,17ms,19ms"


def run_empty_task(number: int) -> int:
    """Return the argument, as a task without work."""
    return number


def run_bare(plan: SweepPlan, processes: int) -> None:
    """Run a plan in a bare process pool."""
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        for future in [pool.submit(execute, run) for run in plan.runs]:
            future.result()


def run_sweep_in(plan: SweepPlan, workers: Workers, folder: Path) -> None:
    """Run a plan as `fieldkit cosim sweep` does, with its dataset."""
    state = SweepFolder(folder, "")
    with state.opened(plan):
        run_sweep(plan, state, workers, sink=lambda _: None)
        write_dataset(plan, state)


def timed(action: Callable[[], object]) -> float:
    """Return the wall time of an action in seconds."""
    start_s = time.monotonic()
    action()
    return time.monotonic() - start_s


def runs_per_s(plan: SweepPlan, folder: Path, rounds: int) -> dict[str, list[float]]:
    """Return runs per second by method and number of processes, a value per round."""
    rates: dict[str, list[float]] = {}
    generator = random.Random(1)
    for number in range(rounds):
        for count in COUNTS:
            out = folder / f"{number}-{count}"
            # A sweep with one worker runs in this process. A bare pool of one process must start that process first.
            methods: list[tuple[str, Callable[[], object]]] = [
                ("bare", lambda count=count: run_bare(plan, count)),  # type: ignore[misc]
                ("sweep", lambda count=count, out=out: run_sweep_in(plan, Workers(count), out)),  # type: ignore[misc]
            ]
            generator.shuffle(methods)
            for name, action in methods:
                rates.setdefault(f"{name} {count}", []).append(len(plan.runs) / timed(action))
    return rates


def empty_task_s(workers: Workers, tasks: int) -> float:
    """Return the wall time per empty task, without the start of the workers."""
    results = completed(run_empty_task, range(tasks), workers)
    next(results)  # the workers have started
    return timed(lambda: sum(1 for _ in results)) / (tasks - 1)


def bare_empty_task_s(tasks: int) -> float:
    """Return the wall time per empty task of a bare pool of processes, without their start."""
    with ProcessPoolExecutor(PROCESSES, get_context("spawn")) as pool:
        pool.submit(run_empty_task, 0).result()

        def run_all() -> None:
            for future in [pool.submit(run_empty_task, number) for number in range(tasks)]:
                future.result()

        return timed(run_all) / tasks


def state_costs(plan: SweepPlan, folder: Path) -> dict[str, float]:
    """Return the costs of the state on disk: of a written result, of continuing without work, and of the dataset."""
    state = SweepFolder(folder, "")
    content = execute(plan.runs[0]).content
    with state.opened(plan):
        start_s = time.monotonic()
        for run in plan.runs:
            state.write_result(run, content)
        write_s = (time.monotonic() - start_s) / len(plan.runs)
        continue_s = timed(lambda: run_sweep(plan, state, Workers(PROCESSES), sink=lambda _: None))
        dataset_s = timed(lambda: write_dataset(plan, state))
        return {"to write a result": write_s, "to continue if all are finished": continue_s, "dataset": dataset_s}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=50, help="seeds of each of 4 windows")
    parser.add_argument("--tasks", type=int, default=10_000, help="number of empty tasks")
    parser.add_argument("--duration", default="2s", help="duration of a run")
    arguments = parser.parse_args()
    factors = parse_factors([WINDOWS])
    with tempfile.TemporaryDirectory() as name, chdir(name):
        Path("pair.yaml").write_text(SCENARIO.format(duration=arguments.duration), encoding="utf-8")
        plan = plan_sweep("pair.yaml", factors, range(1, arguments.seeds + 1), {})
        show_rates(runs_per_s(plan, Path("sweeps"), arguments.rounds))
        show_empty("bare pool", arguments.tasks, bare_empty_task_s(arguments.tasks))
        show_empty("processes", arguments.tasks, empty_task_s(Workers(PROCESSES), arguments.tasks))
        memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"largest memory of the submitting process: {memory_mb:.0f} MB", flush=True)
        with LocalCluster(n_workers=PROCESSES, threads_per_worker=1, dashboard_address=None) as cluster:  # type: ignore[no-untyped-call]
            show_empty(
                "dask", arguments.tasks, empty_task_s(Workers(cluster=cluster.scheduler_address), arguments.tasks)
            )
        many = plan_sweep("pair.yaml", factors, range(1, max(arguments.tasks // 4, 1) + 1), {})
        for what, cost_s in state_costs(many, Path("many")).items():
            print(f"{len(many.runs)} runs, {what}: {cost_s:.6f} s", flush=True)


def show_rates(rates: Mapping[str, Sequence[float]]) -> None:
    """Print runs per second, and the ratio of both methods in each round."""
    for key, values in rates.items():
        print(f"{key}: {statistics.median(values):.1f} runs/s ({min(values):.1f} to {max(values):.1f})")
    for count in COUNTS:
        ratios = [ours / bare for ours, bare in zip(rates[f"sweep {count}"], rates[f"bare {count}"], strict=True)]
        print(f"sweep / bare, {count}: {statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})")


def show_empty(method: str, tasks: int, cost_s: float) -> None:
    """Print the cost of an empty task."""
    print(f"{tasks} empty tasks, {method}: {cost_s * 1e6:.0f} us each", flush=True)


if __name__ == "__main__":
    main()
