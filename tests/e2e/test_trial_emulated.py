"""`fieldkit trial` on emulated robots, and commands that read its folder."""

import csv
import math
import shutil
import signal
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader

from fieldkit.core.model import Role
from fieldkit.trial.columns import robot_columns, trial_columns
from tests.helpers.host import NamespaceComparison, descendants, wait_for_end
from tests.helpers.labs import built_in_ros, copy_shipped
from tests.helpers.runs import Run, fieldkit, only_trial, rows, run_here, start, wait_for_line

pytestmark = pytest.mark.emulated

TRIAL = ("trial", "los", "30ft", "--repeats", "2", "--record", "2s")


@pytest.fixture(scope="module")
def lab_and_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """A lab with a trial without void attempts, and the run of the trial; tests must not change the lab."""
    for _ in range(3):  # on a busy machine, an attempt may be void because packets were late
        lab = tmp_path_factory.mktemp("lab")
        run = fieldkit(lab, *TRIAL)
        assert run.code == 0, run.err
        reasons = [row["reason"] for row in rows(only_trial(lab)) if row["status"] != "valid"]
        if not reasons:
            return lab, run
    raise AssertionError(reasons)


@pytest.fixture
def lab_copy(lab_and_run: tuple[Path, Run], tmp_path: Path) -> Path:
    """A copy of the lab of `lab_and_run`, which the test may change."""
    return Path(shutil.copytree(lab_and_run[0], tmp_path / "copy"))


def test_the_trial_is_valid_and_prints_its_table(lab_and_run: tuple[Path, Run]) -> None:
    _, run = lab_and_run
    assert "using emulated robots" in run.out
    assert "4/4" in run.out
    for label in ("2 valid", "radio loss", "RTT, 8192-byte ping, median", "goodput, median", "next: fieldkit report"):
        assert label in run.out
    assert "\x1b" not in run.out, "the output has no terminal codes if it is not a terminal"


def test_the_folder_contains_every_piece_of_evidence(lab_and_run: tuple[Path, Run]) -> None:
    trial = only_trial(lab_and_run[0])
    assert trial.name.endswith("_los_30ft_master")
    names = {path.name for path in trial.iterdir()}
    files = {
        "trial.yaml",
        "journal.jsonl",
        "trial.csv",
        "summary.csv",
        "preflight.txt",
        "MANIFEST.sha256",
    }
    assert names == files | {"repeats"}
    assert {path.name for path in (trial / "repeats").iterdir()} == {"tcp-01", "tcp-02", "udp-01", "udp-02"}
    evidence = {path.name for path in (trial / "repeats" / "udp-01").iterdir()}
    assert evidence >= {"scan.bag", "recv.bag", "sender.pcap", "receiver.pcap", "ping.txt"}
    assert evidence >= {f"{role}-{when}.txt" for role in ("sender", "receiver") for when in ("before", "after")}


def test_aggregate_of_one_trial_from_raw_evidence_is_its_summary(lab_copy: Path) -> None:
    lab = lab_copy
    trial = only_trial(lab)
    (trial / "trial.csv").rename(lab / "trial.csv.away")
    rebuild_run = run_here(lab, "aggregate", "trials", "--rebuild", "--format", "csv")
    (lab / "trial.csv.away").rename(trial / "trial.csv")
    for run in (rebuild_run, run_here(lab, "aggregate", str(trial), "--format", "csv")):
        assert run.out == (trial / "summary.csv").read_text(encoding="utf-8"), run.err
    assert run_here(lab, "verify", str(trial)).code == 0


