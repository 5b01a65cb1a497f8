"""Tests of the teleoperation of a rover, which must stop if no commands arrive."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent
DRIVE = ["python3", "drive.py"]


@pytest.fixture(scope="module")
def rover(robots):
    """The rover, after the programs were copied to both robots."""
    robots.receiver.put(HERE / "drive.py", "drive.py")
    robots.sender.put(HERE / "steer.py", "steer.py")
    return robots.receiver


def steer(rover, seconds):
    return ["python3", "steer.py", rover.address, str(seconds)]


def test_teleop(robots, rover):
    with rover.running(DRIVE) as program:
        robots.sender.run(steer(rover, seconds=2))
    assert program.output.stdout.count("drive") >= 15


def test_rover_stops_when_its_link_is_down(lab, robots, rover):
    with robots.sender.running(steer(rover, seconds=60)), rover.running(DRIVE) as program:
        robots.sender.run(["sleep", "1"])
        lab.fault("link-down", "rover", lasts="2s")
    assert "stop" in program.output.stdout.splitlines()


def test_round_trips_are_short(trial):
    pings = trial("echo", "20m", repeats=3)
    assert pings.cell().rtt_median_s.high < 0.05
