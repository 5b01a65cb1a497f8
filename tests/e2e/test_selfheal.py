"""Self-healing, end to end: `fieldkit trial selfheal`, real faults, and the resulting rows."""

import re
from pathlib import Path

import pytest

from fieldkit.config import locations
from fieldkit.core.deadline import Deadline
from tests.helpers.host import NamespaceComparison
from tests.helpers.labs import built_in_ros, write_procedure
from tests.helpers.runs import Run, only_trial, rows, run_here
from tests.helpers.texts import procedure

pytestmark = pytest.mark.emulated

LONG_S = 300.0
"""Upper bound of recovery times on a busy machine."""

# The killed ping never recovers; the sensors restart; the sender is rebooted while it records.
NEVER = procedure(
    "never",
    """\
- fault:
    robot: sender
    kind: kill
    process: ping
    after: 0.5s
    limit: 1.5s
    during:
      - ping: {from: sender, to: receiver, count: 100, interval: 100ms}
- fault:
    robot: sender
    kind: reboot
    after: 0.5s
    during:
      - record: {robot: sender, topics: [/scan], duration: 500s}
""",
)

CUT_S = 2.0
# Flows of every kind: three with a rate, and a file. The topic starts slowly, on a busy machine up to 10 s late.
FLOWS = procedure(
    "flows",
    """\
- capture:
    during:
      - soak:
          from: sender
          to: receiver
          protocol: udp
          rate: 80kbit/s
          payload_bytes: 500
          during:
            - fault:
                robot: receiver
                kind: out-of-range
                for: 2s
                after: 12s
                during:
                  - together:
                      during:
                        - topics: {from: sender, to: receiver, rate: 20Hz, bytes: 100B, duration: 18s, patience: 60s}
                        - iperf3:
                            {name: load, from: sender, to: receiver, protocol: udp, rate: 80kbit/s,
                             payload_bytes: 500, duration: 18s}
      - fault:
          name: again
          robot: receiver
          kind: out-of-range
          for: 2s
          after: 3s
          during:
            - send: {name: up, from: sender, to: receiver, size: 3MB}
""",
    more="expect: [up.transfer_stall_s < 300 ms]\n",
)
AGREES_S = 0.5
"""Tolerance between the stall of a flow with a rate and the time its radio was out of range: a clock query over SSH,
the duration of a command to the testbed on a busy machine, and two sending intervals of 50 ms.
"""

HEALS = procedure(
    "heals",
    """\
- fault: {robot: receiver, kind: kill, process: sensors, after: 0.3s}
""",
)

BROKEN = procedure(
    "broken",
    """\
- fault:
    robot: receiver
    kind: reboot
    after: 60s
    during:
      - record: {robot: sender, topics: [/scan], duration: 1s}
""",
)


def run_procedure(lab: Path, text: str) -> Run:
    return run_here(lab, "trial", write_procedure(lab, text), "5m")


def test_a_link_and_a_robot_recover_and_the_rows_contain_the_times(
    tmp_path: Path, untouched: NamespaceComparison
) -> None:
    run = run_here(tmp_path, "trial", "selfheal", "5m", "--repeats", "1")
    assert run.code == 0, run.err + run.out
    assert "ping recovery after link-down, median" in run.out
    assert "reboot: no answer for " in run.out
    trial = only_trial(tmp_path)
    (row,) = rows(trial)
    assert row["link_down_recovered"] == row["reboot_recovered"] == "true"
    assert 2.0 <= float(row["link_down_outage_s"]) < LONG_S
    assert 0.0 <= float(row["link_down_recovery_s"]) < LONG_S
    assert 2.0 <= float(row["reboot_outage_s"]) < LONG_S, "the boot time, and what its network takes"
    assert row["reboot_recovery_s"] == row["reboot_outage_s"]
    assert row["kill_recovered"] == row["kill_outage_s"] == "", "there was none"
    assert 0.2 < float(row["rtt_loss"]) < 0.8, "the fault lasts 2 s of the 6 s of pings"
    assert summary(trial)["reboot_recovered"]["value"] == "1"
    evidence = {path.name for path in (trial / "repeats" / "tcp-01").iterdir()}
    assert evidence >= {f"fault-{kind}{end}" for kind in ("link-down", "reboot") for end in (".txt", "-ping.txt")}
    assert run_here(tmp_path, "verify", str(trial)).code == 0
    assert "the same bytes as before" in run_here(tmp_path, "rebuild", str(trial)).out
    untouched()


