"""Commits exported to separate folders, each with the entry points from its pyproject.toml."""

import io
import os
import re
import subprocess
import sys
import tarfile
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
"""The clone in which the proof runs."""

WORKING_TREE: Final = "the current files"


class UnknownCommitError(Exception):
    """The clone has no such commit."""


@dataclass(frozen=True)
class Tree:
    """An exported commit.

    Attributes:
        folder: Folder of this tree; its path is removed from outputs before comparison.
        commit: The full hash.
    """

    folder: Path
    commit: str

    @property
    def code(self) -> Path:
        """The exported files."""
        return self.folder / "tree"

    @property
    def lab(self) -> Path:
        """The folder in which commands run."""
        return self.folder / "lab"

    @property
    def results(self) -> Path:
        """The folder of recorded outputs."""
        return self.folder / "results"

    def environment(self) -> dict[str, str]:
        """Return an environment in which Python imports this tree, and finds this tree's entry points."""
        path = os.pathsep.join((str(self.folder / "metadata"), str(self.code)))
        fixed = {"PYTHONPATH": path, "COLUMNS": "100", "LC_ALL": "C.UTF-8", "TZ": "UTC", "NO_COLOR": "1"}
        return {key: value for key, value in os.environ.items() if not key.startswith("FIELDKIT")} | fixed


def export(commit: str, folder: Path) -> Tree:
    """Export a commit.

    Args:
        commit: A name that git resolves to a commit; `WORKING_TREE` for the current tracked files.
        folder: Folder to create.

    Raises:
        UnknownCommitError: git cannot resolve `commit`.
    """
    tree = Tree(folder, _resolve(commit))
    tree.code.mkdir(parents=True)
    archive = subprocess.run(
        ("git", "archive", "--format=tar", tree.commit), cwd=ROOT, check=True, stdout=subprocess.PIPE
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(tree.code, filter="data")
    _declare_entry_points(tree)
    return tree


def _resolve(commit: str) -> str:
    if commit == WORKING_TREE:
        # Makes a commit of the changed files without changing the work tree; prints nothing without changes.
        snapshot = subprocess.run(("git", "stash", "create"), cwd=ROOT, check=True, capture_output=True, text=True)
        commit = snapshot.stdout.strip() or "HEAD"
    completed = subprocess.run(
        ("git", "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}"),
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    if completed.returncode != 0:
        raise UnknownCommitError(f"git cannot resolve {commit!r} to a commit")
    return completed.stdout.strip()


def _declare_entry_points(tree: Tree) -> None:
    """Write metadata of an installed package; otherwise Python would use those of the package in the venv."""
    project = tomllib.loads((tree.code / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = {"console_scripts": project.get("scripts", {})} | project.get("entry-points", {})
    lines = [
        line
        for group, entries in groups.items()
        for line in (f"[{group}]", *(f"{key} = {value}" for key, value in entries.items()), "")
    ]
    version = re.search(
        r'^__version__.*?"(.+?)"', (tree.code / "fieldkit" / "__init__.py").read_text(encoding="utf-8"), re.MULTILINE
    )
    number = version[1] if version else "0"
    metadata = tree.folder / "metadata" / f"fieldkit-{number}.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: fieldkit\nVersion: {number}\n", encoding="utf-8"
    )
    (metadata / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")


def python() -> tuple[str, ...]:
    """Return the words that start Python without the current folder in its path."""
    return sys.executable, "-P"
