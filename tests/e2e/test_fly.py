"""Drones in trials: one flies away during a transfer, and none stays in the air without its laptop."""

import subprocess
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role
from fieldkit.measure.evidence import track
from sim_backends.emulated.robot.spec import ANTENNA_M
from tests.helpers.host import wait_for_end
from tests.helpers.outside import Outside, robots_outside
from tests.helpers.runs import fieldkit, finish, only_trial, rows, start, wait_for_line
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

# Where the drone stays it is heard, and 20 m farther it is not.
SITE = """\
backend: emulated
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  duckiedrone-1: {profile: duckiedrone}
roles:
  masterless: {sender: turtlebot-1, receiver: duckiedrone-1}
emulated:
  ros: builtin
  radio: {fading: false, shadowing_db: 0.0, noise_floor_dbm: -59, mode: n0}
"""
PROCEDURE = """\
name: flyaway
summary: a drone flies away while bytes are sent to it
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1
attempts: 1
on_abort: {receiver: land}
steps:
  - fly:
      robot: receiver
      height: 1m
      path: [{away: 20m}]
      speed: 3m/s
      then: land
      lease: 3s
      during: DURING
"""
TRANSFER = """
        - capture:
            robots: [sender, receiver]
            port: 1234
            during:
              - send: {from: sender, to: receiver, size: 1MB, port: 1234}
              - ping: {from: sender, to: receiver, count: 40, interval: 100ms, payload_bytes: {tcp: 100, udp: 100}}
"""


def lab(folder: Path, during: str) -> Path:
    (folder / "procedures").mkdir()
    (folder / "procedures/flyaway.yaml").write_text(PROCEDURE.replace("DURING", during), encoding="utf-8")
    return folder


def test_a_drone_flies_away_and_the_row_says_so(tmp_path: Path) -> None:
    (lab(tmp_path, TRANSFER) / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    run = fieldkit(tmp_path, "trial", "flyaway", "3m")
    assert run.code == 0, run.err
    trial = only_trial(tmp_path)
    (row,) = rows(trial)
    assert row["status"] == "valid"
    assert float(row["file_loss"]) == 0.0
    assert 3.0 < float(row["transfer_distance_start_m"]) < 4.0
    assert float(row["transfer_distance_max_m"]) > float(row["transfer_distance_start_m"]) + 0.5
    assert float(row["rtt_distance_max_m"]) > 8.0
    assert float(row["rtt_loss"]) > 0.1
    where = track.read(trial / "repeats/tcp-01/track.csv")
    flown_m = [one.position_m for one in where if one.role is Role.RECEIVER and one.position_m is not None]
    ground_m = flown_m[0][2]
    assert max(up_m for _, _, up_m in flown_m) == pytest.approx(ground_m + 1.0, abs=0.4)
    assert flown_m[-1][2] == pytest.approx(ground_m, abs=1e-6), "it landed"
    assert flown_m[-1][0] - flown_m[0][0] > 8.0, "where it was"
    log = (trial / "repeats/tcp-01/fly.log").read_text(encoding="utf-8").split("\n")
    said = [line.partition(" ")[2] for line in log if line]
    assert said[1:6] == ["ready", "standing", "climbing", "up", "flying"]
    assert said[-2:] == ["coming down", "landed"]


def test_a_drone_that_nobody_leads_any_more_lands(tmp_path: Path) -> None:
    """Killed, the laptop leaves it to its lease; `fieldkit abort` ends the job that flies it, as Ctrl-C does."""
    with robots_outside(tmp_path) as outside:
        lab(tmp_path, "[{wait: {duration: 90s}}]")
        process = flying(outside)
        process.kill()
        process.communicate(timeout=60)
        wait_for_end({process.pid}, within_s=60.0)
        landed(outside, "land: nobody has renewed the order in time")

        assert fieldkit(tmp_path, "abort", "--yes").code == 0  # the lock of who was killed
        process = flying(outside)
        aborted = fieldkit(tmp_path, "abort", "--yes")
        assert "/fly " in aborted.out, aborted.err
        landed(outside, "land: the job was told to end")
        process.terminate()
        assert finish(process).code != 0


def flying(outside: Outside) -> "subprocess.Popen[str]":
    """Start a trial and return when its drone is in the air."""
    process = start(outside.folder, "trial", "flyaway", "5m", "--yes", "--allow-motion", "--json")
    wait_for_line(process, '"fly duckiedrone-1"')
    assert height_m(outside) > 0.5
    return process


def landed(outside: Outside, why: str) -> None:
    """Wait until the drone stands, and see that its own program says why it brought it down."""
    wait_until(lambda: height_m(outside) < 1e-3, Deadline.after(60))
    shell = outside.testbed.shells[Role.RECEIVER]
    newest = 'cat "$(ls -t .fieldkit/*/*/fly.log | head -n 1)"'
    assert why in shell.run(("sh", "-c", newest), deadline=Deadline.after(30)).stdout.decode()


def height_m(outside: Outside) -> float:
    """Return how high the drone is over where it was put, as the lab knows it."""
    said = outside.testbed.robots[Role.RECEIVER].steered()
    return 0.0 if said is None else said.place_m[2] - ANTENNA_M
