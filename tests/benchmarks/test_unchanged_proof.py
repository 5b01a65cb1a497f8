"""The check of unchanged behaviour detects changes in a modified clone, and covers all shipped steps."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from benchmarks.unchanged import structure
from benchmarks.unchanged.items import LAB
from fieldkit.steps import kinds
from tests.helpers.paths import ROOT


def git(folder: Path, *arguments: str) -> str:
    return subprocess.run(
        ("git", "-c", "user.name=test", "-c", "user.email=test@example.org", *arguments),
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
    ).stdout


def prove(clone: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    environment = os.environ | {"PYTHONPATH": str(clone)}
    command = (sys.executable, "-P", "-m", "benchmarks.unchanged", *arguments)
    return subprocess.run(command, cwd=clone, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Return a repository with one commit, which contains the current files of this repository."""
    names = git(ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard").split("\0")
    folder = tmp_path / "clone"
    folder.mkdir()
    for name in names:
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((ROOT / name).read_bytes())
    git(folder, "init", "--quiet")
    git(folder, "add", "--all", "--force")
    git(folder, "commit", "--quiet", "--message", "base")
    return folder


def edit(clone: Path, name: str, old: str, new: str) -> None:
    path = clone / name
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_a_number_is_a_difference_and_a_word_is_a_label(clone: Path) -> None:
    edit(clone, "fieldkit/cli/commands/abort.py", "do not ask; required", "no question; required")
    edit(clone, "fieldkit/cli/__init__.py", "4 evidence not valid", "5 evidence not valid")
    completed = prove(clone, "HEAD", "--only", "help")
    assert completed.returncode == 1
    assert "DIFFERENT help texts: .: fieldkit --help" in completed.stdout
    assert " 1 different" in completed.stdout
    assert " 1 with other labels" in completed.stdout
    assert "CHANGED" in completed.stdout


@pytest.mark.nightly
def test_a_label_passes_and_a_number_does_not(clone: Path) -> None:
    only_help = ("--only", "help")
    edit(clone, "fieldkit/cli/__init__.py", "Field trials of robots", "Outdoor trials of robots")
    completed = prove(clone, "HEAD", *only_help)
    assert completed.returncode == 0, completed.stdout + completed.stderr
    assert "Field  ->  Outdoor" in completed.stdout
    assert " 0 different" in completed.stdout
    edit(clone, "fieldkit/cli/__init__.py", "4 evidence not valid", "5 evidence not valid")
    completed = prove(clone, "HEAD", *only_help)
    assert completed.returncode == 1
    assert "DIFFERENT help texts: .: fieldkit --help" in completed.stdout
    assert "CHANGED" in completed.stdout


def test_an_unknown_commit_is_a_wrong_command_line(clone: Path) -> None:
    completed = prove(clone, "no-such-commit")
    assert (completed.returncode, completed.stdout) == (2, "")
    assert "cannot resolve 'no-such-commit' to a commit" in completed.stderr


def test_every_kind_of_step_is_in_a_dry_run() -> None:
    paths = [*(ROOT / "procedures").glob("*.yaml"), *(LAB / "procedures").glob("*.yaml")]
    used_kinds = {kind for path in paths for kind in steps(yaml.safe_load(path.read_text(encoding="utf-8"))["steps"])}
    assert kinds.shipped_names() <= used_kinds


def steps(step_list: list[dict[str, dict[str, object]]]) -> set[str]:
    """Return the kinds of steps in a list, including nested ones."""
    kinds_of_steps: set[str] = set()
    for step in step_list:
        for kind, keys in step.items():
            nested_steps = keys.get("during", [])
            assert isinstance(nested_steps, list)
            kinds_of_steps |= {kind} | steps(nested_steps)
    return kinds_of_steps


def test_structure_is_counted(tmp_path: Path) -> None:
    files = {
        "fieldkit/a/options.py": "found = 1\nfor one in []:\n    pass\n",
        "fieldkit/b/options.py": '"""Whoever tells; told."""\n',
        "sim_backends/options.py": "class Large:\n" + "".join(f"    def m{n}(self): ...\n" for n in range(13)),
        "sim_backends/__init__.py": "class Small:\n" + "".join(f"    def _m{n}(self): ...\n" for n in range(13)),
        "fieldkit/__init__.py": '"""A package."""\n',
        "docs/a.md": "nobody mends it\n" + "x" * 20_000,
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    numbers = {name: text.partition(";")[0] for name, text in structure.numbers(tmp_path)}
    assert structure.namesakes(tmp_path) == {"options.py": 3}
    assert structure.large_classes(tmp_path) == {"sim_backends/options.py: Large": 13}
    assert numbers == numbers | {
        "lines of code": "33",
        "files per 1,000 lines, without empty `__init__`": "121.21",
        "empty `__init__` files": "1",
        "files over 400 lines": "0",
        "file names used more than twice": "1",
        "classes with over 12 public methods": "1",
        "pages over 20 kB": "1",
        "'tell, told' in code": "2",
        "'who, whoever' in code": "0",
        "'nobody, somebody, anybody' in documentation": "1",
        "'mend' in documentation": "1",
        "loop variables named one": "1",
        "assignments to found": "1",
    }
