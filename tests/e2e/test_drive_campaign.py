"""A driving robot in campaigns: it is held after a fault, and it has one fence for all trials."""

import json
import math
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.model import Role
from tests.helpers.host import wait_for_end
from tests.helpers.rovers import RECEIVER_SITE, RoverLab, rover_lab
from tests.helpers.runs import Run, finish, rows, run_here, start

pytestmark = pytest.mark.emulated

FENCE_M = 2.5
PATH_M = 1.0
BEYOND_M = 0.3
"""The robot brakes from 0.6 m/s at 2 m/s² in 0.09 m, and moves 0.06 m in two cycles of its loop. The remainder is a
margin for a busy machine.
"""
LEASE_S = 30.0
"""Longer than a test, so that the lease stops no robot in these tests."""
CAMPAIGN = """\
name: lawn
procedures: [drive]
distances: [5m, 10m]
topologies: [masterless]
protocols: [udp]
repeats: 1
seed: 1
"""
ALLOW_MOTION = ("--allow-motion",)
WITHOUT_QUESTIONS = (*ALLOW_MOTION, "--yes")
OPTION = "--allow-motion-after-fault"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RoverLab]:
    with rover_lab(tmp_path_factory.mktemp("lawn"), fence_m=FENCE_M, lease_s=LEASE_S) as created_lab:
        (created_lab.folder / "lawn.yaml").write_text(CAMPAIGN, encoding="utf-8")
        yield created_lab


def campaign(lab: RoverLab, out: str, *words: str) -> Run:
    return run_here(lab.folder, "campaign", "lawn.yaml", "--out", out, *words)


def motions(lab: RoverLab, out: str) -> list[str]:
    path = lab.folder / out / "campaign_lawn" / "motion.jsonl"
    return [json.loads(line)["event"] for line in path.read_text(encoding="utf-8").splitlines()]


def trials(lab: RoverLab, out: str) -> list[Path]:
    return sorted(path for path in (lab.folder / out / "campaign_lawn").iterdir() if path.is_dir())


def answers(lab: RoverLab, *lines: str) -> tuple[str, str]:
    (lab.folder / "answers").write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    return "--answers", str(lab.folder / "answers")


def assert_unmoved(lab: RoverLab, run: Run, reason: str, since_ns: int) -> None:
    """Assert that a run ended because a person must act, and that the rover did not move."""
    assert run.code == 5, run.err
    assert reason in run.err
    track = lab.track_m(since_ns)
    assert all(math.dist(place_m, lab.place_m) < 0.01 for place_m in track)


def test_a_fault_holds_the_robot_of_a_campaign_and_its_fence_applies_to_all_trials(lab: RoverLab) -> None:
    out, site = "held", ("--site", RECEIVER_SITE)
    lab.write_procedure(Role.RECEIVER, PATH_M)
    lab.place_at("5m")
    home_m, started_ns = lab.place_m, time.time_ns()
    process = start(lab.folder, "campaign", "lawn.yaml", "--out", out, *site, *WITHOUT_QUESTIONS)
    try:
        lab.wait_until_it_drives(process)
        process.send_signal(signal.SIGINT)
        stopped_run = finish(process)
    finally:
        process.kill()
        wait_for_end({process.pid}, within_s=60.0)
    assert stopped_run.code == 130, stopped_run.err
    assert "before rover-1 moves again, a person must put it at its place and type confirm" in stopped_run.out
    assert motions(lab, out) == ["origin", "begun", "held"]

    since_ns = time.time_ns()
    assert_unmoved(lab, campaign(lab, out, *site, *WITHOUT_QUESTIONS), "rover-1: stopped by the operator", since_ns)
    assert len(trials(lab, out)) == 1, "no other trial started"

    # With the option, the robot drives back along its path and then out again from its origin. The origin also
    # applies
    # to the next trial.
    option_run = campaign(lab, out, *site, *WITHOUT_QUESTIONS, OPTION)
    assert option_run.code == 0, option_run.err
    assert motions(lab, out) == ["origin", "begun", "held", "allowed", *("begun", "ended") * 2], "one origin"
    assert [row["status"] for trial in trials(lab, out) for row in rows(trial)] == ["void", "valid", "valid"]
    farthest_m = max(math.dist(place_m, home_m) for place_m in lab.track_m(started_ns))
    assert farthest_m == pytest.approx(PATH_M, abs=BEYOND_M), (
        "not the whole distance again from the point of the stop"
    )
    assert lab.place_m == pytest.approx(home_m, abs=0.1)