def test_the_rows_contain_the_results(lab_and_run: tuple[Path, Run]) -> None:
    trial = only_trial(lab_and_run[0])
    table = rows(trial)
    declared_names = [column.name for column in (*trial_columns(), *robot_columns((Role.SENDER, Role.RECEIVER)))]
    assert list(table[0])[: len(trial_columns())] == declared_names[: len(trial_columns())]
    assert sorted(table[0]) == sorted(declared_names)
    assert [(row["protocol"], row["repeat"], row["status"]) for row in table] == [
        ("tcp", "1", "valid"),
        ("udp", "1", "valid"),
        ("tcp", "2", "valid"),
        ("udp", "2", "valid"),
    ]
    for row in table:
        folder = trial / "repeats" / f"{row['protocol']}-{int(row['repeat']):02d}"
        sent_file, received_file = ((folder / name).read_bytes() for name in ("scan.bag", "recv.bag"))
        assert int(row["sent_bytes"]) == len(sent_file)
        assert int(row["received_bytes"]) == len(received_file)
        assert row["hash_match"] == str(sent_file == received_file).lower()
        with Reader(folder / "scan.bag") as bag:
            messages = bag.message_count
        assert int(row["bag_messages"]) == messages
        assert 0 < messages <= 11, "2 s of a 5 Hz laser, minus the time to subscribe"
        assert (row["sender"], row["receiver"], row["relay"]) == ("turtlebot-1", "turtlebot-2", "duckiedrone-1")
        assert float(row["distance_m"]) == pytest.approx(9.144)
        assert 0 < int(row["rtt_received"]) <= int(row["rtt_sent"]) == 10, "fading may lose echoes"
        assert float(row["paper_transfer_s"]) == pytest.approx(
            int(row["paper_packets"]) * float(row["paper_delay_s"]), rel=1e-6
        )
    for row in (row for row in table if row["protocol"] == "udp"):
        assert int(row["datagrams_sent"]) == math.ceil(int(row["sent_bytes"]) / 8192)
        assert row["tcp_sent_bytes"] == "", "missing is empty"
    for row in (row for row in table if row["protocol"] == "tcp"):
        assert row["hash_match"] == "true"
        assert row["ip_loss"] == "", "missing is empty"


def test_a_simulation_of_the_same_trial_is_compared_without_options(lab_copy: Path) -> None:
    trial = only_trial(lab_copy)
    size_bytes = rows(trial)[0]["sent_bytes"]
    changes = ("trial.record=2s", *(f"traffic.{number}.size_bytes={size_bytes}" for number in (0, 2)))
    options = [word for change in changes for word in ("--set", change)]
    cosim_run = run_here(lab_copy, "cosim", "run", "field_30ft", *options, "--out", "simulated")
    assert cosim_run.code == 0, cosim_run.err
    compare_run = run_here(lab_copy, "compare", "simulated", str(trial), "--format", "csv")
    assert compare_run.code == 0, compare_run.err
    assert "not comparable" not in compare_run.err
    values = {
        (row["protocol"], row["quantity"]): (float(row["a"]), float(row["b"]))
        for row in csv.DictReader(compare_run.out.splitlines())
        if row["a"] and row["b"]
    }
    for protocol in ("tcp", "udp"):
        # The simulation does not model the processing time of programs and kernels.
        assert values[protocol, "transfer_s"][0] < 1.2 * values[protocol, "transfer_s"][1]
        assert values[protocol, "rtt_median_s"][0] < values[protocol, "rtt_median_s"][1]


def test_verify_finds_one_flipped_byte_and_rebuild_gives_the_same_bytes(lab_copy: Path) -> None:
    lab = lab_copy
    trial = only_trial(lab)
    assert run_here(lab, "verify", str(trial)).code == 0
    before = {name: (trial / name).read_bytes() for name in ("trial.csv", "summary.csv")}
    (trial / "trial.csv").unlink()
    (trial / "summary.csv").write_text("", encoding="utf-8")
    assert run_here(lab, "rebuild", str(trial)).code == 0
    assert before == {name: (trial / name).read_bytes() for name in before}
    rebuild_run = run_here(lab, "rebuild", str(trial))
    assert "the same bytes as before" in rebuild_run.out
    pcap = trial / "repeats" / "tcp-02" / "receiver.pcap"
    content = bytearray(pcap.read_bytes())
    content[-1] ^= 0x10
    pcap.write_bytes(content)
    verify_run = run_here(lab, "verify", str(trial))
    assert verify_run.code == 4
    assert "repeats/tcp-02/receiver.pcap: changed" in verify_run.err


