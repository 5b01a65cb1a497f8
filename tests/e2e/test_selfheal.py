"""Self-healing from the outside: `fieldkit trial selfheal`, real faults, and what its rows then say."""

import re
from pathlib import Path

import pytest

from fieldkit.config import locations
from fieldkit.core.deadline import Deadline
from tests.helpers.host import Untouched
from tests.helpers.labs import built_in_ros, own_procedure
from tests.helpers.runs import Run, fieldkit, only_trial, rows

pytestmark = pytest.mark.emulated

LONG_S = 300.0
"""On a busy machine all takes longer, but not as long as this."""

# The ping that is killed ends for ever; the sensors come back; the sender is rebooted while it records.
NEVER = """\
name: never
summary: a process that nobody starts again, and steps that a fault makes fail
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1
attempts: 1
steps:
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
  - fault: {robot: receiver, kind: out-of-range, for: 1s, after: 0.5s}
"""

HEALS = """\
name: heals
summary: a process that its robot starts again
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1
attempts: 1
steps:
  - fault: {robot: receiver, kind: kill, process: sensors, after: 0.3s}
"""

BROKEN = """\
name: broken
summary: what fails before the fault is no work of the fault
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1
attempts: 1
steps:
  - fault:
      robot: receiver
      kind: reboot
      after: 60s
      during:
        - record: {robot: sender, topics: [/scan], duration: 1s}
"""


def run_procedure(lab: Path, text: str) -> Run:
    return fieldkit(lab, "trial", own_procedure(lab, text), "5m")


def test_a_link_and_a_robot_come_back_and_the_rows_say_when(tmp_path: Path, untouched: Untouched) -> None:
    run = fieldkit(tmp_path, "trial", "selfheal", "5m", "--repeats", "1")
    assert run.code == 0, run.err + run.out
    assert "recovery from link-down, median" in run.out
    assert "reboot: gone for " in run.out
    trial = only_trial(tmp_path)
    (row,) = rows(trial)
    assert row["link_down_recovered"] == row["reboot_recovered"] == "true"
    assert 2.0 <= float(row["link_down_outage_s"]) < LONG_S
    assert 0.0 <= float(row["link_down_recovery_s"]) < LONG_S
    assert 2.0 <= float(row["reboot_outage_s"]) < LONG_S, "the boot time, and what its network takes"
    assert row["reboot_recovery_s"] == row["reboot_outage_s"]
    assert row["kill_recovered"] == row["kill_outage_s"] == "", "there was none"
    assert 0.2 < float(row["rtt_loss"]) < 0.8, "the steps inside met the fault: 2 s of 6 s"
    assert summary(trial)["reboot_recovered"]["value"] == "1"
    evidence = {path.name for path in (trial / "repeats" / "tcp-01").iterdir()}
    assert evidence >= {f"fault-{kind}{end}" for kind in ("link-down", "reboot") for end in (".txt", "-ping.txt")}
    assert fieldkit(tmp_path, "verify", str(trial)).code == 0
    assert "the same bytes as before" in fieldkit(tmp_path, "rebuild", str(trial)).out
    untouched()


def test_what_never_heals_has_no_times_and_what_fails_inside_a_fault_is_a_result(tmp_path: Path) -> None:
    began = Deadline.after(LONG_S)
    run = run_procedure(tmp_path, NEVER)
    assert run.code == 0, run.err + run.out
    assert not began.expired, "the recording of 500 s ended with its robot"
    assert "kill: did not come back" in run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["status"] == "valid"
    assert (row["kill_recovered"], row["kill_outage_s"], row["kill_recovery_s"]) == ("false", "", "")
    assert row["reboot_recovered"] == row["out_of_range_recovered"] == "true"
    assert 1.0 <= float(row["out_of_range_outage_s"]) < LONG_S
    cells = summary(only_trial(tmp_path))
    assert cells["kill_recovered"]["value"] == "0"
    assert "kill_recovery_s" not in cells


def test_a_service_that_is_killed_comes_back(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    run = run_procedure(tmp_path, HEALS)
    assert run.code == 0, run.err + run.out
    (row,) = rows(only_trial(tmp_path))
    assert row["kill_recovered"] == "true"
    assert 0.1 <= float(row["kill_outage_s"]) < LONG_S


def test_what_fails_before_the_fault_makes_the_attempt_fail_and_there_is_no_fault(tmp_path: Path) -> None:
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


def test_a_fault_that_cannot_be_made_makes_the_attempt_fail(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    began = Deadline.after(LONG_S)
    recording = "during: [{record: {robot: receiver, topics: [/pidrone/imu], duration: 500s}}]"
    run = run_procedure(tmp_path, HEALS.replace("sensors, after: 0.3s", f"roscore, after: 0.3s, {recording}"))
    assert run.code == 4, run.err + run.out
    assert not began.expired, "what ran inside was ended"
    (row,) = rows(only_trial(tmp_path))
    assert "no process named roscore runs" in row["reason"]


def summary(trial: Path) -> dict[str, dict[str, str]]:
    return {row["quantity"]: row for row in rows(trial, "summary.csv")}
