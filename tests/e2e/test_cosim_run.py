"""`fieldkit cosim run` on the command line: output, recordings, bad inputs, Ctrl-C and pipes."""

import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from fieldkit.core.columns import Column
from fieldkit.trial.columns import trial_columns
from sim_backends.cosim.recording.manifest import read_manifest, write_manifest
from tests.helpers.paths import DATA
from tests.helpers.runs import Run, finish, run_here, start, wait_during

LIMIT_S = 60.0
TRIAL = DATA / "fieldkit" / "4" / "trials" / "20261122T010946.593049Z_los_30ft_master"
SCENARIO = """\
name: pass
summary: one robot goes by another
world: baylands
duration: 2s
policy: {name: sliding_window, window: 10ms}
agents:
  ann: {robot: husky, along: 0m, radio: {}}
  bob:
    robot: husky
    along: 10m
    heading_deg: 90
    radio: {}
    motion: {kind: way-points, points_m: [[0, 5]], relative: true, speed: 0.9m/s}
traffic:
  - {kind: stream, name: state, from: ann, to: bob, rate: 50Hz, size_bytes: 320}
"""

PINGS = "  - {kind: ping, name: ping, from: bob, to: ann, count: 10, interval: 100ms}\n"


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "pass.yaml").write_text(SCENARIO, encoding="utf-8")
    return tmp_path


def cosim(lab: Path, *words: str) -> Run:
    """Run `fieldkit cosim` in this process, which has already imported most of its modules."""
    return run_here(lab, "cosim", *words)


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def event_hash(run: Run) -> str:
    (line,) = (line for line in run.out.splitlines() if line.startswith("event hash: "))
    return line


def test_each_flow_is_printed_in_every_format(lab: Path) -> None:
    table = cosim(lab, "run", "pass.yaml")
    assert table.code == 0, table.err
    assert "state/bob" in table.out
    assert max(map(len, table.out.splitlines())) <= 100
    (row,) = rows(cosim(lab, "run", "pass.yaml", "--format", "csv").out)
    (flow,) = json.loads(cosim(lab, "run", "pass.yaml", "--format", "json").out)["flows"]
    assert (row["flow"], row["sent"]) == (flow["flow"], str(flow["sent"])) == ("state/bob", "100")
    assert cosim(lab, "run", "pass.yaml", "--format", "markdown").out.startswith("| ")


def test_options_change_the_scenario(lab: Path) -> None:
    def sent(*options: str) -> int:
        return int(rows(cosim(lab, "run", "pass.yaml", "--format", "csv", *options).out)[0]["sent"])

    assert sent("--duration", "1s") == 50
    assert sent("--set", "duration=500ms") == 25
    assert event_hash(cosim(lab, "run", "pass.yaml", "--seed", "1")) == event_hash(cosim(lab, "run", "pass.yaml"))


def test_all_seeds_of_the_scenario_are_run_by_default(lab: Path) -> None:
    path = lab / "pass.yaml"
    path.write_text(path.read_text(encoding="utf-8") + "seeds: [7, 3]\n", encoding="utf-8")

    def seeds(*words: str) -> list[str]:
        run = cosim(lab, *words, "pass.yaml", "--duration", "100ms", "--format", "csv")
        return [row.get("seed", row.get("seeds", "")) for row in rows(run.out)]

    assert seeds("run") == ["7", "3"]
    assert seeds("run", "--seed", "5") == ["5"]
    assert seeds("run", "--seeds", "3") == ["1", "2", "3"]
    assert seeds("shootout", "--policy", "scheduled") == ["2"]
    cosim(lab, "run", "pass.yaml", "--duration", "100ms", "--out", "sim")
    assert sorted(path.parent.name for path in (lab / "sim").glob("*/run.json")) == ["seed-3", "seed-7"]
    rejected_run = cosim(lab, "run", "pass.yaml", "--set", "seeds=[1, 1]")
    assert (rejected_run.code, "a seed is listed twice" in rejected_run.err) == (2, True)


