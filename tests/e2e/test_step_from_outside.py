"""A kind of step from another package: the one of docs/add-a-procedure.md, found by its entry point."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.helpers.labs import built_in_ros
from tests.helpers.paths import ROOT
from tests.helpers.runs import only_trial, rows

PAGE = ROOT / "docs" / "add-a-procedure.md"
PROCEDURE = """\
name: busy
summary: How busy is the receiver
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1

steps:
  - load: {robot: receiver}
  - ping: {from: sender, to: receiver, count: 2}
"""

Fieldkit = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def fieldkit(tmp_path: Path) -> Fieldkit:
    """fieldkit beside an installed package with the page's example."""
    page = PAGE.read_text(encoding="utf-8")
    (source,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (entry,) = re.findall(r'^    \[project\.entry-points\."(.*)"\]\n    (\w+) = "(.*)"$', page, re.MULTILINE)
    group, kind, target = entry
    installed = tmp_path / "installed"
    about = installed / "load_step-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: load-step\nVersion: 1.0\n", encoding="utf-8")
    (about / "entry_points.txt").write_text(f"[{group}]\n{kind} = {target}\n", encoding="utf-8")
    (installed / f"{target.partition(':')[0]}.py").write_text(source, encoding="utf-8")
    (tmp_path / "procedures").mkdir()
    (tmp_path / "procedures" / "busy.yaml").write_text(PROCEDURE, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(installed)}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        command = (sys.executable, "-m", "fieldkit", *words)
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=300
        )

    return run


def test_its_columns_and_commands_are_known(fieldkit: Fieldkit) -> None:
    shown = fieldkit("columns", "show", "load_1min")
    assert "Processes that ran or waited on the robot" in shown.stdout, shown.stderr
    planned = fieldkit("trial", "busy", "5m", "--dry-run")
    assert "load: cat /proc/loadavg > load.txt 2> receiver-load.log" in planned.stdout, planned.stderr


def test_a_kind_that_is_not_there_is_refused_with_those_that_are(fieldkit: Fieldkit, tmp_path: Path) -> None:
    path = tmp_path / "procedures" / "busy.yaml"
    path.write_text(PROCEDURE.replace("load:", "lode:"), encoding="utf-8")
    refused = fieldkit("trial", "busy", "5m", "--dry-run")
    assert refused.returncode == 2
    assert "procedures/busy.yaml:9" in refused.stderr
    assert "did you mean 'load'?" in refused.stderr


@pytest.mark.emulated
def test_it_runs_is_judged_measured_and_told(fieldkit: Fieldkit, tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    done = fieldkit("trial", "busy", "5m", "--json")
    assert done.returncode == 0, done.stderr
    folder = only_trial(tmp_path)
    (row,) = rows(folder)
    said = (folder / "repeats" / "tcp-01" / "load.txt").read_text(encoding="ascii")
    assert (row["status"], float(row["load_1min"])) == ("valid", float(said.split()[0]))
    assert f"load {row['load_1min']}" in done.stdout
    assert fieldkit("rebuild", str(folder)).stdout.endswith("the same bytes as before\n")
    (folder / "repeats" / "tcp-01" / "load.txt").write_text("no load\n", encoding="ascii")
    assert fieldkit("rebuild", str(folder)).returncode == 4, "it is not what was summed"
    (folder / "MANIFEST.sha256").unlink()
    assert fieldkit("rebuild", str(folder)).returncode == 0
    assert rows(folder)[0]["load_1min"] == "", "a figure that is not there is empty, and never guessed"