@pytest.mark.nightly  # CI moves a robot out of the fence of a single trial, in test_drive
def test_a_robot_outside_its_fence_does_not_start_in_the_next_trial_of_a_campaign(lab: RoverLab) -> None:
    out, site = "outside", ("--site", RECEIVER_SITE)
    lab.write_procedure(Role.RECEIVER, 0.4)
    lab.place_at("5m")
    home_m = lab.place_m
    process = start(lab.folder, "campaign", "lawn.yaml", "--out", out, *site, *WITHOUT_QUESTIONS)
    try:
        lab.wait_until_it_drives(process)
        process.send_signal(signal.SIGINT)
        assert finish(process).code == 130
    finally:
        process.kill()
        wait_for_end({process.pid}, within_s=60.0)
    lab.drive_forward(FENCE_M)
    since_ns = time.time_ns()
    result = campaign(lab, out, *site, *WITHOUT_QUESTIONS, OPTION)
    assert_unmoved(lab, result, f"outside its fence of {FENCE_M:g} m", since_ns)

    # A person puts the robot back and confirms this. The robot gets a new origin, which applies to both trials.
    lab.place_at("5m")
    run = campaign(lab, out, *site, *ALLOW_MOTION, *answers(lab, "", "confirm", ""))
    assert run.code == 0, run.err
    assert motions(lab, out)[-6:] == ["confirmed", "origin", "begun", "ended", "begun", "ended"]
    assert lab.place_m == pytest.approx(home_m, abs=0.1)


def test_with_yes_a_robot_does_not_start_at_an_unconfirmed_position(lab: RoverLab) -> None:
    out = "places"
    lab.write_procedure(Role.SENDER, 0.4)
    lab.place_at("5m")
    since_ns = time.time_ns()
    two_distances_run = run_here(lab.folder, "trial", "drive", "5m", "10m", "--out", out, *WITHOUT_QUESTIONS)
    assert two_distances_run.code == 2, two_distances_run.err
    assert "rover-1 moves automatically and must be at another place for 10m" in two_distances_run.err
    assert set(lab.track_m(since_ns)) <= {lab.place_m}

    first_run = campaign(lab, out, *WITHOUT_QUESTIONS)
    assert first_run.code == 5, first_run.err
    assert (
        "rover-1 must be at another place than before, and --yes does not confirm that it is there" in first_run.err
    )
    assert motions(lab, out) == ["origin", "begun", "ended"]
    assert [[row["status"] for row in rows(trial)] for trial in trials(lab, out)] == [["valid"], []]

    # After a person has confirmed the position, the origin and the fence are at the new position.
    (distance,) = (name for name in ("5m", "10m") if name in trials(lab, out)[1].name)
    lab.place_at(distance)
    home_m, started_ns = lab.place_m, time.time_ns()
    second_run = campaign(lab, out, *ALLOW_MOTION, *answers(lab, ""))
    assert second_run.code == 0, second_run.err
    assert motions(lab, out) == ["origin", "begun", "ended"] * 2
    farthest_m = max(math.dist(place_m, home_m) for place_m in lab.track_m(started_ns))
    assert farthest_m == pytest.approx(0.4, abs=BEYOND_M)


def test_stop_stops_a_robot_after_fieldkit_was_killed(lab: RoverLab) -> None:
    lab.write_procedure(Role.SENDER, FENCE_M - BEYOND_M)
    lab.place_at("5m")
    process = start(lab.folder, "trial", "drive", "5m", "--out", "killed", *WITHOUT_QUESTIONS)
    try:
        lab.wait_until_it_drives(process)
    finally:
        process.kill()
        process.communicate()
    # An error of the site file that does not affect the robots must not prevent the stop.
    (lab.folder / "broken.yaml").write_text(
        (lab.folder / "fieldkit.yaml").read_text(encoding="utf-8") + "no such key: 1\n", encoding="utf-8"
    )
    stop_run = run_here(lab.folder, "stop", "--all", "--site", "broken.yaml")
    assert stop_run.code == 0, stop_run.out + stop_run.err
    assert sorted(stop_run.out.splitlines()) == [
        "box-1: no program of fieldkit moves it; nothing was sent to it",
        "rover-1: stopped (stationary)",
    ]
    assert lab.stationary
