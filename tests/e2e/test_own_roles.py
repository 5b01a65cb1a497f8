"""Robots in custom roles of a procedure are placed, measured and listed in the table; other robots are not used."""

from pathlib import Path

import pytest

from fieldkit.core.model import Role
from fieldkit.measure.evidence import track
from tests.helpers.runs import only_trial, rows, run_here

pytestmark = pytest.mark.emulated

SITE = """\
backend: emulated
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  duckiedrone-1: {profile: duckiedrone}
  turtlebot-2: {profile: turtlebot3_burger}
  turtlebot-3: {profile: turtlebot3_burger}
roles:
  masterless:
    {sender: turtlebot-1, receiver: duckiedrone-1, rival: turtlebot-2, idle: turtlebot-3}
emulated: {ros: builtin, late_bound: 2s}
"""

RIVALS = """\
name: rivals
summary: A robot beside the link pings while the link is captured
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1
places:
  rival: {near: receiver, left: 4m}
steps:
  - capture:
      robots: [receiver, rival]
      during:
        - ping: {from: rival, to: receiver, count: 5, interval: 100ms}
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    (tmp_path / "procedures").mkdir()
    (tmp_path / "procedures" / "rivals.yaml").write_text(RIVALS, encoding="utf-8")
    return tmp_path


def test_a_robot_in_a_custom_role_is_used(lab: Path) -> None:
    assert run_here(lab, "trial", "rivals", "10m").code == 0
    trial = only_trial(lab)
    (row,) = rows(trial)
    assert row["status"] == "valid"
    assert row["others"] == "rival=turtlebot-2"
    assert row["rtt_received"] == "5"
    assert row["receiver_captured"] == "10"
    attempt = trial / "repeats" / "tcp-01"
    assert {path.name for path in attempt.glob("*.pcap")} == {"receiver.pcap", "rival.pcap"}
    places_m = {point.role: point.position_m for point in track.read(attempt / "track.csv")}
    east_m, north_m, up_m = places_m[Role.RECEIVER] or (0.0, 0.0, 0.0)
    assert places_m == {
        Role.SENDER: (east_m - 10.0, north_m, up_m),
        Role.RECEIVER: (east_m, north_m, up_m),
        Role("rival"): (east_m, north_m + 4.0, up_m),
    }


def test_an_unassigned_role_is_reported_before_the_trial_starts(lab: Path) -> None:
    (lab / "fieldkit.yaml").write_text(SITE.replace("rival: turtlebot-2, ", ""), encoding="utf-8")
    run = run_here(lab, "trial", "rivals", "10m")
    assert run.code == 2
    assert "no robot has the role rival in topology masterless" in run.err
    assert not (lab / "trials").exists()
