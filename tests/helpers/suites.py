"""Test suites in separate folders, run with the pytest command as their authors would run them."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.helpers import texts
from tests.helpers.paths import ROOT

SITE = texts.site(
    {"rover": "turtlebot3_burger", "base": "turtlebot3_burger"},
    emulated="ros: builtin, world: open, radio: {fading: false}",
)
LIMIT_S = 300.0


@dataclass(frozen=True)
class SuiteRun:
    """A completed run of pytest.

    Attributes:
        code: Exit code.
        output: Output.
        results: Result of each test: `passed`, `failure` or `error`.
        properties: Recorded properties of each test, as pairs of name and value.
    """

    code: int
    output: str
    results: dict[str, str]
    properties: dict[str, list[tuple[str, str]]]


def command(*arguments: str, python: str = sys.executable) -> tuple[str, ...]:
    """The command that runs the tests of the current folder."""
    return (python, "-m", "pytest", "-p", "no:cacheprovider", *arguments)


def environment() -> dict[str, str]:
    """The environment without the variables of an outer pytest."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}


def write(folder: Path, *, site: str | None = SITE, **files: str) -> None:
    """Write test files, given by their names without `.py`, and a site file."""
    if site is not None:
        (folder / "fieldkit.yaml").write_text(site, encoding="utf-8")
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")


def run(
    folder: Path, *words: str, python: str = sys.executable, import_folders: Sequence[Path] = (ROOT,)
) -> SuiteRun:
    """Run the tests of a folder.

    Args:
        folder: The folder.
        words: Additional arguments of pytest.
        python: The interpreter.
        import_folders: Folders in which the interpreter finds modules.
    """
    report = folder / "junit.xml"
    completed = subprocess.run(
        command(f"--rootdir={folder}", f"--junitxml={report}", *words, python=python),
        cwd=folder,
        env=environment() | {"PYTHONPATH": os.pathsep.join(map(str, import_folders))},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    results: dict[str, str] = {}
    properties: dict[str, list[tuple[str, str]]] = {}
    for case in ET.parse(report).iter("testcase") if report.exists() else ():
        name = case.attrib["name"]
        results[name] = next(
            (element.tag for element in case if element.tag in {"failure", "error", "skipped"}), "passed"
        )
        properties[name] = [(element.attrib["name"], element.attrib["value"]) for element in case.iter("property")]
    report.unlink(missing_ok=True)
    return SuiteRun(completed.returncode, completed.stdout, results, properties)
