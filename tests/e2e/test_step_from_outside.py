"""A step kind of another package: the example of docs/add-a-procedure.md, loaded through its entry point."""

import json
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
summary: The interface by which the receiver answers
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1

steps:
  - route: {robot: receiver, to: sender}
  - ping: {from: sender, to: receiver, count: 2}
"""

Fieldkit = Callable[..., subprocess.CompletedProcess[str]]


def install(folder: Path) -> Fieldkit:
    """Install the page's example in a folder; return a function that runs fieldkit in the folder."""
    page = PAGE.read_text(encoding="utf-8")
    (source,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (entry,) = re.findall(r'^    \[project\.entry-points\."(.*)"\]\n    (\w+) = "(.*)"$', page, re.MULTILINE)
    group, kind, target = entry
    packages = folder / "installed"
    metadata = packages / "route_step-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: route-step\nVersion: 1.0\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text(f"[{group}]\n{kind} = {target}\n", encoding="utf-8")
    (packages / f"{target.partition(':')[0]}.py").write_text(source, encoding="utf-8")
    (folder / "procedures").mkdir()
    (folder / "procedures" / "busy.yaml").write_text(PROCEDURE, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": f"{packages}{os.pathsep}{ROOT}", "TMPDIR": str(folder)}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        command = (sys.executable, "-m", "fieldkit", *words)
        return subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=300
        )

    return run


@pytest.fixture
def fieldkit(tmp_path: Path) -> Fieldkit:
    """A function that runs fieldkit with the installed example of the page."""
    return install(tmp_path)


@pytest.fixture(scope="module")
def lab_with_trial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Fieldkit]:
    """A folder with a trial of the example, which tests change in order, and a function that runs fieldkit in it."""
    folder = tmp_path_factory.mktemp("busy")
    fieldkit = install(folder)
    built_in_ros(folder)
    completed = fieldkit("trial", "busy", "5m", "--json")
    assert completed.returncode == 0, completed.stderr
    return folder, fieldkit


def test_its_columns_and_commands_are_available(fieldkit: Fieldkit) -> None:
    output = fieldkit("columns", "show", "route_device")
    assert "Interface to the other robot" in output.stdout, output.stderr
    dry_run = fieldkit("trial", "busy", "5m", "--dry-run")
    assert "route: ip -json route get 10.42.0.1 > route.txt 2> receiver-route.log" in dry_run.stdout, dry_run.stderr


def test_an_unknown_kind_is_rejected_with_the_available_ones(fieldkit: Fieldkit, tmp_path: Path) -> None:
    path = tmp_path / "procedures" / "busy.yaml"
    path.write_text(PROCEDURE.replace("route:", "rout:"), encoding="utf-8")
    result = fieldkit("trial", "busy", "5m", "--dry-run")
    assert result.returncode == 2
    assert "procedures/busy.yaml:9" in result.stderr
    assert "did you mean 'route'? other kinds of step need a package that is not installed" in result.stderr


@pytest.mark.emulated
def test_the_step_runs_and_its_evidence_is_checked_and_measured(lab_with_trial: tuple[Path, Fieldkit]) -> None:
    lab, fieldkit = lab_with_trial
    folder = only_trial(lab)
    (row,) = rows(folder)
    (route,) = json.loads((folder / "repeats" / "tcp-01" / "route.txt").read_text(encoding="ascii"))
    assert (row["status"], row["route_device"]) == ("valid", route["dev"])
    assert fieldkit("rebuild", str(folder)).stdout.endswith("the same bytes as before\n")
    (folder / "repeats" / "tcp-01" / "route.txt").write_text("[]\n", encoding="ascii")
    assert fieldkit("rebuild", str(folder)).returncode == 4, "its checksum no longer matches"
    (folder / "MANIFEST.sha256").unlink()
    rebuilt = fieldkit("rebuild", str(folder))
    assert rebuilt.returncode == 0
    assert rows(folder)[0]["route_device"] == "", "a missing value is empty"
    assert "tcp-01: route.txt: no route_device: " in rebuilt.stderr, "a value was lost"


