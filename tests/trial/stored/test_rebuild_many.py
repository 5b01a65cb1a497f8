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


def test_a_note_reports_valid_repeats_that_lack_values_after_a_new_measurement(tmp_path: Path) -> None:
    """Both `aggregate --rebuild` and `rebuild` show the note. `rebuild` needs a trial without a manifest."""
    with copy_trials(tmp_path) as trials:
        trial = tmp_path / trials[0]
        capture = min(trial.glob("repeats/*/receiver.pcap"))
        capture.unlink()
        (trial / "MANIFEST.sha256").unlink()
        aggregated, rebuilt = (
            run_here(tmp_path, *command, str(trials[0])) for command in (("aggregate", "--rebuild"), ("rebuild",))
        )
    assert (aggregated.code, rebuilt.code) == (0, 0), (aggregated.err, rebuilt.err)
    expected = f"{trials[0]}: valid repeats may lack values now: {capture.parent.name}: "
    for run in (aggregated, rebuilt):
        assert expected in " ".join(run.err.split()), run.err
