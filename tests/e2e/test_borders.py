"""The harness works without `fieldkit.motion` and `fieldkit.ros`: its tests pass in a copy without these packages."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest

from fieldkit.config import schema
from tests.helpers.casts import PLAIN, los_plan
from tests.helpers.outside_packages import write_package
from tests.helpers.paths import ROOT
from tests.helpers.runs import Run
from tests.helpers.texts import procedure

PACKAGES: Final = ("fieldkit.motion", "fieldkit.ros")
LIMIT_S: Final = 900.0
COPIED: Final = ("fieldkit", "sim_backends", "tests", "robots", "procedures", "pyproject.toml")
REMOVED: Final = ("fieldkit/motion", "fieldkit/ros", "tests/motion", "tests/ros")
SECTIONS: Final = re.compile(r"^(drive|mavlink):.*\n(?:[ \t].*\n)*", re.MULTILINE)
"""Sections of shipped profiles that `fieldkit.motion` defines, with their lines."""
HARNESS_TESTS: Final = (
    "tests/analysis/test_expectations.py",
    "tests/backends/test_backend_registry.py",
    "tests/campaign/test_campaign_plan.py",
    "tests/config/test_misplaced.py",
    "tests/core/test_columns.py",
    "tests/core/test_plugins.py",
    "tests/export/test_export_table.py",
    "tests/measure/evidence/test_measure_host.py",
    "tests/measure/evidence/test_measure_ping.py",
    "tests/measure/evidence/test_recordings.py",
    "tests/measure/transfers/test_measure_udp.py",
    "tests/remote/test_remote_programs.py",
    "tests/report/test_report_headlines.py",
    "tests/steps/kinds/test_step_capture.py",
    "tests/steps/kinds/test_step_transfer.py",
    "tests/steps/test_netcat_pairs.py",
    "tests/steps/test_step_kinds.py",
    "tests/trial/running/test_trial_ledger.py",
    "tests/trial/running/test_trial_opening.py",
    "tests/trial/test_session_jobs.py",
    "tests/trial/test_trial_journal.py",
    "tests/trial/test_trial_rows.py",
    "tests/trial/test_trial_store.py",
)
"""Tests of each package of the harness that take little time."""
STEPS_OF_PRODUCTS: Final = {
    "fly": "{robot: sender, height: 2m, during: [ping: {from: sender, to: receiver}]}",
    "record": "{robot: sender, topics: [/scan], duration: 2s}",
}
PROCEDURE: Final = procedure(
    "KIND",
    """\
- KIND: STEP
""",
    protocols="udp",
    attempts=None,
)


def entry_points() -> Iterator[str]:
    """Yield the lines of the entry points of fieldkit without those of the removed packages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for group, points in {"console_scripts": project["scripts"], **project["entry-points"]}.items():
        yield f"[{group}]"
        yield from (f"{name} = {target}" for name, target in points.items() if not target.startswith(PACKAGES))


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository without the packages and their sections, with metadata as after an installation."""
    folder = tmp_path_factory.mktemp("border")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name)  # with compiled modules, which saves time
        else:
            shutil.copy(ROOT / name, folder)
    for name in REMOVED:
        shutil.rmtree(folder / name)
    for path in (folder / "robots").glob("*.yaml"):
        path.write_text(SECTIONS.sub("", path.read_text(encoding="utf-8")), encoding="utf-8")
    write_package(folder, "fieldkit", "\n".join(entry_points()), version="0.1.0")
    return folder


RUNNER: Final = """
import json, sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from fieldkit.cli import main
for line in sys.stdin:
    folder, words = json.loads(line)
    out, err = StringIO(), StringIO()
    with chdir(folder), redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as end:  # of argparse, after help
            code = end.code
    print(json.dumps([code, out.getvalue(), err.getvalue()]), flush=True)
