"""A trial stops if its testbed is killed; no repeat counts as failed, and `resume` completes the trial."""

import os
import re
import signal
from pathlib import Path

import pytest

from tests.helpers.host import NamespaceComparison, descendants, process_file, wait_for_end
from tests.helpers.labs import built_in_ros
from tests.helpers.runs import finish, only_trial, rows, run_here, start, wait_for_line

pytestmark = pytest.mark.emulated

OPTIONS = ("--repeats", "2", "--protocol", "tcp", "--topology", "masterless", "--record", "1s")
TRIAL = ("trial", *OPTIONS, "--json", "los", "30ft")


def find_process(process_ids: set[int], module: str) -> int:
    """Return the process that runs a module; for a robot's processes, the first process of its namespace."""

    def runs_module(pid: int) -> bool:
        return module.encode() in process_file(pid, "cmdline")

    def is_first(pid: int) -> bool:
        return b"\t1\n" in re.sub(b"^(?!NSpid).*\n", b"", process_file(pid, "status"), flags=re.MULTILINE)

    module_pids = sorted(filter(runs_module, process_ids))
    return next(filter(is_first, module_pids), module_pids[0])


@pytest.mark.parametrize("victim", ["emulated.medium.process", "emulated.robot.init"])
def test_a_trial_stops_if_a_part_of_the_testbed_is_killed_and_resume_completes_it(
    tmp_path: Path, untouched: NamespaceComparison, victim: str
) -> None:
    built_in_ros(tmp_path)
    process = start(tmp_path, *TRIAL)
    wait_for_line(process, '"transfer"')
    process_ids = descendants(process.pid)
    os.kill(find_process(process_ids, victim), signal.SIGKILL)
    stopped_run = finish(process)
    assert stopped_run.code == 3, stopped_run.err
    assert "does not answer: it" in stopped_run.err
    assert "fieldkit resume" in stopped_run.err
    assert stopped_run.events("trial_stopped")
    notes = [event["text"] for event in stopped_run.events("note")]
    assert not any("stays" in note or "delete it" in note for note in notes), "no files of emulated robots remain"
    wait_for_end(process_ids, within_s=60.0)
    untouched()
    assert [row["status"] for row in rows(only_trial(tmp_path))] == ["void"]
    resume_run = run_here(tmp_path, "resume", str(only_trial(tmp_path)), "--json")
    assert resume_run.code == 0, resume_run.err
    table = rows(only_trial(tmp_path))
    assert [row["status"] for row in table] == ["void", "valid", "valid"]
    assert run_here(tmp_path, "verify", str(only_trial(tmp_path))).code == 0
