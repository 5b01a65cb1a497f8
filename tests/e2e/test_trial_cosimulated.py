"""Campaigns, trials and labs on the co-simulation: measured values, and a robot that real ROS drives to a wall."""

import json
import os
import re
import signal
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from fieldkit.core.deadline import Deadline
from sim_backends.emulated.emulated_options import EmulatedOptions
from sim_backends.emulated.simulator_choice import resolve
from tests.helpers.gazebo_server import gazebo_server, missing_libraries
from tests.helpers.host import NamespaceComparison, descendants, process_file
from tests.helpers.runs import fieldkit, only_trial, rows, run_here
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

COSIM = b"cosimulated.cosim_process"
SITE = """\
backend: emulated
robots:
  robot-1: {profile: turtlebot3_burger}
  robot-2: {profile: turtlebot3_burger}
roles:
  masterless: {sender: robot-1, receiver: robot-2}
emulated: EMULATED
"""
CAMPAIGN = """\
name: short
procedures: [los]
distances: [30ft]
topologies: [masterless]
protocols: [udp]
repeats: 1
record: 1s
seed: 7
"""
TWIST = "'{linear: {x: 0.2}}'"
DRIVE = f"timeout 60 rostopic pub -r 10 /cmd_vel geometry_msgs/Twist {TWIST}"


def make_site(folder: Path, emulated: str) -> Path:
    (folder / "fieldkit.yaml").write_text(SITE.replace("EMULATED", emulated), encoding="utf-8")
    return folder


def trial_row(folder: Path, emulated: str) -> dict[str, str]:
    """Return the row of the valid attempt of a short `los 30ft`."""
    make_site(folder, emulated)
    words = ("--topology", "masterless", "--repeats", "1", "--record", "1s", "--protocol", "udp")
    run = run_here(folder, "trial", "los", "30ft", *words)
    assert run.code == 0, run.err
    (row,) = [row for row in rows(only_trial(folder)) if row["status"] == "valid"]
    return row


def test_a_campaign_of_the_default_robots_on_the_built_in_network(
    tmp_path: Path, untouched: NamespaceComparison
) -> None:
    """The site file has no robots, so the receiver is the default drone."""
    sync = "{name: sliding_window, window: 4ms}"
    site = f"emulated: {{physics: kinematic, ros: builtin, sync: {sync}}}\n"
    (tmp_path / "fieldkit.yaml").write_text(site, encoding="utf-8")
    (tmp_path / "short.yaml").write_text(CAMPAIGN, encoding="utf-8")
    run = run_here(tmp_path, "campaign", "short.yaml")
    assert run.code == 0, run.err
    (trial,) = (path.parent for path in (tmp_path / "trials").rglob("trial.yaml"))
    (row,) = [row for row in rows(trial) if row["status"] == "valid"]
    assert 0.0005 < float(row["delay_policy_s"]) < 0.0045, "half a window on average"
    assert float(row["delay_transmission_s"]) > 0
    assert float(row["cosim_late_max_s"]) < 0.1
    simulators = "physics kinematic, network builtin, sync sliding_window, window 0.004 s, step 0.001 s"
    assert row["backend"] == f"emulated ({simulators})"
    plan = (trial / "trial.yaml").read_text(encoding="utf-8")
    assert "simulators:\n  physics: kinematic\n  network: builtin\n  sync: sliding_window, window 0.004 s\n" in plan


def test_a_trial_on_ns3(tmp_path: Path) -> None:
    resolve(EmulatedOptions.model_validate({"network": "ns3"}))  # this compiles ns-3 before the trial
    row = trial_row(tmp_path, "{network: ns3, ros: builtin}")
    assert float(row["delay_s"]) > float(row["delay_policy_s"]) > 0
    parts_s = [float(row[f"delay_{part}_s"]) for part in ("processing", "transmission", "propagation", "queuing")]
    assert parts_s[1] > 0
    assert sum(parts_s) == pytest.approx(float(row["delay_s"]), rel=1e-6)
    assert int(row["sender_link_samples"]) > 1
    assert int(row["sender_radio_tx_packets"]) >= int(row["ip_packets_sent"])
    assert int(row["receiver_radio_rx_packets"]) >= int(row["ip_packets_received"])
    assert -90 < float(row["sender_signal_median_dbm"]) < -20


