"""Commands of other packages: the example of docs/add-a-command.md, and commands that cannot be loaded."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.helpers.paths import DATA, ROOT

PAGE = ROOT / "docs" / "add-a-command.md"
TRIAL = DATA / "fieldkit" / "4" / "trials" / "20261122T013134.573068Z_los_30ft_master"
LIMIT_S = 60.0

Fieldkit = Callable[..., subprocess.CompletedProcess[str]]


def install(folder: Path, package: str, group: str, points: dict[str, str]) -> None:
    metadata = folder / f"{package}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8")
    lines = [f"{name} = {target}" for name, target in points.items()]
    text = "\n".join(["[console_scripts]", "other = worst_command:run", f"[{group}]", *lines, "[last]", "a = b:c"])
    (metadata / "entry_points.txt").write_text(text, encoding="utf-8")


@pytest.fixture
def fieldkit(tmp_path: Path) -> Fieldkit:
    """A function that runs fieldkit with installed packages: the page's example, and broken packages."""
    page = PAGE.read_text(encoding="utf-8")
    (source,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (entry,) = re.findall(r'^    \[project\.entry-points\."(.*)"\]\n    (\w+) = "(.*)"$', page, re.MULTILINE)
    group, name, target = entry
    packages = tmp_path / "installed"
    entry_points = {
        "absent": "no_such_package:add",
        "failing": "failing:add",
        "unfinished": "failing:later",
        name: target,
    }
    install(packages, "worst_command", group, entry_points | {"trial": "failing:add"})
    install(packages, "double", group, {"twice": "double:add"})
    install(packages, "again", group, {"twice": "again:add"})
    (packages / f"{target.partition(':')[0]}.py").write_text(source, encoding="utf-8")
    (packages / "failing.py").write_text(
        "def add(parser):\n    raise RuntimeError('not today')\n\n\n"
        "def later(parser):\n    parser.set_defaults(run='no_such_package:run')\n",
        encoding="utf-8",
    )
    environment = os.environ | {"PYTHONPATH": f"{packages}{os.pathsep}{ROOT}"}

    def run(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
        command = (sys.executable, "-m", "fieldkit", *words)
        return subprocess.run(
            command,
            cwd=tmp_path,
            env=environment | variables,
            capture_output=True,
            text=True,
            check=False,
            timeout=LIMIT_S,
        )

    return run


def test_the_command_runs_with_its_declared_options(fieldkit: Fieldkit) -> None:
    completed = fieldkit("worst", str(TRIAL))
    assert completed.returncode == 0, completed.stderr
    assert completed.stdout.splitlines()[2].split() == ["udp-1", "0.125"]
    assert fieldkit("worst", str(TRIAL), "--by", "rtt_loss").stdout.splitlines()[2].split() == ["udp-2", "0.9"]


def test_its_help_and_errors_look_like_those_of_other_commands(fieldkit: Fieldkit, tmp_path: Path) -> None:
    assert "List the repeats of a trial with the largest loss." in fieldkit("worst", "--help").stdout
    result = fieldkit("worst", str(TRIAL), "--by", "rtt_los")
    assert (result.returncode, result.stderr.count("did you mean 'rtt_loss'?")) == (2, 1), result.stderr
    missing = fieldkit("worst", str(tmp_path))
    assert (missing.returncode, missing.stderr.count("remedy: name a trial")) == (4, 1), missing.stderr


def test_the_help_lists_it_and_the_tab_key_completes_it(fieldkit: Fieldkit, tmp_path: Path) -> None:
    assert re.search(
        r"^ +worst +of worst_command, see fieldkit worst --help$", fieldkit("--help").stdout, re.MULTILINE
    )
    answer = tmp_path / "answer"
    for line, words in (("fieldkit wor", ["worst "]), ("fieldkit worst x --b", ["--by "])):
        variables = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
        fieldkit(**variables, _ARGCOMPLETE_STDOUT_FILENAME=str(answer))
        assert answer.read_text(encoding="utf-8").split("\n") == words, line


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("absent", "entry point absent = no_such_package:add: it cannot be loaded: ModuleNotFoundError"),
        ("failing", "entry point failing = failing:add: its arguments cannot be declared: RuntimeError: not today"),
        ("unfinished", "entry point unfinished = no_such_package:run: it cannot be loaded: ModuleNotFoundError"),
        ("twice", "several packages add a command 'twice': "),
    ],
)
def test_a_broken_package_is_named_when_its_command_is_used(fieldkit: Fieldkit, command: str, message: str) -> None:
    result = fieldkit(command)
    assert result.returncode == 2
    assert result.stderr.startswith(f"error: {message}")
    assert "\n  remedy: " in result.stderr


def test_broken_packages_do_not_affect_other_commands_and_their_names(fieldkit: Fieldkit) -> None:
    assert "usage: fieldkit trial" in fieldkit("trial", "--help").stdout
    assert fieldkit("columns", "show", "ip_loss").returncode == 0
