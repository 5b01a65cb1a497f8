"""Trials with faults: `fieldkit trial selfheal`, other procedures, and the resulting rows."""

import re
from pathlib import Path

import pytest

from fieldkit.config import locations
from fieldkit.config.locations import SITE_FILE
from fieldkit.core.deadline import Deadline
from tests.helpers.host import NamespaceComparison
from tests.helpers.labs import built_in_ros, site_with_late_packets, write_procedure
from tests.helpers.runs import Run, only_trial, rows, run_here
from tests.helpers.texts import procedure

pytestmark = pytest.mark.emulated

LONG_S = 300.0
"""Upper bound of recovery times on a busy machine."""

# The killed ping never recovers, and the sender is rebooted while it records.
PERMANENT = procedure(
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
# All kinds of flows: three with a rate, and a file. On a busy machine, the topic starts up to 10 s late.
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
TOLERANCE_S = 0.5
"""Tolerance between the stall of a flow with a rate and the time for which its radio was out of range.

It covers a query of the clock over SSH, the duration of a command to the testbed on a busy machine, and two sending
intervals of 50 ms.
"""

RESTARTING = procedure(
    "heals",
    """\
- fault: {robot: receiver, kind: kill, process: sensors, after: 0.3s}
""",
)

FAILING_RECORDER = procedure(
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
    (tmp_path / SITE_FILE).write_text(site_with_late_packets(), encoding="utf-8")
    run = run_here(tmp_path, "trial", "selfheal", "5m", "--repeats", "1")
    assert run.code == 0, run.err + run.out
    assert "ping recovery after link-down, median" in run.out
    assert "reboot: no answer for " in run.out
    trial = only_trial(tmp_path)
    (row,) = rows(trial)
    assert row["link_down_recovered"] == row["reboot_recovered"] == "true"
    assert 2.0 <= float(row["link_down_outage_s"]) < LONG_S
    assert 0.0 <= float(row["link_down_recovery_s"]) < LONG_S
    assert 2.0 <= float(row["reboot_outage_s"]) < LONG_S, "the boot time and the time until the network works"
    assert row["reboot_recovery_s"] == row["reboot_outage_s"]
    assert row["kill_recovered"] == row["kill_outage_s"] == "", "no process was killed"
    assert 0.2 < float(row["rtt_loss"]) < 0.8, "the fault lasts 2 s of the 6 s of pings"
    assert summary(trial)["reboot_recovered"]["value"] == "1"
    evidence = {path.name for path in (trial / "repeats" / "tcp-01").iterdir()}
    assert evidence >= {f"fault-{kind}{end}" for kind in ("link-down", "reboot") for end in (".txt", "-ping.txt")}
    assert run_here(tmp_path, "verify", str(trial)).code == 0
    assert "the same bytes as before" in run_here(tmp_path, "rebuild", str(trial)).out
    untouched()


def test_a_permanent_failure_has_no_times_and_a_failure_during_a_fault_is_a_measurement(tmp_path: Path) -> None:
    (tmp_path / SITE_FILE).write_text(site_with_late_packets(), encoding="utf-8")
    deadline = Deadline.after(LONG_S)
    run = run_procedure(tmp_path, PERMANENT)
    assert run.code == 0, run.err + run.out
    assert not deadline.expired, "the recording of 500 s ended with its robot"
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
    polls_text = (only_trial(tmp_path) / "repeats" / "tcp-01" / "fault-kill-watch.txt").read_text(encoding="ascii")
    polls = [line.split() for line in polls_text.splitlines()[1:]]
    last_up_s = max(float(poll[0]) for poll in polls if len(poll) > 1)
    assert float(recovery["value"]) == pytest.approx(float(polls[-1][0]) - last_up_s, abs=1e-6)
    assert recovery["low"] == recovery["high"] == ""
    assert cells["reboot_recovery_s"]["is_lower_bound"] == "false"


def test_flows_stall_for_the_time_out_of_range_and_tcp_longer(tmp_path: Path) -> None:
    built_in_ros(tmp_path, radio="{mode: n0}")  # at 6.5 Mbit/s, the transfer takes longer than the fault
    run = run_procedure(tmp_path, FLOWS)
    trial = only_trial(tmp_path)
    (row,) = rows(trial)
    assert row["status"] == "valid", row["reason"]
    assert run.code == 1, "the procedure demands stalls of at most 300 ms"
    assert row["out_of_range_recovered"] == "true"
    assert float(row["out_of_range_outage_s"]) >= CUT_S - 0.2
    fault_times = (trial / "repeats" / "tcp-01" / "fault-out-of-range-times.txt").read_text(encoding="ascii")
    started_ns, ended_ns = (int(fault_times.split(f"{name}_utc_ns ")[1].split()[0]) for name in ("began", "ended"))
    cut_s = (ended_ns - started_ns) / 1e9
    for flow in ("soak", "load.iperf3", "topic"):
        durations_s = {name: float(row[f"{flow}_{name}_s"]) for name in ("stall", "out_of_range_outage")}
        assert abs(durations_s["out_of_range_outage"] - cut_s) < TOLERANCE_S, (flow, durations_s, cut_s)
        assert abs(durations_s["stall"] - cut_s) < TOLERANCE_S, (flow, durations_s, cut_s)
        assert 0 <= float(row[f"{flow}_out_of_range_recovery_s"]) < TOLERANCE_S
        assert int(row[f"{flow}_stalls"]) >= 1
    # TCP waits for its retransmission timeout, which has increased during the outage, so it recovers later than the
    # ping.
    assert float(row["up.transfer_stall_s"]) >= cut_s - TOLERANCE_S
    assert float(row["again.up.transfer_out_of_range_recovery_s"]) > 0
    assert float(row["load.iperf3_captured_jitter_mean_s"]) > 0
    assert "again: up: transfer recovery after out-of-range, median" in run.out
    assert "the same bytes as before" in run_here(tmp_path, "rebuild", str(trial)).out


def test_a_killed_service_restarts(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    run = run_procedure(tmp_path, RESTARTING)
    assert run.code == 0, run.err + run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["kill_recovered"] == "true"
    assert 0.1 <= float(row["kill_outage_s"]) < LONG_S


def test_a_failure_before_the_fault_fails_the_attempt_without_a_fault(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    profile = locations.find("robots", "turtlebot3_burger").read_text(encoding="utf-8")
    (tmp_path / "robots").mkdir()
    failing_profile = re.sub(r"record: \[rosbag.*\]", 'record: ["false", "{topics}"]', profile)
    (tmp_path / "robots" / "turtlebot3_burger.yaml").write_text(failing_profile, encoding="utf-8")
    run = run_procedure(tmp_path, FAILING_RECORDER)
    assert run.code == 4, run.err + run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["status"] == "failed"
    assert "recording ended with exit code 1" in row["reason"]
    assert row["reboot_recovered"] == ""
    assert not list(only_trial(tmp_path).glob("repeats/*/fault-reboot.txt"))


def test_a_fault_that_cannot_be_injected_fails_the_attempt(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    deadline = Deadline.after(LONG_S)
    recording = "during: [{record: {robot: receiver, topics: [/pidrone/imu], duration: 500s}}]"
    run = run_procedure(tmp_path, RESTARTING.replace("sensors, after: 0.3s", f"roscore, after: 0.3s, {recording}"))
    assert run.code == 4, run.err + run.out
    assert not deadline.expired, "the steps inside the block were ended"
    (row,) = rows(only_trial(tmp_path))
    assert "no process named roscore is running" in row["reason"]


def summary(trial: Path) -> dict[str, dict[str, str]]:
    return {row["quantity"]: row for row in rows(trial, "summary.csv")}