def test_a_folder_has_a_recording_per_seed_and_is_reproducible(lab: Path) -> None:
    for name in ("one", "two"):
        run = cosim(lab, "run", "pass.yaml", "--seeds", "2", "--out", f"{name}/sim")
        assert run.code == 0, run.err
    for seed in (1, 2):
        table = (lab / "one" / "sim" / f"seed-{seed}" / "trial.csv").read_text(encoding="utf-8")
        assert table == (lab / "two" / "sim" / f"seed-{seed}" / "trial.csv").read_text(encoding="utf-8")
        (row,) = rows(table)
        assert (row["repeat"], row["seed"], row["status"], row["backend"]) == (str(seed), str(seed), "valid", "cosim")
        assert (row["sender"], row["receiver"], row["distance"]) == ("ann", "bob", "10m")
        declared: dict[str, Column] = {column.name: column for column in trial_columns()}
        assert row.keys() <= declared.keys()
        assert not [name for name, text in row.items() if declared[name].invalid_value_reason(text)]
    assert cosim(lab, "run", "one/sim/pass.yaml", "--format", "csv").out.count("\n") == 2, (
        "the stored scenario can be run"
    )


def test_a_recording_reproduces_the_numbers_and_can_be_plotted(lab: Path) -> None:
    original = cosim(lab, "run", "pass.yaml", "--out", "sim")
    replayed_run = cosim(lab, "replay", "sim")
    assert replayed_run.code == 0, replayed_run.err
    assert event_hash(replayed_run) == event_hash(original)
    assert replayed_run.out.splitlines()[1:4] == original.out.splitlines()[1:4]
    assert cosim(lab, "plot", "sim", "--out", "run.svg").code == 0
    assert "state/bob" in (lab / "run.svg").read_text(encoding="utf-8")


def test_replay_and_plot_reject_invalid_recordings(lab: Path) -> None:
    cosim(lab, "run", "pass.yaml", "--seeds", "2", "--duration", "100ms", "--out", "sim")
    for words in (("replay", "sim"), ("plot", "sim")):
        rejected_run = cosim(lab, *words)
        assert (rejected_run.code, "give the folder of one recording: sim/seed-1" in rejected_run.err) == (4, True), (
            rejected_run.err
        )
    assert "there is no recording" in cosim(lab, "replay", ".").err
    damaged_file = next((lab / "sim" / "seed-1" / "packets").iterdir())
    damaged_file.write_bytes(damaged_file.read_bytes()[:-1])
    rejected_run = cosim(lab, "replay", "sim/seed-1")
    assert (rejected_run.code, "was changed after the run" in rejected_run.err) == (4, True), rejected_run.err
    assert "use the suffix .svg, .pdf, .png" in cosim(lab, "plot", "sim/seed-2", "--out", "run.txt").err
    manifest = read_manifest(lab / "sim" / "seed-2")
    about = replace(manifest.about, scenario="- of another version")
    write_manifest(lab / "sim" / "seed-2", replace(manifest, about=about, scenario_hash=about.scenario_hash))
    for command in ("replay", "plot"):
        rejected_run = cosim(lab, command, "sim/seed-2")
        assert "the recorded scenario cannot be read" in rejected_run.err
        assert rejected_run.code == 4, rejected_run.err


