"""A testbed that dies during a trial stops it; no repeat fails because of that, and `resume` completes the trial."""

import os
import re
import signal
from pathlib import Path

import pytest

from tests.helpers.host import NamespaceComparison, descendants, wait_for_end
from tests.helpers.labs import built_in_ros
from tests.helpers.runs import finish, only_trial, rows, run_here, start, wait_for_line

pytestmark = pytest.mark.emulated

OPTIONS = ("--repeats", "2", "--protocol", "tcp", "--topology", "masterless", "--record", "1s")
TRIAL = ("trial", *OPTIONS, "--json", "los", "30ft")


def process_of(family: set[int], module: str) -> int:
    """Return the process of a family that runs a module; for a robot's processes, the first of its namespace."""

    def runs_it(pid: int) -> bool:
        try:
            return module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):  # it has ended after the family was listed
            return False

    def is_first(pid: int) -> bool:
        return "\t1\n" in re.sub(
            "^(?!NSpid).*\n", "", Path(f"/proc/{pid}/status").read_text(encoding="utf-8"), flags=re.MULTILINE
        )

    running = sorted(filter(runs_it, family))
    return next(filter(is_first, running), running[0])


@pytest.mark.parametrize("victim", ["emulated.medium.process", "emulated.robot.init"])
def test_a_part_that_dies_stops_the_trial_and_resume_completes_it(
    tmp_path: Path, untouched: NamespaceComparison, victim: str
) -> None:
    built_in_ros(tmp_path)
    process = start(tmp_path, *TRIAL)
    wait_for_line(process, '"transfer"')
    family = descendants(process.pid)
    os.kill(process_of(family, victim), signal.SIGKILL)
    stopped = finish(process)
    assert stopped.code == 3, stopped.err
    assert "does not answer: it" in stopped.err
    assert "fieldkit resume" in stopped.err
    assert stopped.events("trial_stopped")
    notes = [event["text"] for event in stopped.events("note")]
    assert not any("stays" in note or "delete it" in note for note in notes), "nothing stays of emulated robots"
    wait_for_end(family, within_s=60.0)
    untouched()
    assert [row["status"] for row in rows(only_trial(tmp_path))] == ["void"]
    resumed = run_here(tmp_path, "resume", str(only_trial(tmp_path)), "--json")
    assert resumed.code == 0, resumed.err
    table = rows(only_trial(tmp_path))
    assert [row["status"] for row in table] == ["void", "valid", "valid"]
    assert run_here(tmp_path, "verify", str(only_trial(tmp_path))).code == 0