"""
"""Runs commands of the copy in one process, so that the packages are imported only once."""
Fieldkit = Callable[..., Run]


@pytest.fixture(scope="module")
def run_in(copy: Path) -> Iterator[Fieldkit]:
    """A function that runs `fieldkit` of the copy in a folder."""
    with subprocess.Popen(
        (sys.executable, "-c", RUNNER),
        cwd=copy,  # modules are searched in this folder first
        env=os.environ | {"PYTHONPATH": str(copy)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as runner:

        def run(folder: Path, *words: str) -> Run:
            assert runner.stdin is not None
            assert runner.stdout is not None
            runner.stdin.write(json.dumps([str(folder), words]) + "\n")
            runner.stdin.flush()
            return Run(*json.loads(runner.stdout.readline()))

        yield run


def test_tests_of_the_harness_pass_without_the_products(copy: Path) -> None:
    markers = "not motion and not ros and not emulated and not quiet and not nightly"
    options = ("-q", "-p", "no:cacheprovider", "--hypothesis-profile", "ci", "-m", markers)
    completed = subprocess.run(
        (sys.executable, "-m", "pytest", *options, *HARNESS_TESTS),
        cwd=copy,
        env=os.environ | {"PYTHONPATH": str(copy)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout[-5000:] + completed.stderr[-2000:]


def test_a_trial_is_planned_without_the_products(run_in: Fieldkit, tmp_path: Path) -> None:
    write_procedure(tmp_path, "plain", PLAIN)
    run = run_in(tmp_path, "trial", "plain", "30ft", "--dry-run")
    assert run.code == 0, run.err
    columns_run = run_in(tmp_path, "columns")
    assert columns_run.code == 0, columns_run.err
    assert "rtt_sent" in columns_run.out


@pytest.mark.parametrize(("kind", "step"), STEPS_OF_PRODUCTS.items())
def test_a_step_kind_of_a_removed_package_is_rejected(run_in: Fieldkit, tmp_path: Path, kind: str, step: str) -> None:
    write_procedure(tmp_path, kind, PROCEDURE.replace("KIND", kind).replace("STEP", step))
    run = run_in(tmp_path, "trial", kind, "5m", "--dry-run")
    assert run.code == 2
    assert f"unknown key {kind}" in run.err
    assert "other kinds of step need a package that is not installed" in " ".join(run.err.split())


# The robots of the default lab.
@pytest.mark.parametrize(("profile", "key"), [("turtlebot3_burger", "drive"), ("duckiedrone", "mavlink")])
def test_a_profile_with_a_section_of_the_removed_package_is_rejected(
    run_in: Fieldkit, tmp_path: Path, profile: str, key: str
) -> None:
    (tmp_path / "robots").mkdir()
    shutil.copy(ROOT / "robots" / f"{profile}.yaml", tmp_path / "robots")
    write_procedure(tmp_path, "plain", PLAIN)
    run = run_in(tmp_path, "trial", "plain", "30ft", "--dry-run")
    assert run.code == 2, run.out
    message = f"unknown key {key}; it needs the package fieldkit.motion, which is not installed"
    assert message in " ".join(run.err.split())


def test_a_stored_trial_with_such_a_profile_is_rejected(run_in: Fieldkit, tmp_path: Path) -> None:
    plan = los_plan()
    trial = tmp_path / plan.trial
    trial.mkdir()
    (trial / "trial.yaml").write_text(schema.dump(plan), encoding="utf-8")
    for words in (("resume",), ("rebuild",)):
        run = run_in(tmp_path, *words, str(trial))
        assert run.code == 2, run.out
        assert "it needs the package fieldkit.motion" in " ".join(run.err.split())


def test_a_procedure_with_a_section_of_the_removed_package_is_rejected(run_in: Fieldkit, tmp_path: Path) -> None:
    (tmp_path / "procedures").mkdir()
    text = (ROOT / "procedures" / "los.yaml").read_text(encoding="utf-8").replace("name: los", "name: guarded")
    (tmp_path / "procedures" / "guarded.yaml").write_text(f"{text}on_abort: {{receiver: land}}\n", encoding="utf-8")
    run = run_in(tmp_path, "trial", "guarded", "5m", "--dry-run")
    assert run.code == 2, run.out
    message = "unknown key on_abort; it needs the package fieldkit.motion, which is not installed"
    assert message in " ".join(run.err.split())


@pytest.mark.parametrize("command", ["trial", "resume", "campaign"])
def test_the_permissions_of_the_removed_package_are_not_options(
    run_in: Fieldkit, tmp_path: Path, command: str
) -> None:
    help_text = run_in(tmp_path, command, "--help").out
    assert "--yes" in help_text
    assert "--allow-" not in help_text


def write_procedure(folder: Path, name: str, text: str) -> None:
    (folder / "procedures").mkdir()
    (folder / "procedures" / f"{name}.yaml").write_text(text.replace("name: los", f"name: {name}"), encoding="utf-8")


def test_the_commands_of_the_removed_packages_are_not_listed(run_in: Fieldkit, tmp_path: Path) -> None:
    lines = run_in(tmp_path, "--help").out.splitlines()
    names = {line.split()[0] for line in lines if line.startswith("    ") and line.split()}
    assert "abort" in names
    assert not names & {"bag", "bridge", "middleware", "stop"}
