"""Runs fieldkit as users do, as a command in a separate folder."""

import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fieldkit.cli import main
from fieldkit.core import executors
from fieldkit.trial.plan import PLAN_FILE

LIMIT_S = 600.0


@dataclass(frozen=True)
class Run:
    """A completed run.

    Attributes:
        code: Exit code.
        out: Standard output.
        err: Standard error.
    """

    code: int
    out: str
    err: str

    def events(self, name: str) -> list[dict[str, Any]]:
        """The JSON events of one kind."""
        return [event for event in map(json.loads, self.out.splitlines()) if event["event"] == name]


def cosim(lab: Path, *words: str) -> Run:
    """Run `fieldkit cosim` in this process, in the folder `lab`."""
    return run_here(lab, "cosim", *words)


def start(lab: Path, *arguments: str) -> "subprocess.Popen[str]":
    """Start `fieldkit` with `arguments` in the folder `lab`."""
    return subprocess.Popen(
        (sys.executable, "-m", "fieldkit", *arguments),
        cwd=lab,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )


def wait_for_line(process: "subprocess.Popen[str]", text: str) -> None:
    """Wait until a started run has printed a line with `text`."""
    assert process.stdout is not None
    assert any(text in line for line in process.stdout), f"{text} was not printed"


def wait_during(process: "subprocess.Popen[str]", condition: Callable[[], bool], *, within_s: float = 180.0) -> None:
    """Wait until a condition is true while a started run continues.

    Raises:
        AssertionError: The run ended earlier, or the time limit expired. The message has the output, and the run is
        killed.
    """
    deadline_s = time.monotonic() + within_s
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline_s:
            reason = "in time" if process.poll() is None else "before the run ended"
            process.kill()
            raise AssertionError(f"the condition did not become true {reason}: {finish(process)}")
        time.sleep(0.01)


def finish(process: "subprocess.Popen[str]") -> Run:
    """Wait for a started run to exit."""
    try:
        out, err = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return Run(process.returncode, out, err)


def fieldkit(lab: Path, *arguments: str) -> Run:
    """Run `fieldkit` with `arguments` in the folder `lab`."""
    return finish(start(lab, *arguments))


def run_here(folder: Path, *arguments: str) -> Run:
    """Run `fieldkit` with `arguments` in a folder, in this process, which saves half a second of processor time.

    Tests that need no separate process use it. Without `--jobs`, the command starts no workers, as on one processor.
    Only one thread may run commands, because the working folder and the standard streams belong to the process.
    """
    out, err = StringIO(), StringIO()
    one_processor = patch.object(executors, "usable_processors", return_value=1)
    with chdir(folder), redirect_stdout(out), redirect_stderr(err), one_processor:
        code = main(arguments)
    return Run(code, out.getvalue(), err.getvalue())


def only_trial(lab: Path) -> Path:
    """The only trial of a lab, without folders without a plan, which fieldkit leaves if it is killed early."""
    (plan,) = (lab / "trials").glob(f"*/{PLAN_FILE}")
    return plan.parent


def rows(trial: Path, name: str = "trial.csv") -> list[dict[str, str]]:
    """The rows of a CSV file of a trial."""
    with (trial / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def total(table: Sequence[dict[str, str]], column: str) -> int:
    """The sum of a column of counts; an empty cell is an error."""

    return sum(int(row[column]) for row in table)