RAISING_METHODS = """
    def run(self, scene: Scene, *others: object) -> None:
        if scene.repeat == 1:
            raise KeyError('wlan0')
        super().run(scene, *others)

    def argv(self, scene: Scene) -> tuple[str, ...]:
        if scene.repeat == 2:
            raise RuntimeError('no address')
        return ("true",)

    def measure(self, view: object) -> None:
        if view.scene.repeat == 3:
            raise RuntimeError('no route\\nat all')
        return super().measure(view)

    def check(self, view: object) -> None:
        if view.scene.repeat == 4:
            raise OSError('no device')
        return super().check(view)

    def parse(self, output: str) -> None:
        return {"route_device": "wlan0"}
"""


@pytest.mark.emulated
def test_an_attempt_whose_step_raises_fails_with_one_line_and_a_traceback(fieldkit: Fieldkit, tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    with (tmp_path / "installed" / "route_step.py").open("a", encoding="utf-8") as module:
        module.write(RAISING_METHODS)
    completed = fieldkit("trial", "busy", "5m", "--repeats", "5")
    assert (completed.returncode, "Traceback" in completed.stdout + completed.stderr) == (4, False), completed.stderr
    folder = only_trial(tmp_path)
    table = rows(folder)
    assert [(row["attempt"], row["status"]) for row in table] == [("1", "failed")] * 4 + [("1", "valid")]
    measure_error = "the evidence of the step route cannot be measured: "
    lines = [
        "the step route raised KeyError: 'wlan0' ",
        "the step route raised RuntimeError: no address ",
        f"{measure_error}RuntimeError: no route ",
        f"{measure_error}OSError: no device ",
    ]
    for number, (line, row) in enumerate(zip(lines, table, strict=False), start=1):
        assert re.fullmatch(
            re.escape(line) + r"\(route_step.py, line [0-9]+\); traceback in step-error.log", row["reason"]
        ), row["reason"]
        assert row["reason"] in completed.stdout
        log = folder / "repeats" / f"tcp-0{number}.failed1" / "step-error.log"
        assert f"report it to the author of the step, with {log.relative_to(tmp_path)}" in completed.stdout
        assert "route_step.py" in log.read_text(encoding="utf-8")
    assert fieldkit("verify", str(folder)).returncode == 0
    assert fieldkit("rebuild", str(folder)).stdout.endswith("the same bytes as before\n")


@pytest.mark.parametrize(
    ("signature", "line"),
    [
        ("argv(self, scene: Scene)", "the commands of the step route cannot be derived: KeyError: 'wlan0'"),
        ("output_columns(self)", "the step route cannot be planned: KeyError: 'wlan0'"),
    ],
)
def test_a_step_that_raises_in_every_call_is_an_error_before_the_trial(
    fieldkit: Fieldkit, tmp_path: Path, signature: str, line: str
) -> None:
    with (tmp_path / "installed" / "route_step.py").open("a", encoding="utf-8") as module:
        module.write(f"\n    def {signature} -> None:\n        raise KeyError('wlan0')\n")
    for options in ((), ("--dry-run",)):
        result = fieldkit("trial", "busy", "5m", *options)
        assert (result.returncode, "Traceback" in result.stderr) == (2, False)
        assert f"{line} (route_step.py, line" in result.stderr
    (log,) = re.findall(r"report it to the author of the step, with its traceback in (\S+\.log)", result.stderr)
    assert "KeyError: 'wlan0'" in Path(log).read_text(encoding="utf-8")
    assert not (tmp_path / "trials").exists()


@pytest.mark.emulated
def test_a_changed_or_missing_package_of_a_step_is_reported(lab_with_trial: tuple[Path, Fieldkit]) -> None:
    lab, fieldkit = lab_with_trial
    folder = only_trial(lab)
    packages = lab / "installed"
    with (packages / "route_step.py").open("a", encoding="utf-8") as module:
        module.write("\nCHANGED = True\n")
    resume_run = fieldkit("resume", str(folder))
    assert "the code of the step route (route-step 1.0) has changed since the trial was started" in resume_run.stdout
    packages.rename(lab / "elsewhere")
    result = fieldkit("rebuild", str(folder))
    assert (result.returncode, "mend" in result.stderr) == (2, False)
    assert "step kind `route` from route-step 1.0 is not installed" in result.stderr
    assert "install that package with pip" in result.stderr
