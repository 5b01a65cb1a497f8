"""The example `convoy`, with real ROS 2 nodes in a lab on the co-simulation, compared with the scenario `convoy`."""

import json
import math
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow.parquet as pq
import pytest

from fieldkit.core.deadline import Deadline
from sim_backends.cosim.studies.intervals import Floats
from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT
from tests.helpers.runs import fieldkit, run_here, start
from tests.helpers.sshd import wait_until

# A robot that waits for a processor for 0.5 s moves differently from the one of the scenario by up to 0.3 m.
pytestmark = [pytest.mark.emulated, pytest.mark.quiet]

EXAMPLE: Final = ROOT / "docs" / "examples" / "convoy"
ROS2: Final = shlex.quote(str(ROOT / ".ros2" / "bin" / "python"))
LEGS: Final = {"short": ("5:0.4", "6:1"), "all": ()}
"""Arguments of `lead.py`: the first two legs of the scenario, or none for all legs."""
STANDSTILL_M: Final = 2.0
HEADWAY_S: Final = 1.0
PLACE_ERROR_M: Final = 0.1
"""Largest difference of the gap at the same position of the leader. The controllers (20 Hz) and the states of the
leader (9.7 Hz) of both convoys are not synchronized, so the follower reacts up to 0.15 s earlier or later. In this
time, the gap changes by up to 0.09 m at the largest change of speed, 0.6 m/s."""
MEAN_ERROR_M: Final = 0.06
"""Largest difference of the mean error of spacing."""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """A running lab of the example, with the programs on its robots. All odometry starts at 0."""
    folder = tmp_path / "convoy"
    shutil.copytree(EXAMPLE, folder)
    assert fieldkit(folder, "lab", "up").code == 0
    try:
        (folder / "lab.ssh").write_text(run_here(folder, "lab", "ssh-config").out, encoding="utf-8")
        for robot, program in (("leader", "lead.py"), ("follower", "follow.py")):
            subprocess.run(("scp", "-q", "-F", "lab.ssh", program, f"{robot}:"), cwd=folder, check=True)
        yield folder
    finally:
        assert run_here(folder, "lab", "down").code == 0


def places_m(folder: Path) -> Floats:
    """Return the positions of leader and follower, shape (2, 2), metres east and north."""
    lab_state = json.loads(run_here(folder, "lab", "ps", "--json").out)
    places = {robot["name"]: robot["place_m"][:2] for robot in lab_state["robots"]}
    return np.array([places["leader"], places["follower"]], dtype=np.float64)


def drive(folder: Path, legs: tuple[str, ...]) -> tuple[Floats, list[str]]:
    """Drive the convoy; return the positions of both robots, shape (times, 2, 2), and the output of the follower."""
    for robot, east in (("leader", "20m"), ("follower", "18m")):
        assert run_here(folder, "lab", "move", robot, "--to", east, "12m").code == 0
    log = folder / "follow.log"
    with log.open("w", encoding="utf-8") as file:
        words = ("-F", "lab.ssh", "follower", f"timeout 300 {ROS2} follow.py 2")
        with subprocess.Popen(("ssh", *words), cwd=folder, stdout=file, stderr=subprocess.DEVNULL) as follower:
            wait_until(lambda: "gap 2.00" in log.read_text(encoding="utf-8"), Deadline.after(90))
            leader = start(folder, "lab", "shell", "leader", f"timeout 300 {ROS2} lead.py {' '.join(legs)}")
            samples = []
            while leader.poll() is None:
                samples.append(places_m(folder))
            assert "driving" in leader.communicate()[0]
            wait_until(lambda: gap_m(places_m(folder)) < STANDSTILL_M + 0.05, Deadline.after(60))
            fieldkit(folder, "lab", "shell", "follower", "pkill -f follow.py")
            follower.wait(60)
    return np.array(samples), log.read_text(encoding="utf-8").splitlines()


def gap_m(places: Floats) -> float:
    return float(math.dist(*places))


def spacing_errors_m(lines: list[str]) -> Floats:
    """Return the errors of spacing while the follower moves, from the gap and the speed in each line."""
    values = np.array([[*map(float, re.findall(r"\d+\.\d+", line))] for line in lines if line.startswith("gap")])
    gaps_m, speeds_m_s = values.T
    moving = np.flatnonzero(speeds_m_s > 0.01)
    errors_m: Floats = gaps_m - STANDSTILL_M - HEADWAY_S * speeds_m_s
    return errors_m[moving[0] : moving[-1]]


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> tuple[Floats, float]:
    """Positions of leader and follower in the scenario, shape (times, 2, 2), and its mean error of spacing."""
    folder = tmp_path_factory.mktemp("scenario")
    run = run_here(folder, "cosim", "run", "convoy", "--out", "recorded")
    assert run.code == 0, run.err
    table = pq.read_table(folder / "recorded" / "states").to_pydict()
    by_agent: dict[str, dict[int, list[float]]] = {}
    for at_ns, agent, position_m in zip(table["at_ns"], table["agent"], table["position_m"], strict=True):
        by_agent.setdefault(agent, {})[at_ns] = position_m[:2]
    leader, follower = by_agent["leader"], by_agent["follower"]
    places = np.array([[leader[at_ns], follower[at_ns]] for at_ns in sorted(leader)])
    mean_match = re.search(r"spacing \(cm\).*\n\s*─+\n\s*(?P<mean>[\d.]+)", run.out)
    assert mean_match is not None, run.out
    return places, float(mean_match["mean"]) / 100


@pytest.mark.parametrize("legs", mark_nightly(LEGS))
def test_a_convoy_over_ros_moves_like_the_convoy_of_the_scenario(
    legs: str, folder: Path, scenario: tuple[Floats, float]
) -> None:
    positions_m, lines = drive(folder, LEGS[legs])
    simulated_m, mean_error_m = scenario
    start_m, end_m = positions_m[0, 0, 0], positions_m[-1, 0, 0]
    assert end_m - start_m > 7.5
    simulated_gaps_m = np.array([gap_m(places) for places in simulated_m])
    compared_m = positions_m[(positions_m[:, 0, 0] > start_m + 0.2) & (positions_m[:, 0, 0] < end_m - 0.3)]
    assert len(compared_m) >= 10
    expected_m = np.interp(compared_m[:, 0, 0], simulated_m[:, 0, 0], simulated_gaps_m)
    differences_m = np.array([gap_m(places) for places in compared_m]) - expected_m
    assert np.abs(differences_m).max() < PLACE_ERROR_M
    assert gap_m(places_m(folder)) == pytest.approx(STANDSTILL_M, abs=0.05)
    assert np.abs(spacing_errors_m(lines)).mean() == pytest.approx(mean_error_m, abs=MEAN_ERROR_M)
