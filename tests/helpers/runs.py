"""Run fieldkit as its users do: as a command, in a folder of its own."""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Sequence
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
