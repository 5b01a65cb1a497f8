"""Shipped profiles of current robots: trials can be planned with all of them, and a robot without IP is rejected."""

from pathlib import Path

import pytest

from tests.helpers.paths import ROOT
from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import site

NAMES = sorted(path.stem for path in (ROOT / "robots").glob("*.yaml"))
UNTESTED = (
    *("turtlebot4", "turtlebot3_humble", "turtlebot3_jazzy", "jackal", "husky_a300", "rosbot3", "leo_rover"),
    *("unitree_go2", "px4_x500", "duckiebot_db21", "spot"),
)
TRIAL = ("los", "10ft", "--topology", "masterless", "--protocol", "tcp", "--repeats", "1", "--record", "1s")


def lab(folder: Path, profile: str) -> Path:
    robots = {"robot-1": profile, "robot-2": "turtlebot3_burger"}
    (folder / "fieldkit.yaml").write_text(site(robots), encoding="utf-8")
    return folder


def test_every_untested_profile_states_that_it_is_not_tested() -> None:
    assert set(UNTESTED) <= set(NAMES)
    for name in UNTESTED:
        text = (ROOT / "robots" / f"{name}.yaml").read_text(encoding="utf-8")
        assert "not tested on real hardware" in text, name
        assert "Source" in text.partition("\nname:")[0], name


@pytest.mark.parametrize("name", UNTESTED)
def test_a_trial_can_be_planned(name: str, tmp_path: Path) -> None:
    lab(tmp_path, name)
    shown_profile = run_here(tmp_path, "robots", "show", name)
    assert shown_profile.code == 0, shown_profile.err
    run = run_here(tmp_path, "trial", *TRIAL, "--dry-run")
    assert run.code == 0, run.err
    assert "bag record" in run.out or "rosbag record" in run.out


def test_a_robot_without_ip_is_rejected_with_the_reason(tmp_path: Path) -> None:
    run = run_here(lab(tmp_path, "crazyflie"), "trial", *TRIAL, "--dry-run")
    assert run.code == 2
    assert "fieldkit.yaml:3" in run.err
    assert "carries CRTP packets" in run.err


@pytest.mark.emulated
def test_a_trial_of_a_current_robot_runs_on_emulated_robots(tmp_path: Path) -> None:
    run = run_here(lab(tmp_path, "turtlebot4"), "trial", *TRIAL)
    assert run.code == 0, run.err + run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["status"] == "valid"
    assert row["file_loss"] == "0"
