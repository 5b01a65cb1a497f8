"""Suites of tests in folders of their own, run by pytest as a command, as those who write them do."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.helpers.paths import ROOT

SITE = """\
backend: emulated
robots:
  rover: {profile: turtlebot3_burger}
  base: {profile: turtlebot3_burger}
roles:
  masterless: {sender: rover, receiver: base}
emulated: {ros: builtin, world: open, radio: {fading: false}}
"""
LIMIT_S = 300.0


@dataclass(frozen=True)
class SuiteRun:
    """A finished run of pytest.

    Attributes:
        code: Its exit code.
        said: What it printed.
        ended: How each test ended, `passed`, `failure` or `error`.
        properties: What was told of each test beside, by name of the property.
    """

    code: int
    said: str
    ended: dict[str, str]
    properties: dict[str, list[tuple[str, str]]]


def command(*words: str, python: str = sys.executable) -> tuple[str, ...]:
    """Return the command that runs the tests of the current folder."""
    return (python, "-m", "pytest", "-p", "no:cacheprovider", *words)


def environment() -> dict[str, str]:
    """Return the environment without what an outer pytest has put there."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}


def write(folder: Path, *, site: str | None = SITE, **files: str) -> None:
    """Write files of tests, by their names without `.py`, and a site file."""
    if site is not None:
        (folder / "fieldkit.yaml").write_text(site, encoding="utf-8")
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")


def run(folder: Path, *words: str, python: str = sys.executable, beside: Sequence[Path] = (ROOT,)) -> SuiteRun:
    """Run the tests of a folder.

    Args:
        folder: The folder.
        words: More words of the command.
        python: The interpreter.
        beside: Folders that it finds modules in.
    """
    report = folder / "junit.xml"
    done = subprocess.run(
        command(f"--rootdir={folder}", f"--junitxml={report}", *words, python=python),
        cwd=folder,
        env=environment() | {"PYTHONPATH": os.pathsep.join(map(str, beside))},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    ended: dict[str, str] = {}
    properties: dict[str, list[tuple[str, str]]] = {}
    for case in ET.parse(report).iter("testcase") if report.exists() else ():
        name = case.attrib["name"]
        ended[name] = next((one.tag for one in case if one.tag in {"failure", "error", "skipped"}), "passed")
        properties[name] = [(one.attrib["name"], one.attrib["value"]) for one in case.iter("property")]
    report.unlink(missing_ok=True)
    return SuiteRun(done.returncode, done.stdout, ended, properties)
