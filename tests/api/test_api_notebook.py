"""The notebooks of the documentation run in a Jupyter kernel in their folder, and are stored without outputs."""

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from tests.helpers.paths import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LIMIT_S = 120


def notebook(path: Path) -> Any:  # noqa: ANN401 (nbformat has no type hints)
    return nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs(path: Path) -> None:
    document = notebook(path)
    NotebookClient(document, timeout=LIMIT_S, kernel_name="python3").execute(cwd=str(path.parent))
    counts = [cell.execution_count for cell in document.cells if cell.cell_type == "code"]
    assert counts == [*range(1, len(counts) + 1)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_is_stored_without_outputs(path: Path) -> None:
    code = [cell for cell in notebook(path).cells if cell.cell_type == "code"]
    assert code
    assert all((cell.outputs, cell.execution_count) == ([], None) for cell in code)
