"""Many trials are rebuilt and measured in several processes, with the same results as in one."""

from pathlib import Path

from tests.helpers.runs import run_here
from tests.helpers.stored_trials import copy_trials


def test_many_trials_are_measured_in_several_processes(tmp_path: Path) -> None:
    with copy_trials(tmp_path) as trials:
        rebuild_run = run_here(tmp_path, "rebuild", "trials", "--jobs", "2")
        first, second = (
            run_here(tmp_path, "aggregate", "trials", "--rebuild", "--format", "csv", "--jobs", jobs) for jobs in "12"
        )
    assert rebuild_run.code == 0, rebuild_run.err
    lines = rebuild_run.out.splitlines()
    assert sorted(line.partition(": ")[0] for line in lines) == sorted(map(str, trials))
    assert all(
        line.partition(": ")[2] in {"the same bytes as before", "changed: trial.csv, summary.csv"} for line in lines
    )
    assert (second.code, second.out) == (0, first.out)
