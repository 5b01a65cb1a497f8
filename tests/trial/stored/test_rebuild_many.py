"""Many trials are rebuilt and measured again in several processes, with the results of one."""

from pathlib import Path

from tests.helpers.runs import run_here
from tests.helpers.stored_trials import copy_trials


def test_many_trials_are_measured_in_processes(tmp_path: Path) -> None:
    with copy_trials(tmp_path) as trials:
        rebuilt = run_here(tmp_path, "rebuild", "trials", "--jobs", "2")
        first, second = (
            run_here(tmp_path, "aggregate", "trials", "--rebuild", "--format", "csv", "--jobs", jobs) for jobs in "12"
        )
    assert rebuilt.code == 0, rebuilt.err
    lines = rebuilt.out.splitlines()
    assert sorted(line.partition(": ")[0] for line in lines) == sorted(map(str, trials))
    assert all(
        line.partition(": ")[2] in {"the same bytes as before", "changed: trial.csv, summary.csv"} for line in lines
    )
    assert (second.code, second.out) == (0, first.out)
