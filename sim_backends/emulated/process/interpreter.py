"""The Python that runs modules of this package, for the lab's processes and for commands on a robot."""

import sys
from pathlib import Path
from typing import Final

PROJECT: Final = Path(__file__).resolve().parents[3]
"""Folder from which Python imports this package."""


def command(module: str) -> list[str]:
    """Return the command that runs a module of this package, with `PYTHONPATH` set to `PROJECT`.

    Neither the working directory nor a user's site-packages can put another module in its way.
    """
    return [sys.executable, "-P", "-s", "-m", module]
