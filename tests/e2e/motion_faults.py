"""The fault matrix of moving robots, a part of `make soak`; tests/e2e/test_motion_faults.py runs a few of its cells.

`python -m tests.e2e.motion_faults --runs 10 --cells 'rover/*' --jobs 2` prints an outcome per line and then the
tables
of `docs/stopping.md`; `--write docs/stopping.md` also writes the tables to that page. With `--results FILE`, outcomes
are appended to a file, trials in the file are not repeated, and the tables contain all outcomes of the file.
"""

import argparse
import multiprocessing
import os
import random
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Final

from tests.helpers import motion_table
from tests.helpers.motion_cells import CELLS, MotionCell, select_cells
from tests.helpers.motion_lab import motion_lab
from tests.helpers.motion_outcomes import MotionOutcome
from tests.helpers.motion_trials import MotionTrial

_TRIALS_PER_LAB: Final = 50
"""Number of trials after which a worker starts a new lab."""

_Task = tuple[str, int]
"""The name of a cell and a seed."""


def observe(cells: Iterable[tuple[MotionCell, int]]) -> Iterator[MotionOutcome]:
    """Run a trial for each cell and seed in one lab, and yield the outcomes in order."""
    with tempfile.TemporaryDirectory(prefix="fieldkit-motion-") as folder, motion_lab(Path(folder)) as lab:
        for number, (cell, seed) in enumerate(cells):
            trial_folder = Path(folder, f"trial-{number}")
            trial_folder.mkdir()
            yield MotionTrial(lab, cell, trial_folder, seed).run()


def _work(tasks: "Queue[_Task | None]", outcomes: "Queue[str | None]") -> None:
    """Run trials until the queue of tasks yields None; then put None into `outcomes`."""
    cells_by_name = {cell.name: cell for cell in CELLS}

    def next_tasks() -> Iterator[tuple[MotionCell, int]]:
        for _ in range(_TRIALS_PER_LAB):
            task = tasks.get()
            if task is None:
                tasks.put(None)  # for the other workers, and for the next lab
                return
            yield cells_by_name[task[0]], task[1]

    is_finished = False
    try:
        while not is_finished:
            count = 0
            for outcome in observe(next_tasks()):
                count += 1
                outcomes.put(outcome.line())
            is_finished = count < _TRIALS_PER_LAB
    finally:
        outcomes.put(None)


def all_outcomes(tasks: Sequence[_Task], jobs: int) -> Iterator[MotionOutcome]:
    """Yield the outcomes of trials as they end; `jobs` processes run trials in parallel, each in its own lab."""
    context = multiprocessing.get_context("spawn")
    task_queue: Queue[_Task | None] = context.Queue()
    outcome_queue: Queue[str | None] = context.Queue()
    for task in (*tasks, None):
        task_queue.put(task)
    workers = [context.Process(target=_work, args=(task_queue, outcome_queue)) for _ in range(jobs)]
    for worker in workers:
        worker.start()
    running_workers = jobs
    try:
        while running_workers:
            line = outcome_queue.get()
            if line is None:
                running_workers -= 1
            else:
                yield MotionOutcome.of(line)
    finally:
        for worker in workers:
            worker.join()


def main() -> int:
    """Run trials; print the outcomes and the tables."""
    parser = argparse.ArgumentParser(description="fault matrix of moving robots")
    parser.add_argument(
        "--cells", default="*", help="patterns of robot/parties/fault/phase, with commas between them"
    )
    parser.add_argument("--runs", type=int, default=1, help="number of trials of each cell")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="number of labs that run at the same time")
    parser.add_argument("--sample", type=int, default=0, help="number of trials to select at random; 0 for all")
    parser.add_argument("--results", type=Path, help="file to which outcomes are appended")
    parser.add_argument("--write", type=Path, help="page to which the tables are written")
    parser.add_argument("--list", action="store_true", help="list the cells without running trials")
    arguments = parser.parse_args()
    cells = select_cells(arguments.cells)
    if arguments.list:
        print("\n".join(cell.name for cell in cells))
        return 0
    stored_outcomes = _read(arguments.results)
    completed_trials = {(outcome.cell, outcome.seed) for outcome in stored_outcomes}
    tasks = [
        (cell.name, seed)
        for seed in range(arguments.seed, arguments.seed + arguments.runs)
        for cell in cells
        if (cell.name, seed) not in completed_trials
    ]
    random.Random(arguments.seed).shuffle(tasks)
    tasks = tasks[: arguments.sample] if arguments.sample else tasks
    outcomes, start_s = list(stored_outcomes), time.monotonic()
    for outcome in all_outcomes(tasks, arguments.jobs) if tasks else ():
        outcomes.append(outcome)
        if arguments.results:
            with arguments.results.open("a", encoding="utf-8") as file:
                file.write(outcome.line() + "\n")
        times = ", ".join(
            f"{name} {value:.2f} s"
            for name, value in (
                ("first", outcome.begins_s),
                ("ground", outcome.ends_s),
                ("alarm", outcome.alarm_s),
                ("programs ended", outcome.programs_s),
            )
            if value is not None
        )
        print(f"{outcome.cell}: {times or 'continued'} {'; '.join(outcome.problems) and 'BEYOND: '}", end="")
        print("; ".join(outcome.problems), flush=True)
    load = max((outcome.load for outcome in outcomes), default=0.0)
    conditions = (
        f"{datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores, load up to {load:.1f}, {arguments.jobs} at a time"
    )
    text = motion_table.tables(outcomes, conditions)
    print(text)
    if arguments.write:
        motion_table.write(arguments.write, text)
    beyond = sum(bool(outcome.problems) for outcome in outcomes)
    if missing := len(stored_outcomes) + len(tasks) - len(outcomes):
        sys.exit(f"{missing} trials did not end; see the errors above")
    print(f"trials: {len(outcomes)}, beyond their bounds: {beyond}; {time.monotonic() - start_s:.0f} s")
    return int(beyond > 0)


def _read(path: Path | None) -> list[MotionOutcome]:
    if path is None or not path.exists():
        return []
    return [MotionOutcome.of(line) for line in path.read_text(encoding="utf-8").splitlines()]


if __name__ == "__main__":
    sys.exit(main())