def test_a_masterless_trial_behind_the_wall_prints_one_json_object_per_line(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    words = ("--topology", "masterless", "--repeats", "1", "--record", "1s", "--protocol", "tcp", "--json")
    run = run_here(tmp_path, "trial", "nlos", "5m", *words)
    assert run.code == 0, run.err
    (event_data,) = run.events("repeat_ended")
    assert (event_data["repeat"], event_data["status"], event_data["done"], event_data["total"]) == (
        "tcp-01",
        "valid",
        1,
        1,
    )
    (trial_ended,) = run.events("trial_ended")
    assert Path(tmp_path / trial_ended["folder"]) == only_trial(tmp_path)
    assert {event["name"] for event in run.events("phase_started")} >= {"record", "transfer", "ping"}
    assert {
        (row["scenario"], row["topology"], row["relay"], row["receiver"]) for row in rows(only_trial(tmp_path))
    } == {("nlos", "masterless", "", "duckiedrone-1")}


def test_a_dry_run_prints_every_command_and_starts_no_robot(tmp_path: Path, untouched: NamespaceComparison) -> None:
    run = fieldkit(tmp_path, "trial", "los", "30ft", "--dry-run")
    assert run.code == 0, run.err
    assert "## udp: turtlebot-1 (sender, 10.42.0.1)" in run.out
    assert "rosbag record --duration=15 -O scan /scan" in run.out
    assert "nc.traditional -u -q 0 10.42.0.2 1234 < scan.bag" in run.out
    assert run.out.count(" begin .fieldkit/") == run.out.count(" pack .fieldkit/") == 4, "two robots, two protocols"
    untouched()
    assert list(tmp_path.iterdir()) == []


def test_a_silent_topic_makes_every_attempt_void_and_the_trial_invalid(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    copy_shipped(
        tmp_path,
        "procedures",
        "los",
        "topics: [/scan]",
        "topics: [/nothing]",
        "repeats: 20",
        "repeats: 1\nattempts: 2",
    )
    run = run_here(tmp_path, "trial", "los", "30ft", "--record", "1s", "--protocol", "tcp")
    assert run.code == 4
    trial = only_trial(tmp_path)
    table = rows(trial)
    assert [(row["attempt"], row["status"]) for row in table] == [("1", "void"), ("2", "failed")]
    assert all("scan.bag" in row["reason"] for row in table)
    assert {path.name for path in (trial / "repeats").iterdir()} == {"tcp-01.void1", "tcp-01.failed2"}
    assert run_here(tmp_path, "verify", str(trial)).code == 0


def test_a_missing_tool_stops_the_trial_before_repeat_1(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    copy_shipped(tmp_path, "robots", "turtlebot3_burger", "netcat: nc.traditional", "netcat: nc.imaginary")
    run = run_here(tmp_path, "trial", "los", "30ft")
    assert run.code == 3
    assert "nc.imaginary" in run.err
    assert "turtlebot-1" in run.err
    assert "remedy" in run.err


def test_after_kill_9_only_completed_repeats_remain(tmp_path: Path, untouched: NamespaceComparison) -> None:
    process = start(
        tmp_path, "trial", "los", "30ft", "--repeats", "5", "--record", "2s", "--protocol", "tcp", "--json"
    )
    wait_for_line(process, '"status": "valid"')
    wait_for_line(process, '"transfer"')
    process_ids = descendants(process.pid)
    assert len(process_ids) > 10, "three robots with their programs, and the medium"
    process.send_signal(signal.SIGKILL)
    process.wait(60)
    wait_for_end(process_ids, within_s=60.0)
    untouched()
    trial = only_trial(tmp_path)
    assert [row["repeat"] for row in rows(trial) if row["status"] == "valid"] == ["1"]
    assert run_here(tmp_path, "verify", str(trial)).code == 0
    assert "changed: summary.csv" in run_here(tmp_path, "rebuild", str(trial)).out
    assert rows(trial, "summary.csv")[0]["n_valid"] == "1"
    assert process.stdout is not None
    process.stdout.close()