@pytest.mark.parametrize(
    ("words", "message", "remedy"),
    [
        (("run", "pas"), "there is no scenario 'pas'", "baylands"),
        (("run", "none.yaml"), "none.yaml: cannot be read: No such file", "ls -l none.yaml"),
        (("run", "pass.yaml", "--policy", "sliding"), "there is no sync policy 'sliding'", "sliding_window"),
        (("run", "pass.yaml", "--seed", "-1"), "'-1' is not a whole number of at least 0", "--help"),
        (("run", "pass.yaml", "--seeds", "0"), "must be at least 1", "--help"),
        (("run", "pass.yaml", "--seed", "1", "--seeds", "2"), "not allowed with", "--help"),
        (("run", "pass.yaml", "--set", "duration"), "--set: 'duration' is not KEY=VALUE", "--set policy.window=5ms"),
        (("run", "pass.yaml", "--set", "lasts=1s"), "unknown key lasts", "duration"),
        (("run", "pass.yaml", "--window", "5"), "has no unit", "5s or 5ms"),
        (("run", "pass.yaml", "--duration", "0s"), "greater than 0", "correct the option with this value"),
        (("run", "pass.yaml", "--window", "0s"), "greater than 0", ""),
        (("run", "pass.yaml", "--out", "taken"), "taken: this folder is not empty", "choose another --out"),
        (("run", "pass.yaml", "--out", "pass.yaml"), "cannot be written: File exists", "choose another --out"),
        (("run", "pass.yaml", "--out", "/proc/sim"), "cannot be written: ", "choose another --out"),
        (("rnu",), "COMMAND cannot be 'rnu'", "did you mean 'run'?"),
        (("run", "pass.yaml", "--polcy", "x"), "has no option or argument '--polcy'", "--policy"),
    ],
)
def test_bad_input_is_reported_with_a_remedy(lab: Path, words: tuple[str, ...], message: str, remedy: str) -> None:
    (lab / "taken").mkdir()
    (lab / "taken" / "file").touch()
    rejected_run = cosim(lab, *words)
    assert rejected_run.code == 2, rejected_run.out + rejected_run.err
    assert rejected_run.err.startswith("error: ")
    assert message in rejected_run.err
    assert remedy in rejected_run.err
    assert not rejected_run.out
    assert "Traceback" not in rejected_run.err


def test_ctrl_c_keeps_the_recording(lab: Path) -> None:
    process = start(lab, "cosim", "run", "pass.yaml", "--duration", "10min", "--out", "sim")
    wait_during(process, lambda: bool(list((lab / "sim").glob("windows/*.parquet"))))
    process.send_signal(signal.SIGINT)
    run = finish(process)
    assert run.code == 130, run.err
    assert "seed 1: interrupted at" in run.err
    assert "Traceback" not in run.err
    (row,) = rows((lab / "sim" / "trial.csv").read_text(encoding="utf-8"))
    assert (row["status"], row["reason"].partition(" at ")[0]) == ("failed", "interrupted")
    replayed_run = cosim(lab, "replay", "sim")
    assert "(interrupted)" in replayed_run.err
    assert event_hash(replayed_run) == event_hash(run), "the recording equals the output"


def test_ctrl_c_stops_a_run_of_many_seeds_and_keeps_finished_ones(lab: Path) -> None:
    process = start(lab, "cosim", "run", "pass.yaml", "--seeds", "10000", "--out", "sim")
    # When a process starts another seed, it has reported the previous one.
    processors = len(os.sched_getaffinity(0))
    wait_during(process, lambda: len(list((lab / "sim").glob("seed-*/trial.csv"))) > processors)
    process.send_signal(signal.SIGINT)
    run = finish(process)
    assert run.code == 130, run.err
    assert "Traceback" not in run.err
    finished_seeds = sorted(
        int(path.parent.name.removeprefix("seed-")) for path in (lab / "sim").glob("seed-*/trial.csv")
    )
    printed_seeds = [int(line.split()[0]) for line in run.out.splitlines() if " state/bob " in line]
    assert printed_seeds
    # One more seed may have finished after the last report.
    assert set(printed_seeds) <= set(finished_seeds)
    assert f"interrupted: the runs of {len(printed_seeds)} of 10000 seeds had finished" in run.err
    aggregate_run = run_here(lab, "aggregate", "sim", "--format", "csv")
    assert aggregate_run.code == 0, aggregate_run.err


