"""fieldkit as installed by its users: a wheel in a separate virtual environment."""

import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from tests.helpers.paths import ROOT

_SOURCES = ("fieldkit", "sim_backends", "robots", "procedures", "docs", ".ci")
_FILES = ("pyproject.toml", "README.md", "LICENSE")


def install_wheel(folder: Path) -> Path:
    """Build the wheel of fieldkit and install it; return the interpreter of the environment.

    All dependencies come from the environment of the tests, so no package registry is used. This takes about 5 s.

    Args:
        folder: Folder for the sources, the wheel and the environment.
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
    # Packages of the environment take precedence; .pth files in this path, such as the checkout's, are ignored.
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n", encoding="utf-8")
    return python


def _run(*command: str) -> None:
    completed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert completed.returncode == 0, completed.stdout + completed.stderr
