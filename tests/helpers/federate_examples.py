"""The examples of external federates in docs/examples/federates."""

import runpy
from functools import cache
from pathlib import Path
from typing import Any, Final

from tests.helpers.paths import ROOT

EXAMPLES: Final[Path] = ROOT / "docs" / "examples" / "federates"


@cache
def carts() -> Any:  # noqa: ANN401 (a class of a file that is not a module)
    """Return the class of `carts.py`."""
    return runpy.run_path(str(EXAMPLES / "carts.py"))["Carts"]