def test_a_policy_that_finds_no_window_ends_the_run_and_keeps_the_recording(lab: Path) -> None:
    # The publisher is stationary, and the subscriber reaches 0.9 m/s, so the window would be 0.5 ms - 0.9 ms.
    raw = ("--policy", "velocity_aware_raw", "--window", "0.5ms", "--set", "physics.step=0.1ms")
    run = cosim(lab, "run", "pass.yaml", *raw, "--out", "sim")
    assert run.code == 2
    assert "w + (Vp - Vs)/1000" in run.err
    replayed_run = cosim(lab, "replay", "sim", "--format", "csv")
    assert 0 < int(rows(replayed_run.out)[0]["sent"]) < 100


def test_faults_are_reported_with_recovered_flows_and_times(lab: Path) -> None:
    path = lab / "pass.yaml"
    path.write_text(path.read_text(encoding="utf-8") + PINGS, encoding="utf-8")
    cut = ("--set", "faults=[{kind: link-cut, between: [ann, bob], from: 200ms, to: 600ms}]")
    run = cosim(lab, "run", "pass.yaml", "--duration", "1s", *cut, "--out", "sim")
    assert run.code == 0, run.err
    lost_by_flow = dict(re.findall(r"^ link-cut +(\S+) +0\.6 +(\d+) +\d", run.out, re.MULTILINE))
    assert lost_by_flow == {"state/bob": "20", "ping/ann": "4", "ping/ann/reply": "0"}
    assert recovery(run.out) == recovery(cosim(lab, "replay", "sim").out)
    recoveries = json.loads(cosim(lab, "replay", "sim", "--format", "json").out)["recoveries"]
    assert [
        (recovery_row["fault"], recovery_row["flow"], recovery_row["end_s"], recovery_row["lost"])
        for recovery_row in recoveries
    ] == [("link-cut", flow, 0.6, int(lost)) for flow, lost in sorted(lost_by_flow.items())]
    assert all(0 < recovery_row["recovered_s"] < 0.2 for recovery_row in recoveries)
    rows_by_trial = {row["trial"]: row for row in rows((lab / "sim" / "trial.csv").read_text(encoding="utf-8"))}
    row = rows_by_trial["sim/ping/ann"]
    assert (row["rtt_sent"], row["rtt_received"], row["rtt_payload_bytes"]) == ("10", "6", "56")
    assert float(row["rtt_loss"]) == pytest.approx(0.4)
    # Each direction takes about 0.1 ms. The policy delays no packets, but a responder resumes only at the end of a
    # window.
    assert 0 < float(row["rtt_min_s"]) <= float(row["rtt_median_s"]) <= float(row["rtt_max_s"]) < 0.01
    assert not rows_by_trial["sim/state/bob"]["rtt_sent"]


def recovery(printed: str) -> str:
    return printed.partition("recovery\n")[2].partition("ended at:")[0]


def test_an_unresponsive_federate_is_named_and_the_recording_is_kept(lab: Path) -> None:
    stall = "faults=[{kind: stalled-federate, federate: network, from: 200ms, stall: 1min}]"
    run = cosim(lab, "run", "pass.yaml", "--set", stall, "--deadline", "200ms", "--out", "sim")
    assert run.code == 3
    assert "network has not answered for 0.2 s: request to advance from 0.19" in run.err
    replayed_run = cosim(lab, "replay", "sim")
    assert "(failed): UnansweredError: network has not answered" in replayed_run.err
    assert event_hash(replayed_run) == event_hash(run)
    assert "--deadline 30s" in cosim(lab, "run", "pass.yaml", "--deadline", "0s").err


def test_a_recording_has_a_capture_per_robot_and_can_be_converted_to_mcap(lab: Path) -> None:
    cosim(lab, "run", "pass.yaml", "--duration", "200ms", "--out", "sim")
    assert [path.name for path in sorted((lab / "sim" / "captures").iterdir())] == ["ann.pcap", "bob.pcap"]
    run = cosim(lab, "replay", "sim", "--mcap", "sim.mcap")
    assert run.code == 0, run.err
    assert "written: sim.mcap" in run.err
    with (lab / "sim.mcap").open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert topics == {"/tf", "/states/ann", "/states/bob", "/packets/state/bob"}
    rejected_run = cosim(lab, "replay", "sim", "--mcap", "none/sim.mcap")
    assert (rejected_run.code, "choose another --mcap" in rejected_run.err) == (2, True), rejected_run.err


