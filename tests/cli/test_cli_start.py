"""Commands import no unneeded library, and copies of values of libraries equal these values."""

import os
import pkgutil
import subprocess
import sys
from collections.abc import Mapping
from inspect import isfunction
from pathlib import Path
from types import ModuleType

import pytest

from fieldkit import __version__
from fieldkit.analysis.compare import PAIRED_BY
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.cli import commands, main, parser, shared_arguments
from fieldkit.cli.commands import compare
from fieldkit.config import documents
from tests.helpers import runs
from tests.helpers.paths import DATA, ROOT
from tests.helpers.runs import fieldkit

LIBRARIES = {
    *("cryptography", "jinja2", "keyring", "matplotlib", "mcap", "numpy", "pandas", "paramiko", "pyarrow"),
    *("pydantic", "rich", "rosbags", "ruamel", "scipy", "sim_backends", "yaml"),
}
PACKAGES = {"analysis", "campaign", "export", "lab", "measure", "remote", "report", "steps", "trial"}
LIMIT_S = 60.0


def modules(package: ModuleType) -> set[str]:
    return {module.name for module in pkgutil.iter_modules(package.__path__)}


def imported_packages(lab: Path, command_line: str, variables: Mapping[str, str] | None = None) -> set[str]:
    """Return the libraries and the packages of fieldkit that a command imports."""
    environment = os.environ | {"PYTHONPROFILEIMPORTTIME": "1", "PYTHONPATH": str(ROOT)} | dict(variables or {})
    completed = subprocess.run(
        (sys.executable, "-m", "fieldkit", *command_line.split()),
        cwd=lab,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    lines = (line for line in completed.stderr.splitlines() if line.startswith("import time:"))
    names = {line.rpartition("|")[2].strip() for line in lines}
    assert "fieldkit.cli.commands" in names, completed.stderr
    packages = {package for package in PACKAGES if f"fieldkit.{package}" in names}
    return packages | {name.partition(".")[0] for name in names} & LIBRARIES


DRY_RUN, EMULATED = "--dry-run", "--repeats 1 --record 1s --yes"
MAX_LINES = {DRY_RUN: 23_000, EMULATED: 35_500}
"""Maximum number of lines of the modules of `fieldkit` and `sim_backends` that a trial of `los` imports, by options.

Lines are counted as by `wc -l`, including docstrings, comments and blank lines.
"""

MOTION = {"fieldkit.motion", "fieldkit.motion.permissions", "fieldkit.motion.profile_sections"}

LIST_MODULES = """
import sys
from fieldkit.cli import main
code = main(["trial", "los", "30ft", *sys.argv[1:]])
modules = {n: m.__file__ for n, m in sys.modules.items() if n.split(".")[0] in {"fieldkit", "sim_backends"}}
print("imported:", *(f"{name}={path}" for name, path in modules.items() if path), sep="\\n")
sys.exit(code)
"""


@pytest.mark.parametrize("options", [DRY_RUN, pytest.param(EMULATED, marks=pytest.mark.emulated)])
def test_a_trial_imports_only_the_kinds_of_step_that_it_uses(tmp_path: Path, options: str) -> None:
    completed = subprocess.run(
        (sys.executable, "-c", LIST_MODULES, *options.split()),
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        stdout=subprocess.PIPE,
        text=True,
        timeout=runs.LIMIT_S,
        check=True,
    )
    modules_text = completed.stdout.partition("imported:\n")[2]
    paths = dict(line.split("=", 1) for line in modules_text.splitlines())
    names = paths.keys()
    kinds = {name for name in names if name.startswith("fieldkit.steps.kinds.")}
    assert kinds == {f"fieldkit.steps.kinds.{kind}" for kind in ("capture", "ping", "transfer")}
    assert {name for name in names if name.startswith("fieldkit.ros.steps.")} <= {
        f"fieldkit.ros.steps.{name}" for name in ("record", "ros_master", "topic_check")
    }
    assert {name for name in names if name.startswith("fieldkit.motion")} == MOTION, (
        "only the sections of the profiles are imported"
    )
    assert sum(Path(path).read_bytes().count(b"\n") for path in paths.values()) <= MAX_LINES[options]


@pytest.mark.parametrize("command_line", ["--version", "--help"])
def test_the_list_of_commands_imports_no_library(tmp_path: Path, command_line: str) -> None:
    assert imported_packages(tmp_path, command_line) == set()


# `stop` is urgent, so its module imports at the top.
@pytest.mark.parametrize("name", [name for name in commands.COMMANDS if name != "stop"])
def test_help_imports_no_slow_library(tmp_path: Path, name: str) -> None:
    """Importing the type names of `rosbags` takes 10 ms."""
    assert imported_packages(tmp_path, f"{name} --help") & LIBRARIES <= {"rich", "rosbags"}


@pytest.mark.parametrize(
    "line", ["fieldkit tr", "fieldkit trial ", "fieldkit trial los 30ft --to", "fieldkit resume "]
)
def test_completion_imports_no_library_but_rich(tmp_path: Path, line: str) -> None:
    variables = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    assert imported_packages(tmp_path, "", variables | {"_ARGCOMPLETE_STDOUT_FILENAME": os.devnull}) & LIBRARIES <= {
        "rich"
    }


def test_mistyped_command_imports_only_rich(tmp_path: Path) -> None:
    assert imported_packages(tmp_path, "trail los 30ft") == {"rich"}


@pytest.mark.parametrize(
    ("command_line", "unneeded_libraries"),
    [
        ("columns", {"paramiko", "matplotlib", "rosbags", "ruamel", "sim_backends"}),
        (
            f"aggregate {DATA / 'fieldkit' / '1' / 'trial.csv'}",
            {"paramiko", "matplotlib", "pandas", "rosbags", "ruamel"},
        ),
        ("trial los 30ft --dry-run", {"paramiko", "matplotlib", "pyarrow", "ruamel"}),
        ("robots", {"paramiko", "matplotlib", "numpy", "pyarrow", "rosbags", "ruamel", "sim_backends"}),
        ("completion bash", LIBRARIES),
    ],
)
def test_command_imports_no_unneeded_library(tmp_path: Path, command_line: str, unneeded_libraries: set[str]) -> None:
    assert not imported_packages(tmp_path, command_line) & unneeded_libraries


def test_stop_imports_only_the_packages_that_connect_to_robots(tmp_path: Path) -> None:
    access = "profile: box, host: 127.0.0.1, port: 1, user: u, host_key: ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIA=="
    (tmp_path / "fieldkit.yaml").write_text(f"robots: {{a: {{{access}}}}}\nroles: {{}}\n", encoding="utf-8")
    required_libraries = {"cryptography", "paramiko", "yaml"}
    assert imported_packages(tmp_path, "stop --all") == required_libraries | {"lab", "remote"}


def test_commands_start_no_openblas_threads(tmp_path: Path) -> None:
    """By default numpy's OpenBLAS starts one thread per core, which spins while idle."""
    script = "import os; from fieldkit.cli import main; main(['columns']); print(*os.listdir('/proc/self/task'))"
    completed = subprocess.run(
        (sys.executable, "-c", script),
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"},
        stdout=subprocess.PIPE,
        text=True,
        timeout=LIMIT_S,
        check=True,
    )
    assert len(completed.stdout.splitlines()[-1].split()) == 1


def test_help_lists_the_default_grouping_columns() -> None:
    assert tuple(shared_arguments.CONDITION.split(",")) == DEFAULT_BY
    assert tuple(compare.PAIRED_BY.split(",")) == PAIRED_BY


def test_the_help_names_the_installed_backends() -> None:
    assert "one of: emulated, field (default:" in " ".join(fieldkit(Path.cwd(), "abort", "--help").out.split())


def test_every_command_has_its_module_and_run_function() -> None:
    top_parser = parser()
    commands_of_fieldkit = commands.COMMANDS.keys() - commands.FROM_ENTRY_POINTS
    for name in commands_of_fieldkit:
        command = top_parser.command(name)
        assert command is not None
        for leaf_parser in map(command.command, command.subcommands()) if command.subcommands() else (command,):
            assert leaf_parser is not None
            run = leaf_parser.get_default("run") or command.get_default(
                "run"
            )  # `show` of a listing has the function of the listing
            assert isfunction(run), leaf_parser.prog
            module = "listings" if name in commands.LISTINGS else name
            assert run.__module__ == f"fieldkit.cli.commands.{module}"
    assert modules(commands) == commands_of_fieldkit - set(commands.LISTINGS) | {"listings"}


@pytest.mark.parametrize(
    ("command_line", "message", "remedy"),
    [
        ("--toplogy", "fieldkit has no option or argument '--toplogy'", "did you mean 'fieldkit check --topology'?"),
        ("--versoin", "fieldkit has no option or argument '--versoin'", "did you mean '--version'?"),
        (
            "trial los 30ft --toplogy master",
            "fieldkit trial has no option or argument '--toplogy'",
            "did you mean '--topology'?",
        ),
        ("trial los 30ft --topology mastr", "--topology cannot be 'mastr'", "did you mean 'master'?"),
        (
            "aggregate x --zzz=1",
            "fieldkit aggregate has no option or argument '--zzz=1'",
            "fieldkit aggregate --help",
        ),
        ("trial los 30ft --width 5%", "fieldkit trial has no option or argument '--width'", "fieldkit trial --help"),
        ("verify x y", "fieldkit verify has no option or argument 'y'", "fieldkit verify --help"),
        ("lab mvoe", "COMMAND cannot be 'mvoe'", "did you mean 'move'?"),
        ("lab move a --by -5m", "--by takes EAST NORTH [UP], not '-5m'", "fieldkit lab move ROBOT --to 20m 10m"),
    ],
)
def test_mistyped_word_suggests_the_right_one(
    command_line: str, message: str, remedy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command_line.split()) == 2
    error_text = capsys.readouterr().err
    assert error_text.startswith(f"error: {message}")
    assert f"\n  remedy: {remedy}" in error_text


def test_the_citation_names_the_version_and_the_paper() -> None:
    citation = documents.read(ROOT / "CITATION.cff").data
    assert citation["version"] == __version__
    title = citation["preferred-citation"]["title"]
    assert title in " ".join((ROOT / "docs" / "index.md").read_text(encoding="utf-8").replace("> ", "").split())
