"""The pytest plugin on the co-simulation: robots, faults and a trial in which MuJoCo flies a drone."""

from pathlib import Path

import pytest

from tests.helpers import suites, texts

pytestmark = pytest.mark.emulated

SITE = texts.site(
    {"rover": "turtlebot3_burger", "drone": "iris"},
    emulated="ros: builtin, world: open, physics: mujoco, sync: {name: sliding_window, window: 4ms}",
)
FLYAWAY = texts.procedure(
    "flyaway",
    """\
- fly:
    robot: receiver
    height: 1m
    path: [{away: 4m}]
    speed: 3m/s
    then: land
    during:
      - capture:
          robots: [sender, receiver]
          port: 1234
          during: [{send: {from: sender, to: receiver, size: 20kB, port: 1234}}]
      - wait: {duration: 2s}
""",
    more="on_abort: {receiver: land}\n",
)
SUITE = """
import json

import pytest


def ping(robots):
    argv = ["ping", "-c", "3", "-i", "0.1", "-W", "1", robots.receiver.address]
    return robots.sender.run(argv, check=False).stdout


def test_robots_have_places_and_faults(lab, robots):
    assert "3 received" in ping(robots)
    lab.place("350m")
    assert "0 received" in ping(robots)
    lab.place("5m")
    with lab.moving("sender", away="350m", speed="300m/s"):
        assert any("0 received" in ping(robots) for _ in range(50))
    assert "3 received" in ping(robots)


def test_mujoco_flies_the_drone(trial):
    flight = trial("flyaway", "5m", protocol="tcp", repeats=1)
    (row,) = flight.repeats.to_pylist()
    print(json.dumps(row, default=str))
    assert row["status"] == "valid"
    assert row["backend"] == (
        "emulated (physics mujoco, network builtin, sync sliding_window, window 0.004 s, step 0.001 s)"
    )
    assert 0.0002 < row["delay_policy_s"] < 0.0045
    assert row["cosim_late_max_s"] < 0.1
    assert row["fly_height_median_m"] == pytest.approx(1.0, abs=0.3)
    assert row["fly_farthest_m"] > 2.0
"""


def test_a_suite_on_mujoco_with_a_window(tmp_path: Path) -> None:
    suites.write(tmp_path, site=SITE, test_physics=SUITE)
    (tmp_path / "procedures").mkdir()
    (tmp_path / "procedures/flyaway.yaml").write_text(FLYAWAY, encoding="utf-8")
    run = suites.run(tmp_path, "--fieldkit-keep=all")
    assert set(run.results.values()) == {"passed"}, run.output
    assert run.code == 0
