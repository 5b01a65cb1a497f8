"""Whether our rover can be driven from afar, and stops when nobody is heard."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def rover(robots):
    """The rover, with our program on it."""
    robots.receiver.put(HERE / "drive.py", "drive.py")
    robots.sender.put(HERE / "steer.py", "steer.py")
    return robots.receiver


def steer(robots, seconds):
    robots.sender.run(["python3", "steer.py", robots.receiver.address, str(seconds)])


def test_teleop(robots, rover):
    with rover.running(["python3", "drive.py"]) as program:
        steer(robots, seconds=2)
    heard = [line for line in program.output.stdout.splitlines() if line.startswith("drive")]
    assert len(heard) >= 15


def test_rover_stops_when_its_link_is_gone(lab, robots, rover):
    with rover.running(["python3", "drive.py"]) as program:
        steer(robots, seconds=1)
        lab.fault("link-down", "rover", lasts="2s")
    assert program.output.stdout.splitlines()[-1] == "stop"


def test_echoes_come_soon(trial):
    echoes = trial("echo", "20m", repeats=3)
    assert echoes.cell().rtt_median_s.high < 0.05