def test_a_permanent_failure_has_no_times_and_a_failure_during_a_fault_is_a_result(tmp_path: Path) -> None:
    began = Deadline.after(LONG_S)
    run = run_procedure(tmp_path, NEVER)
    assert run.code == 0, run.err + run.out
    assert not began.expired, "the recording of 500 s ended with its robot"
    assert "kill: did not recover" in run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["status"] == "valid"
    assert (row["kill_recovered"], row["kill_outage_s"], row["kill_recovery_s"]) == ("false", "", "")
    assert row["reboot_recovered"] == "true"
    cells = summary(only_trial(tmp_path))
    assert cells["kill_recovered"]["value"] == "0"
    recovery = cells["kill_recovery_s"]
    assert recovery["is_lower_bound"] == "true", "the robot did not recover while it was watched"
    assert (recovery["n"], recovery["n_censored"]) == ("1", "1")
    watched = (only_trial(tmp_path) / "repeats" / "tcp-01" / "fault-kill-watch.txt").read_text(encoding="ascii")
    polls = [line.split() for line in watched.splitlines()[1:]]
    last_up_s = max(float(poll[0]) for poll in polls if len(poll) > 1)
    assert float(recovery["value"]) == pytest.approx(float(polls[-1][0]) - last_up_s, abs=1e-6)
    assert recovery["low"] == recovery["high"] == ""
    assert cells["reboot_recovery_s"]["is_lower_bound"] == "false"


def test_flows_stall_for_the_time_out_of_range_and_tcp_longer(tmp_path: Path) -> None:
    built_in_ros(tmp_path, radio="{mode: n0}")  # 6.5 Mbit/s: few packets last longer than the fault
    run = run_procedure(tmp_path, FLOWS)
    trial = only_trial(tmp_path)
    (row,) = rows(trial)
    assert row["status"] == "valid", row["reason"]
    assert run.code == 1, "the procedure demands stalls of at most 300 ms"
    assert row["out_of_range_recovered"] == "true"
    assert float(row["out_of_range_outage_s"]) >= CUT_S - 0.2
    noted = (trial / "repeats" / "tcp-01" / "fault-out-of-range-times.txt").read_text(encoding="ascii")
    began_ns, ended_ns = (int(noted.split(f"{name}_utc_ns ")[1].split()[0]) for name in ("began", "ended"))
    cut_s = (ended_ns - began_ns) / 1e9
    for paced in ("soak", "load.iperf3", "topic"):
        stalled = {name: float(row[f"{paced}_{name}_s"]) for name in ("stall", "out_of_range_outage")}
        assert abs(stalled["out_of_range_outage"] - cut_s) < AGREES_S, (paced, stalled, cut_s)
        assert abs(stalled["stall"] - cut_s) < AGREES_S, (paced, stalled, cut_s)
        assert 0 <= float(row[f"{paced}_out_of_range_recovery_s"]) < AGREES_S
        assert int(row[f"{paced}_stalls"]) >= 1
    # TCP waits for its retransmission timeout, which has grown during the outage: longer than the ping that measures
    # it.
    assert float(row["up.transfer_stall_s"]) >= cut_s - AGREES_S
    assert float(row["again.up.transfer_out_of_range_recovery_s"]) > 0
    assert float(row["load.iperf3_captured_jitter_mean_s"]) > 0
    assert "again: up: transfer recovery after out-of-range, median" in run.out
    assert "the same bytes as before" in run_here(tmp_path, "rebuild", str(trial)).out


def test_a_killed_service_restarts(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    run = run_procedure(tmp_path, HEALS)
    assert run.code == 0, run.err + run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["kill_recovered"] == "true"
    assert 0.1 <= float(row["kill_outage_s"]) < LONG_S


def test_a_failure_before_the_fault_fails_the_attempt_without_a_fault(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    profile = locations.find("robots", "turtlebot3_burger").read_text(encoding="utf-8")
    (tmp_path / "robots").mkdir()
    broken = re.sub(r"record: \[rosbag.*\]", 'record: ["false", "{topics}"]', profile)
    (tmp_path / "robots" / "turtlebot3_burger.yaml").write_text(broken, encoding="utf-8")
    run = run_procedure(tmp_path, BROKEN)
    assert run.code == 4, run.err + run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["status"] == "failed"
    assert "recording ended with exit code 1" in row["reason"]
    assert row["reboot_recovered"] == ""
    assert not list(only_trial(tmp_path).glob("repeats/*/fault-reboot.txt"))


def test_a_fault_that_cannot_be_injected_fails_the_attempt(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    began = Deadline.after(LONG_S)
    recording = "during: [{record: {robot: receiver, topics: [/pidrone/imu], duration: 500s}}]"
    run = run_procedure(tmp_path, HEALS.replace("sensors, after: 0.3s", f"roscore, after: 0.3s, {recording}"))
    assert run.code == 4, run.err + run.out
    assert not began.expired, "the steps inside the block were ended"
    (row,) = rows(only_trial(tmp_path))
    assert "no process named roscore runs" in row["reason"]


def summary(trial: Path) -> dict[str, dict[str, str]]:
    return {row["quantity"]: row for row in rows(trial, "summary.csv")}
