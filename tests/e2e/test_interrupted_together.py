"""Ctrl-C during simultaneous steps stops all of them, and the repeat is reported as interrupted."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from tests.helpers.host import NamespaceComparison, descendants, wait_for_end
from tests.helpers.labs import BOX, write_procedure
from tests.helpers.runs import finish, only_trial, rows, start
from tests.helpers.texts import procedure, site

pytestmark = pytest.mark.emulated

SITE = site({"box-1": "box", "box-2": "box"})
PROCEDURE = procedure(
    "beside",
    """\
- together:
    during:
      - run: {name: one, robot: sender, argv: [sleep, "300"], limit: 400s}
      - run: {name: other, robot: receiver, argv: [sleep, "300"], limit: 400s}
      - ping: {from: sender, to: receiver, count: 3000, interval: 100ms}
      - wait: {duration: 300s}
""",
    repeats=2,
    attempts=None,
)


def wait_for_all(process: "subprocess.Popen[str]", names: list[str]) -> None:
    """Wait until all of these steps have started, in any order."""
    assert process.stdout is not None
    pending_names = list(names)
    for line in process.stdout:
        if (name := json.loads(line).get("name")) in pending_names:
            pending_names.remove(name)
        if not pending_names:
            return
    raise AssertionError(f"these steps did not start: {pending_names}")


def test_ctrl_c_ends_all_simultaneous_steps(tmp_path: Path, untouched: NamespaceComparison) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    process = start(tmp_path, "trial", write_procedure(tmp_path, PROCEDURE), "5m", "--json")
    try:
        wait_for_all(process, ["sleep", "sleep", "ping", "wait"])
    except BaseException:
        process.terminate()
        finish(process)
        raise
    process_ids = descendants(process.pid)
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    assert any("Ctrl-C again" in line for line in process.stderr)
    process.send_signal(signal.SIGINT)
    stopped_run = finish(process)
    assert stopped_run.code == 130, stopped_run.err
    wait_for_end(process_ids, within_s=60.0)
    untouched()
    (row,) = rows(only_trial(tmp_path))
    assert (row["repeat"], row["status"], row["reason"]) == ("1", "void", "interrupted")
