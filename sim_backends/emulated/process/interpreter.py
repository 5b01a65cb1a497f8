"""The Python interpreter that runs modules of this package, in the lab's processes and in commands on robots."""

import sys
from pathlib import Path
from typing import Final

PROJECT: Final = Path(__file__).resolve().parents[3]
"""Folder from which Python imports this package."""


def command(module: str) -> list[str]:
    """Return the command that runs a module of this package, with `PYTHONPATH` set to `PROJECT`.

    Neither the working directory nor the user's site-packages can shadow modules of this package.
    """
    return [sys.executable, "-P", "-s", "-m", module]
