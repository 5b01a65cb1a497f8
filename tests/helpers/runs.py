"""Run fieldkit as its users do: as a command, in a folder of its own."""

import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LIMIT_S = 600.0


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        code: Exit code.
        out: Standard output.
        err: Standard error.
    """

    code: int
    out: str
    err: str

    def events(self, name: str) -> list[dict[str, Any]]:
        """Return the JSON events of one kind."""
        return [event for event in map(json.loads, self.out.splitlines()) if event["event"] == name]


def start(lab: Path, *words: str) -> "subprocess.Popen[str]":
    """Start `fieldkit` with `words` in the folder `lab`."""
    return subprocess.Popen(
        (sys.executable, "-m", "fieldkit", *words),
        cwd=lab,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )


def wait_for_line(process: "subprocess.Popen[str]", text: str) -> None:
    """Return when a started run printed a line with `text`."""
    assert process.stdout is not None
    assert any(text in line for line in process.stdout), f"{text} never came"


def wait_during(process: "subprocess.Popen[str]", condition: Callable[[], bool], *, within_s: float = 90.0) -> None:
    """Return when a condition is true while a started run goes on.

    Raises:
        AssertionError: The run ended before, or the time is over. It says what the run printed, and the run is ended.
    """
    ends_s = time.monotonic() + within_s
    while not condition():
        if process.poll() is not None or time.monotonic() > ends_s:
            why = "in time" if process.poll() is None else "before the run ended"
            process.kill()
            raise AssertionError(f"the condition did not become true {why}: {finish(process)}")
        time.sleep(0.01)


def finish(process: "subprocess.Popen[str]") -> Run:
    """Wait for a started run."""
    try:
        out, err = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return Run(process.returncode, out, err)


def fieldkit(lab: Path, *words: str) -> Run:
    """Run `fieldkit` with `words` in the folder `lab`."""
    return finish(start(lab, *words))


def only_trial(lab: Path) -> Path:
    """Return the one trial folder of a lab."""
    (folder,) = (lab / "trials").iterdir()
    return folder


def rows(trial: Path, name: str = "trial.csv") -> list[dict[str, str]]:
    """Return the rows of a trial's CSV."""
    with (trial / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def total(table: Sequence[dict[str, str]], column: str) -> int:
    """Return the sum over a column of counts; an empty cell is an error."""
    return sum(int(row[column]) for row in table)
