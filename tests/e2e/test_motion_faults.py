"""Cells of the fault matrix of moving robots (docs/stopping.md) that contain each party and each fault."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.helpers.motion_cells import CELLS, InjectedFault, select_cells
from tests.helpers.motion_outcomes import MotionOutcome
from tests.helpers.motion_parties import Party
from tests.helpers.paths import ROOT

SAMPLE = (
    "rover/agent/pause/out",
    "rover/link/slow/out",
    "rover/fieldkit+operator/stop/out",
    "px4/guard/suspend/climbing",
    "px4/server/kill/there",
    "px4/laptop/suspend/flying",
    "copter/pilot/kill/flying",
    "copter/router/pause/flying",
    "copter/pilot+guard/suspend/there",
    "px4/pilot+guard+server/kill/flying",
    "copter/router+operator/abort/there",
    "copter/operator/ctrl-c/back",
)
IN_CI = ("rover/fieldkit+operator/stop/out", "px4/guard/suspend/climbing", "copter/pilot+guard/suspend/there")
"""The cells that CI runs in parallel, one for each robot; `make nightly` runs the others."""
AT_NIGHT = tuple(name for name in SAMPLE if name not in IN_CI)
JOBS = 3
LIMIT_S = 600


def outcomes_of(names: Sequence[str], folder: Path) -> dict[str, MotionOutcome]:
    """Run several cells in parallel, because trials mostly wait; return the outcomes by the cell's name."""
    results = folder / "results.jsonl"
    words = ("--cells", ",".join(names), "--jobs", str(JOBS), "--results", str(results))
    completed = subprocess.run(
        (sys.executable, "-m", "tests.e2e.motion_faults", *words),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        check=False,
    )
    assert completed.returncode in {0, 1}, completed.stdout + completed.stderr
    lines = Path(results).read_text(encoding="utf-8").splitlines()
    return {outcome.cell: outcome for outcome in map(MotionOutcome.of, lines)}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, MotionOutcome]:
    return outcomes_of(IN_CI, tmp_path_factory.mktemp("matrix"))


@pytest.fixture(scope="module")
def outcomes_at_night(tmp_path_factory: pytest.TempPathFactory) -> dict[str, MotionOutcome]:
    return outcomes_of(AT_NIGHT, tmp_path_factory.mktemp("matrix"))


@pytest.mark.emulated
@pytest.mark.quiet  # the bounds apply to a machine that is not overloaded
@pytest.mark.parametrize("name", IN_CI)
def test_a_robot_stops_within_the_bounds_and_remains_stationary(
    name: str, outcomes: dict[str, MotionOutcome]
) -> None:
    assert outcomes[name].problems == (), outcomes[name]


@pytest.mark.emulated
@pytest.mark.quiet
@pytest.mark.nightly
@pytest.mark.parametrize("name", AT_NIGHT)
def test_a_robot_of_the_nightly_sample_stops_within_the_bounds(
    name: str, outcomes_at_night: dict[str, MotionOutcome]
) -> None:
    assert outcomes_at_night[name].problems == (), outcomes_at_night[name]


def test_the_sample_has_each_party_and_each_fault() -> None:
    assert set(IN_CI) <= set(SAMPLE)
    cells = select_cells(",".join(SAMPLE))
    assert {party for cell in cells for party in cell.parties} == set(Party)
    assert {cell.fault for cell in cells} == set(InjectedFault)
    assert {cell.craft for cell in cells} == {cell.craft for cell in CELLS}