def test_a_robot_that_real_ros_drives_stops_at_the_wall(tmp_path: Path) -> None:
    """The wall of the lawn starts at 3.9 m east, and the robot has a radius of 0.113 m."""
    make_site(tmp_path, "{physics: kinematic, ros: debian, late_bound: 1us}")
    assert fieldkit(tmp_path, "lab", "up").code == 0
    try:
        assert run_here(tmp_path, "lab", "move", "robot-1", "--to", "3.5m", "18m").code == 0
        result = run_here(tmp_path, "lab", "move", "robot-2", "--to", "4m", "18m")
        assert "robot-2 would be within wall" in result.err
        assert fieldkit(tmp_path, "lab", "shell", "robot-1", f"{DRIVE} >/dev/null 2>&1 &").code == 0

        def east_m() -> float:
            lab_state = json.loads(run_here(tmp_path, "lab", "ps", "--json").out)
            return float(lab_state["robots"][0]["place_m"][0])

        wait_until(lambda: east_m() > 3.786, Deadline.after(90))
        assert east_m() == pytest.approx(3.787, abs=0.002)
        record = "timeout -s INT 60 rosbag record -q -l 5 -O wall.bag /odom /scan >/dev/null 2>&1; base64 wall.bag"
        (tmp_path / "wall.bag").write_bytes(b64decode(fieldkit(tmp_path, "lab", "shell", "robot-1", record).out))
        with AnyReader([tmp_path / "wall.bag"]) as bag:
            last_messages: dict[str, Any] = {
                connection.topic: bag.deserialize(data, connection.msgtype) for connection, _, data in bag.messages()
            }
        assert last_messages["/odom"].pose.pose.position.x == pytest.approx(0.287, abs=0.003), "it started at 3.5 m"
        assert last_messages["/odom"].twist.twist.linear.x == 0.0
        beams_rad = np.radians(np.arange(50, 70))
        wall_m = np.median(last_messages["/scan"].ranges[50:70] * np.cos(beams_rad))
        assert wall_m == pytest.approx(3.9 - 3.787, abs=0.01)
        ps_run = run_here(tmp_path, "lab", "ps")
        lateness = re.search(r"late: .*windows at most [\d.]+ ms; \d{3,} windows", ps_run.out)
        assert lateness is not None, ps_run.out
        assert "windows later than 0.001 ms, so a trial would be void" in ps_run.err
        lab_pid = json.loads(run_here(tmp_path, "lab", "ps", "--json").out)["pid"]
        (cosim_pid,) = (pid for pid in descendants(lab_pid) if COSIM in process_file(pid, "cmdline"))
        os.kill(cosim_pid, signal.SIGKILL)
        wait_until(lambda: run_here(tmp_path, "lab", "ps").code != 0, Deadline.after(60))
        failed_run = run_here(tmp_path, "lab", "ps")
        assert "does not answer: it was killed by SIGKILL" in failed_run.err
        assert "fieldkit lab down" in failed_run.err
    finally:
        assert run_here(tmp_path, "lab", "down").code == 0


@pytest.mark.parametrize(
    ("emulated", "reason"),
    [
        (
            "{network: ns3, record_air: true}",
            "fieldkit.yaml:7: in emulated: the network ns3 does not support `record_air`",
        ),
        (
            "{network: ns3, radio: {loss: 5%}}",
            "fieldkit.yaml:7: in emulated: the network ns3 does not support fixed links",
        ),
        ("{physics: kinematic, sync: slidding_window}", "there is no sync policy 'slidding_window'"),
        ("{sync: sliding_window}", "`sync` needs a co-simulation"),
        ("{physics: kinematic, sync: {name: scheduled, window: 0.1ms}}", "shorter than the physics step"),
    ],
)
def test_an_impossible_combination_is_rejected(emulated: str, reason: str, tmp_path: Path) -> None:
    make_site(tmp_path, emulated)
    run = run_here(tmp_path, "trial", "los", "30ft", "--topology", "masterless")
    assert run.code == 2
    assert reason in run.err
    assert "remedy" in run.err


@contextmanager
def gazebo_for(folder: Path, emulated: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Run a server with the world of a lab, to which all programs of the test connect."""
    make_site(folder, emulated)
    (folder / "gazebo").mkdir()
    sdf = run_here(folder, "lab", "sdf")
    assert sdf.code == 0, sdf.err
    with gazebo_server(folder / "gazebo", sdf.out) as server:
        monkeypatch.setenv("IGN_PARTITION", server.options["partition"])
        monkeypatch.setenv("IGN_IP", server.options["ip"])
        yield


@pytest.mark.skipif(bool(missing_libraries()), reason=missing_libraries())
def test_a_trial_in_gazebo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound is large, because Gazebo has no real-time priority here, and the tests use all processors."""
    emulated = "{physics: gazebo, ros: builtin, late_bound: 10s}"
    with gazebo_for(tmp_path, emulated, monkeypatch):
        row = trial_row(tmp_path, emulated)
    assert row["backend"].startswith("emulated (physics gazebo, network builtin, sync ")
    assert row["file_loss"] == "0"
    assert float(row["delay_s"]) > 0
    assert float(row["delay_policy_s"]) > 0
    assert 0 < float(row["cosim_late_max_s"]) < 10
    assert -90 < float(row["sender_signal_median_dbm"]) < -20


@pytest.mark.skipif(bool(missing_libraries()), reason=missing_libraries())
def test_real_ros_drives_a_robot_in_gazebo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with gazebo_for(tmp_path, "{physics: gazebo, ros: debian, world: lawn}", monkeypatch):
        started = fieldkit(tmp_path, "lab", "up")
        assert started.code == 0, started.err
        try:
            assert run_here(tmp_path, "lab", "move", "robot-1", "--to", "10m", "18m").code == 0
            assert fieldkit(tmp_path, "lab", "shell", "robot-1", f"{DRIVE} >/dev/null 2>&1 &").code == 0

            def place_m() -> list[float]:
                lab_state = json.loads(run_here(tmp_path, "lab", "ps", "--json").out)
                place: list[float] = lab_state["robots"][0]["place_m"]
                return place

            wait_until(lambda: place_m()[0] > 10.3, Deadline.after(90))
            assert place_m()[1] == pytest.approx(18.0, abs=0.05)
        finally:
            assert run_here(tmp_path, "lab", "down").code == 0
