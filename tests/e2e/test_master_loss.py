"""Real ROS 1 with one master on the drone: a complete repeat of `los`, and the effects of the loss of the drone."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from sim_backends.emulated.backend import DEFAULT_SITE
from tests.helpers.host import NamespaceComparison
from tests.helpers.labs import copy_shipped
from tests.helpers.runs import Run, only_trial, rows, run_here

pytestmark = pytest.mark.emulated

# On a busy machine a recorder needs several seconds to reach the master, so the drone is lost later than in shipped
# procedures.
TIMES = (
    *("duration: 5s, name: before", "duration: 4s, name: before"),
    *("after: 3s", "after: 6s"),
    *("duration: 10s, name: through", "duration: 9s, name: through"),
    *("duration: 5s, name: after", "duration: 2s, name: after"),
)
BEFORE_S = 4


def lab_with_one_master(folder: Path, ros: str = "debian") -> Path:
    """Write the site file of a lab with the robots of the paper, the programs of ROS, and the master on the drone."""
    extra_keys = f"\nros_master: relay\nemulated: {{ros: {ros}, boot: 0.5s, late_bound: 2s}}\n"
    (folder / "fieldkit.yaml").write_text(DEFAULT_SITE.read_text(encoding="utf-8") + extra_keys, encoding="utf-8")
    return folder


def run_procedure(lab: Path, procedure: str, *changes: str) -> dict[str, str]:
    """Run one repeat of a procedure with these times; return its row."""
    copy_shipped(lab, "procedures", procedure, *TIMES, *changes)
    run = run_here(lab, "trial", procedure, "5m", "--repeats", "1")
    assert run.code == 0, run.err + run.out
    (row,) = [row for row in rows(only_trial(lab)) if row["status"] == "valid"]
    return row


def messages_in(bag: Path) -> tuple[set[str], list[int]]:
    """Decode all messages of a bag; return their publishers, and their times in nanoseconds."""
    with AnyReader([bag]) as reader:
        callers = {getattr(connection.ext, "callerid", "") for connection in reader.connections}
        messages: list[tuple[int, Any]] = [
            (at_ns, reader.deserialize(data, connection.msgtype)) for connection, at_ns, data in reader.messages()
        ]
    assert all(len(scan.ranges) == 360 for _, scan in messages)
    return callers, [at_ns for at_ns, _ in messages]


def test_a_complete_repeat_of_los_with_the_master_and_recorder_of_ros(
    tmp_path: Path, untouched: NamespaceComparison
) -> None:
    words = ("trial", "los", "5m", "--repeats", "1", "--record", "4s", "--protocol", "tcp")
    run = run_here(lab_with_one_master(tmp_path), *words)
    assert run.code == 0, run.err + run.out
    assert rows(only_trial(tmp_path))[-1]["status"] == "valid"
    preflight = (only_trial(tmp_path) / "preflight.txt").read_text(encoding="utf-8")
    assert "turtlebot-1\tROS master\tok\tduckiedrone-1, 10.42.0.3:11311" in preflight
    evidence = only_trial(tmp_path) / "repeats" / "tcp-01"
    callers, times_ns = messages_in(evidence / "scan.bag")
    assert callers == {"/sensors_turtlebot_1"}, "the built-in recorder subscribes to one robot, without a master"
    assert 4 <= len(times_ns) <= 21, "4 s at 5 Hz, minus the time to subscribe"
    assert (evidence / "recv.bag").read_bytes() == (evidence / "scan.bag").read_bytes()
    untouched()


def test_after_the_loss_of_drone_and_master_no_topic_is_discovered(tmp_path: Path) -> None:
    row = run_procedure(lab_with_one_master(tmp_path), "masterloss", "wait: {duration: 10s}", "wait: {duration: 3s}")
    assert {name: row[f"{name}.bag_discovered"] for name in ("before", "through", "after", "again")} == {
        "before": "true",
        "through": "true",
        "after": "false",
        "again": "true",
    }
    assert 0 < float(row["before.bag_discovery_s"]) < BEFORE_S
    assert (row["after.bag_messages"], row["after.bag_discovery_s"], row["after.bag_gap_s"]) == ("0", "", "")
    assert float(row["drone.reboot_recovery_s"]) >= 0.5, "the drone has rebooted, and its master has no registrations"
    evidence = only_trial(tmp_path) / "repeats" / "tcp-01"
    _, times_ns = messages_in(evidence / "through.bag")
    assert int(row["through.bag_messages"]) == len(times_ns)
    gap_s = max(later - earlier for earlier, later in pairwise(times_ns)) / 1e9
    assert float(row["through.bag_gap_s"]) >= gap_s - 1e-6
    assert len(times_ns) >= 15, "9 s at 5 Hz; the drone is lost after 6 s, but a connected subscriber needs no master"
    assert "the same bytes as before" in run_here(tmp_path, "rebuild", str(only_trial(tmp_path))).out


@pytest.mark.nightly  # CI tests the loss of a drone with the master, and robots without a shared master
def test_without_a_shared_master_the_loss_of_the_drone_has_no_effect(tmp_path: Path) -> None:
    row = run_procedure(lab_with_one_master(tmp_path), "peerloss")
    assert {row[f"{name}.bag_discovered"] for name in ("before", "through", "after")} == {"true"}
    assert 0 < float(row["after.bag_discovery_s"]) < 2
    assert float(row["drone.reboot_recovery_s"]) >= 0.5


def test_a_master_out_of_range_stops_the_trial_before_its_first_repeat(tmp_path: Path) -> None:
    """The master is in range when the robots start, because they start next to each other."""
    run = run_here(lab_with_one_master(tmp_path), "trial", "los", "900m", "--repeats", "1", "--protocol", "tcp")
    assert_rejected(run, 3, "turtlebot-1: ROS master: no master answers at duckiedrone-1, 10.42.0.3:11311")


def test_robots_with_the_built_in_ros_cannot_share_a_master(tmp_path: Path) -> None:
    run = run_here(lab_with_one_master(tmp_path, "builtin"), "trial", "los", "5m", "--repeats", "1")
    assert_rejected(run, 2, "needs Debian's ROS")


def assert_rejected(run: Run, code: int, message: str) -> None:
    assert run.code == code, run.err + run.out
    assert message in run.err
    assert "remedy: " in run.err
