"""A trial that is stopped by Ctrl-C or kill -9 and then resumed has each planned repeat exactly once."""

import json
import signal
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from fieldkit.trial import journal
from tests.helpers.host import NamespaceComparison, descendants, wait_for_end
from tests.helpers.labs import built_in_ros
from tests.helpers.runs import LIMIT_S, Run, finish, only_trial, rows, run_here, start, wait_for_line

pytestmark = pytest.mark.emulated

REPEATS = 2
TRIAL = ("trial", "--repeats", str(REPEATS), "--protocol", "tcp", "--topology", "masterless", "--json", "los", "30ft")


@pytest.fixture(autouse=True)
def _use_builtin_ros(tmp_path: Path) -> None:
    """Use the built-in ROS; `test_trial_emulated` tests kill -9 with Debian's ROS."""
    built_in_ros(tmp_path)


def start_trial(lab: Path, *words: str, until: str) -> "subprocess.Popen[str]":
    """Start a trial, and wait until it has printed a line with `until`."""
    process = start(lab, *TRIAL, *words)
    wait_for_line(process, until)
    return process


def resume(lab: Path) -> Run:
    return run_here(lab, "resume", str(only_trial(lab)), "--json")


def check_complete(lab: Path, repeats: int) -> list[dict[str, str]]:
    """Check the final state of a completed trial, and return its rows."""
    trial = only_trial(lab)
    table = rows(trial)
    valid = Counter((row["protocol"], row["repeat"]) for row in table if row["status"] == "valid")
    assert valid == {("tcp", str(number + 1)): 1 for number in range(repeats)}
    assert all(row["reason"] for row in table if row["status"] != "valid")
    assert run_here(lab, "verify", str(trial)).code == 0
    assert "the same bytes" in run_here(lab, "rebuild", str(trial)).out
    return table


def test_after_the_first_ctrl_c_the_repeat_is_completed_and_resume_continues(
    tmp_path: Path, untouched: NamespaceComparison
) -> None:
    process = start_trial(tmp_path, "--record", "2s", until='"record"')
    process_ids = descendants(process.pid)
    process.send_signal(signal.SIGINT)
    stopped_run = finish(process)
    assert stopped_run.code == 130, stopped_run.err
    assert "Ctrl-C again" in stopped_run.err
    (event,) = stopped_run.events("trial_stopped")
    assert (event["done"], event["total"]) == (1, 2)
    assert tmp_path / event["folder"] == only_trial(tmp_path)
    wait_for_end(process_ids, within_s=60.0)
    untouched()
    (row,) = rows(only_trial(tmp_path))
    assert row["status"] == "valid", "the repeat was completed"
    resume_run = resume(tmp_path)
    assert resume_run.code == 0, resume_run.err
    assert [event["repeat"] for event in resume_run.events("repeat_ended")] == ["tcp-02"]
    assert len(check_complete(tmp_path, REPEATS)) == REPEATS


def test_the_second_ctrl_c_stops_the_repeat_immediately(tmp_path: Path, untouched: NamespaceComparison) -> None:
    process = start_trial(tmp_path, "6m", "7m", "--record", "60s", until='"record"')
    process_ids = descendants(process.pid)
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    assert any("Ctrl-C again" in line for line in process.stderr)
    process.send_signal(signal.SIGINT)
    process.wait(LIMIT_S)
    stopped_run = finish(process)
    assert stopped_run.code == 130
    notes = [note["text"] for note in stopped_run.events("note")]
    assert notes[-1] == "not started: 6m, 7m"
    assert not any("stays" in note or "delete" in note for note in notes), (
        "no files remain, because the robots have been removed"
    )
    wait_for_end(process_ids, within_s=60.0)
    untouched()
    (row,) = rows(only_trial(tmp_path))
    assert (row["status"], row["reason"]) == ("void", "interrupted")
    (unfetched,) = only_trial(tmp_path).glob("repeats/*/sender-unfetched.txt")
    assert "and was removed with the robot" in unfetched.read_text(encoding="utf-8")


def test_a_trial_can_be_resumed_after_kill_9_during_a_repeat(tmp_path: Path) -> None:
    process = start_trial(tmp_path, "--record", "1s", until='"repeat_ended"')
    wait_for_line(process, '"transfer"')
    process_ids = descendants(process.pid)
    process.kill()
    finish(process)
    wait_for_end(process_ids, within_s=60.0)
    trial = only_trial(tmp_path)
    with (trial / journal.JOURNAL_FILE).open("ab") as file:
        file.write(b'{"utc_ns": 17, "proto')  # an incomplete line, as after a crash
    resume_run = resume(tmp_path)
    assert resume_run.code == 0, resume_run.err
    table = check_complete(tmp_path, REPEATS)
    assert [row["status"] for row in table] == ["valid", "void", "valid"]
    assert table[1]["reason"] == "fieldkit was killed during the attempt"
    second_run = resume(tmp_path)
    assert second_run.code == 0, second_run.err
    assert second_run.events("repeat_ended") == [], "no repeat is measured again"


def test_two_processes_cannot_run_one_trial(tmp_path: Path) -> None:
    process = start_trial(tmp_path, "--record", "30s", until='"record"')
    second_run = resume(tmp_path)
    assert second_run.code == 2
    assert "another fieldkit process runs this trial" in second_run.err
    for _ in range(2):
        process.send_signal(signal.SIGINT)
    process.terminate()
    assert finish(process).code == 130


def test_resume_rejects_different_code_a_different_lab_and_a_missing_trial(tmp_path: Path) -> None:
    process = start_trial(tmp_path, "--record", "1s", until='"repeat_ended"')
    process.terminate()
    assert finish(process).code == 130
    trial = only_trial(tmp_path)
    plan = (trial / "trial.yaml").read_text(encoding="utf-8")

    (trial / "trial.yaml").write_text(plan.replace("turtlebot-1", "turtlebot-7"), encoding="utf-8")
    other_lab = resume(tmp_path)
    assert other_lab.code == 2
    assert "sender was turtlebot-7" in other_lab.err

    (trial / "trial.yaml").write_text(plan.replace("code_sha256: ", "code_sha256: 0"), encoding="utf-8")
    other_code = resume(tmp_path)
    assert other_code.code == 2
    assert "other code" in other_code.err

    missing_trial = run_here(tmp_path, "resume", "nowhere")
    assert missing_trial.code == 2
    assert "there is no trial.yaml" in missing_trial.err
    assert json.loads((trial / journal.JOURNAL_FILE).read_text(encoding="utf-8").splitlines()[0])


def test_a_closed_output_pipe_does_not_stop_the_trial(tmp_path: Path) -> None:
    """Ctrl-C in a shell kills `tee` immediately, but fieldkit completes its repeat."""
    process = start_trial(tmp_path, "--record", "1s", until='"record"')
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(LIMIT_S) == 0, process.communicate()[1]
    assert len(check_complete(tmp_path, REPEATS)) == REPEATS
