"""fieldkit as its users install it: a wheel in an environment of its own."""

import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from tests.helpers.paths import ROOT

_SOURCES = ("fieldkit", "sim_backends", "robots", "procedures", "docs", ".ci")
_FILES = ("pyproject.toml", "README.md", "LICENSE")


def installed(folder: Path) -> Path:
    """Build fieldkit's wheel, install it, and return the interpreter that has it.

    Everything else comes from the environment that runs the tests: no registry is asked, and it takes 5 s.

    Args:
        folder: Gets sources, wheel and environment.
    """
    source, wheels, venv = (folder / name for name in ("source", "wheels", "venv"))
    for name in _SOURCES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in _FILES:
        shutil.copy(ROOT / name, source / name)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    _run(*pip, "wheel", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(wheels), str(source))
    _run(sys.executable, "-m", "venv", "--without-pip", str(venv))
    python = venv / "bin" / "python"
    (wheel,) = wheels.iterdir()
    _run(*pip, "--python", str(python), "install", "--no-index", "--no-deps", str(wheel))
    (packages,) = (venv / "lib").glob("python*/site-packages")
    # Behind its own packages; the line that makes this checkout importable is not read there.
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n", encoding="utf-8")
    return python


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