def test_equal_seeds_give_equal_hashes_under_any_load(lab: Path) -> None:
    """One run is alone on the machine, and the other runs while processes use all processors."""
    alone = cosim(lab, "run", "pass.yaml", "--seed", "7")
    with ExitStack() as load:
        for _ in os.sched_getaffinity(0):
            process = load.enter_context(subprocess.Popen((sys.executable, "-c", "while True: pass")))
            load.callback(process.kill)
        under_load = cosim(lab, "run", "pass.yaml", "--seed", "7")
    assert (alone.code, under_load.code) == (0, 0), alone.err + under_load.err
    assert event_hash(alone) == event_hash(under_load)
    assert event_hash(alone) != event_hash(cosim(lab, "run", "pass.yaml", "--seed", "8"))


def test_fieldkit_reads_simulations_like_trials(lab: Path) -> None:
    """Robots 30 ft apart, as in the stored trial with which they are compared."""
    options = ("--set", "agents.bob.along=9.144m", "--duration", "500ms", "--seeds", "2")
    for policy in ("sliding_window", "scheduled"):
        assert cosim(lab, "run", "pass.yaml", *options, "--policy", policy, "--out", policy).code == 0
    (cell,) = [
        row for row in rows(run_here(lab, "aggregate", "scheduled", "--format", "csv").out) if is_loss_row(row)
    ]
    assert (cell["n_valid"], cell["backend"], cell["distance_m"]) == ("2", "cosim", "9.144")
    assert cell["procedure"] == "pass state/bob (scheduled 10 ms)"
    comparison = run_here(lab, "compare", "scheduled", "sliding_window", "--format", "csv")
    assert [row["n_b"] for row in rows(comparison.out) if is_loss_row(row)] == ["2"], comparison.err
    trial = run_here(
        lab, "compare", str(TRIAL), "scheduled", "--by", "scenario,distance_m,protocol", "--force", "--format", "csv"
    )
    assert [row["n_b"] for row in rows(trial.out) if is_loss_row(row)] == ["2"], trial.err
    page = run_here(lab, "report", "scheduled", str(TRIAL), "-o", "page.html")
    assert page.code == 0, page.err
    assert "pass state/bob (scheduled 10 ms)" in (lab / "page.html").read_text(encoding="utf-8")
    for form in ("csv", "parquet"):
        assert run_here(lab, "export", "scheduled", "--format", form, "-o", f"all.{form}").code == 0
    assert len(rows((lab / "all.csv").read_text(encoding="utf-8"))) == 2
    rejected_run = run_here(lab, "export", "scheduled/seed-1", "--format", "mcap", "-o", "one.mcap")
    assert rejected_run.code == 2, "a simulation has no timeline of a trial"
    assert "Traceback" not in rejected_run.err


def is_loss_row(row: dict[str, str]) -> bool:
    return row["quantity"] == "datagram_loss"


def test_a_closed_pipe_ends_the_run_silently(lab: Path) -> None:
    command = f"set -o pipefail; '{sys.executable}' -m fieldkit cosim run pass.yaml --window 11ms | true"
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    run = subprocess.run(
        ("bash", "-c", command), cwd=lab, capture_output=True, text=True, check=False, timeout=LIMIT_S, env=buffered
    )
    assert (run.returncode, run.stderr) == (0, "")


def test_without_a_terminal_there_are_no_colours_and_no_progress_bar(lab: Path) -> None:
    run = cosim(lab, "run", "pass.yaml", "--window", "11ms")
    assert "\x1b" not in run.out
    assert not run.err
