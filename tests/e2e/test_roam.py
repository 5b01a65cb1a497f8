"""A trial with a robot that moves from one access point to another: columns, samples and a rejected topology."""

from pathlib import Path

import pytest

from fieldkit.core.model import Role
from fieldkit.measure.evidence import link_samples
from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import TURTLEBOTS_AND_DRONE, procedure, site

pytestmark = pytest.mark.emulated

RADIO = (
    "radio: {fading: false, access_points: {west: {at_m: [5, 203]}, east: {at_m: [45, 203]}}, "
    "roaming: {threshold_dbm: -40, short: 1s, long: 1s, channels: 2}}"
)
STEPS = """\
- roam:
    robot: receiver
    during:
      - move:
          robot: receiver
          path: [{away: 36m}]
          speed: 6m/s
          during:
            - ping: {from: receiver, to: sender, count: 400, interval: 20ms, payload_bytes: 56}
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    robots = {"turtlebot-1": "turtlebot3_burger", "iris-1": "iris"}
    text = site(robots, emulated=f"ros: builtin, world: open, {RADIO}")
    (tmp_path / "fieldkit.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "procedures").mkdir()
    stroll = procedure("stroll", STEPS, protocols="udp")
    (tmp_path / "procedures" / "stroll.yaml").write_text(stroll, encoding="utf-8")
    return tmp_path


def test_a_robot_that_moves_to_another_access_point_has_one_handover(lab: Path) -> None:
    run = run_here(lab, "trial", "stroll", "4m", "--yes")
    assert run.code == 0, run.out + run.err
    trial = only_trial(lab)
    (row,) = rows(trial)
    assert row["status"] == "valid"
    assert (row["roam_ap_before"], row["roam_ap_after"]) == ("west", "east")
    assert (row["roam_handovers"], row["roam_ping_pongs"]) == ("1", "0")
    # The frames of an association take 8 ms or more, and a busy machine may delay pings.
    assert 0.02 <= float(row["roam_gap_s"]) < 5
    assert int(row["roam_lost"]) <= int(row["rtt_sent"]) - int(row["rtt_received"])
    (folder,) = (trial / "repeats").iterdir()
    cells = [sample.cell for sample in link_samples.read(folder / "link.csv")[Role.SENDER]]
    assert set(cells) == {"west"}, "the other robot uses one access point"


def test_a_robot_cannot_be_an_access_point_beside_others(tmp_path: Path) -> None:
    text = site(TURTLEBOTS_AND_DRONE, emulated=f"ros: builtin, {RADIO}")
    (tmp_path / "fieldkit.yaml").write_text(text, encoding="utf-8")
    run = run_here(tmp_path, "trial", "los", "4m", "--topology", "master", "--dry-run")
    assert run.code != 0
    assert "no robot can be an access point" in run.out + run.err
