"""The example suite of docs/pytest.md, with the plugin installed by a wheel of fieldkit."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.helpers import suites, wheels
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

EXAMPLE = ROOT / "docs" / "examples" / "teleop"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wheels.installed(tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def example(tmp_path: Path) -> Path:
    """The example after a user has copied it."""
    return Path(shutil.copytree(EXAMPLE, tmp_path / "teleop", ignore=shutil.ignore_patterns("__pycache__")))


def test_the_example_passes(python: Path, example: Path) -> None:
    where = subprocess.run(
        (python, "-c", "import fieldkit; print(fieldkit.__file__)"), cwd=example, capture_output=True, check=True
    )
    assert Path(where.stdout.decode().strip()).is_relative_to(python.parents[1])
    done = suites.run(example, python=str(python), beside=())
    assert (done.code, set(done.results.values()), len(done.results)) == (0, {"passed"}, 3), done.output
    assert not (example / "fieldkit-results").exists()
