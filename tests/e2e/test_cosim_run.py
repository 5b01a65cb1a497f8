"""`fieldkit cosim run` as a user types it: what it prints and keeps, bad inputs, Ctrl-C, pipes."""

import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
from contextlib import ExitStack, chdir, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from fieldkit.cli import main
from fieldkit.core.columns import Column
from fieldkit.trial.columns import trial_columns
from sim_backends.cosim.recording.manifest import read_manifest, write_manifest
from tests.helpers.paths import DATA
from tests.helpers.runs import Run, fieldkit, finish, start

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
    """Run `fieldkit cosim` in this process, where most of what it imports is imported already."""
    return here(lab, "cosim", *words)


def here(lab: Path, *words: str) -> Run:
    """Run fieldkit in this process."""
    out, err = io.StringIO(), io.StringIO()
    with chdir(lab), redirect_stdout(out), redirect_stderr(err):
        code = main(words)
    return Run(code, out.getvalue(), err.getvalue())


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def event_hash(run: Run) -> str:
    (line,) = (line for line in run.out.splitlines() if line.startswith("event hash: "))
    return line


def test_it_prints_each_flow_in_every_form(lab: Path) -> None:
    table = cosim(lab, "run", "pass.yaml")
    assert table.code == 0, table.err
    assert "state/bob" in table.out
    assert max(map(len, table.out.splitlines())) <= 100
    (row,) = rows(cosim(lab, "run", "pass.yaml", "--format", "csv").out)
    (same,) = json.loads(cosim(lab, "run", "pass.yaml", "--format", "json").out)["flows"]
    assert (row["flow"], row["sent"]) == (same["flow"], str(same["sent"])) == ("state/bob", "100")
    assert cosim(lab, "run", "pass.yaml", "--format", "markdown").out.startswith("| ")


def test_options_change_the_scenario(lab: Path) -> None:
    def sent(*options: str) -> int:
        return int(rows(cosim(lab, "run", "pass.yaml", "--format", "csv", *options).out)[0]["sent"])

    assert sent("--duration", "1s") == 50
    assert sent("--set", "duration=500ms") == 25
    assert event_hash(cosim(lab, "run", "pass.yaml", "--seed", "1")) == event_hash(cosim(lab, "run", "pass.yaml"))


def test_all_seeds_of_the_scenario_are_run_unless_an_option_says_otherwise(lab: Path) -> None:
    path = lab / "pass.yaml"
    path.write_text(path.read_text(encoding="utf-8") + "seeds: [7, 3]\n", encoding="utf-8")

    def seeds(*words: str) -> list[str]:
        done = cosim(lab, *words, "pass.yaml", "--duration", "100ms", "--format", "csv")
        return [row.get("seed", row.get("seeds", "")) for row in rows(done.out)]

    assert seeds("run") == ["7", "3"]
    assert seeds("run", "--seed", "5") == ["5"]
    assert seeds("run", "--seeds", "3") == ["1", "2", "3"]
    assert seeds("shootout", "--policy", "scheduled") == ["2"]
    cosim(lab, "run", "pass.yaml", "--duration", "100ms", "--out", "sim")
    assert sorted(one.parent.name for one in (lab / "sim").glob("*/run.json")) == ["seed-3", "seed-7"]
    refused = cosim(lab, "run", "pass.yaml", "--set", "seeds=[1, 1]")
    assert (refused.code, "a seed is named twice" in refused.err) == (2, True)


def test_a_folder_has_a_recording_for_each_seed_and_equal_runs_are_equal(lab: Path) -> None:
    for name in ("one", "two"):
        done = cosim(lab, "run", "pass.yaml", "--seeds", "2", "--out", f"{name}/sim")
        assert done.code == 0, done.err
    for seed in (1, 2):
        table = (lab / "one" / "sim" / f"seed-{seed}" / "trial.csv").read_text(encoding="utf-8")
        assert table == (lab / "two" / "sim" / f"seed-{seed}" / "trial.csv").read_text(encoding="utf-8")
        (row,) = rows(table)
        assert (row["repeat"], row["seed"], row["status"], row["backend"]) == (str(seed), str(seed), "valid", "cosim")
        assert (row["sender"], row["receiver"], row["distance"]) == ("ann", "bob", "10m")
        declared: dict[str, Column] = {column.name: column for column in trial_columns()}
        assert row.keys() <= declared.keys()
        assert not [name for name, text in row.items() if declared[name].invalid_value_reason(text)]
    assert cosim(lab, "run", "one/sim/pass.yaml", "--format", "csv").out.count("\n") == 2, "it runs again"


def test_a_recording_gives_the_same_numbers_again_and_can_be_drawn(lab: Path) -> None:
    ran = cosim(lab, "run", "pass.yaml", "--out", "sim")
    replayed = cosim(lab, "replay", "sim")
    assert replayed.code == 0, replayed.err
    assert event_hash(replayed) == event_hash(ran)
    assert replayed.out.splitlines()[1:4] == ran.out.splitlines()[1:4]
    assert cosim(lab, "plot", "sim", "--out", "run.svg").code == 0
    assert "state/bob" in (lab / "run.svg").read_text(encoding="utf-8")


def test_replay_and_plot_tell_what_is_no_recording(lab: Path) -> None:
    cosim(lab, "run", "pass.yaml", "--seeds", "2", "--duration", "100ms", "--out", "sim")
    for words in (("replay", "sim"), ("plot", "sim")):
        refused = cosim(lab, *words)
        assert (refused.code, "name one of them: sim/seed-1" in refused.err) == (4, True), refused.err
    assert "there is no recording" in cosim(lab, "replay", ".").err
    damaged = next((lab / "sim" / "seed-1" / "packets").iterdir())
    damaged.write_bytes(damaged.read_bytes()[:-1])
    refused = cosim(lab, "replay", "sim/seed-1")
    assert (refused.code, "was changed after the run" in refused.err) == (4, True), refused.err
    assert "use the suffix .svg, .pdf, .png" in cosim(lab, "plot", "sim/seed-2", "--out", "run.txt").err
    manifest = read_manifest(lab / "sim" / "seed-2")
    about = replace(manifest.about, scenario="- of another version")
    write_manifest(lab / "sim" / "seed-2", replace(manifest, about=about, scenario_hash=about.scenario_hash))
    for command in ("replay", "plot"):
        refused = cosim(lab, command, "sim/seed-2")
        assert (refused.code, "its scenario cannot be read" in refused.err) == (4, True), refused.err


@pytest.mark.parametrize(
    ("words", "said", "remedy"),
    [
        (("run", "pas"), "there is no scenario 'pas'", "baylands"),
        (("run", "none.yaml"), "none.yaml: cannot be read: No such file", "ls -l none.yaml"),
        (("run", "pass.yaml", "--policy", "sliding"), "there is no sync policy 'sliding'", "sliding_window"),
        (("run", "pass.yaml", "--seed", "-1"), "'-1' is not a whole number from 0", "--help"),
        (("run", "pass.yaml", "--seeds", "0"), "must be at least 1", "--help"),
        (("run", "pass.yaml", "--seed", "1", "--seeds", "2"), "not allowed with", "--help"),
        (("run", "pass.yaml", "--set", "duration"), "--set: 'duration' is not KEY=VALUE", "--set policy.window=5ms"),
        (("run", "pass.yaml", "--set", "lasts=1s"), "unknown key lasts", "duration"),
        (("run", "pass.yaml", "--window", "5"), "has no unit", "5s or 5ms"),
        (("run", "pass.yaml", "--duration", "0s"), "greater than 0", ""),
        (("run", "pass.yaml", "--window", "0s"), "greater than 0", ""),
        (("run", "pass.yaml", "--out", "taken"), "taken: this folder is not empty", "choose another --out"),
        (("run", "pass.yaml", "--out", "pass.yaml"), "cannot be written: File exists", "choose another --out"),
        (("run", "pass.yaml", "--out", "/proc/sim"), "cannot be written: ", "choose another --out"),
        (("rnu",), "COMMAND cannot be 'rnu'", "did you mean 'run'?"),
        (("run", "pass.yaml", "--polcy", "x"), "has no option or argument '--polcy'", "--policy"),
    ],
)
def test_bad_input_is_told_with_a_remedy(lab: Path, words: tuple[str, ...], said: str, remedy: str) -> None:
    (lab / "taken").mkdir()
    (lab / "taken" / "file").touch()
    refused = cosim(lab, *words)
    assert refused.code == 2, refused.out + refused.err
    assert refused.err.startswith("error: ")
    assert said in refused.err
    assert remedy in refused.err
    assert not refused.out
    assert "Traceback" not in refused.err


def test_ctrl_c_keeps_what_was_recorded(lab: Path) -> None:
    process = start(lab, "cosim", "run", "pass.yaml", "--duration", "10min", "--out", "sim")
    while not list((lab / "sim").glob("windows/*.parquet")):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    done = finish(process)
    assert done.code == 130, done.err
    assert "seed 1: interrupted at" in done.err
    assert "Traceback" not in done.err
    (row,) = rows((lab / "sim" / "trial.csv").read_text(encoding="utf-8"))
    assert (row["status"], row["reason"].partition(" at ")[0]) == ("failed", "interrupted")
    replayed = cosim(lab, "replay", "sim")
    assert "(interrupted)" in replayed.err
    assert event_hash(replayed) == event_hash(done), "what was recorded is what was printed"


def test_ctrl_c_ends_many_seeds_and_keeps_those_that_had_ended(lab: Path) -> None:
    process = start(lab, "cosim", "run", "pass.yaml", "--seeds", "10000", "--out", "sim")
    # Who gets another seed has told of the one before.
    while len(list((lab / "sim").glob("seed-*/trial.csv"))) <= len(os.sched_getaffinity(0)):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    done = finish(process)
    assert done.code == 130, done.err
    assert "Traceback" not in done.err
    ended = sorted(int(path.parent.name.removeprefix("seed-")) for path in (lab / "sim").glob("seed-*/trial.csv"))
    printed = [int(line.split()[0]) for line in done.out.splitlines() if " state/bob " in line]
    assert printed
    # One may have ended after the last that was told.
    assert set(printed) <= set(ended)
    assert f"interrupted: {len(printed)} of 10000 seeds had finished" in done.err
    aggregated = fieldkit(lab, "aggregate", "sim", "--format", "csv")
    assert aggregated.code == 0, aggregated.err


def test_a_policy_that_has_no_window_ends_the_run_and_what_was_before_is_kept(lab: Path) -> None:
    # The publisher stands, and the subscriber comes to 0.9 m/s: 0.5 ms less 0.9 ms.
    raw = ("--policy", "velocity_aware_raw", "--window", "0.5ms", "--set", "physics.step=0.1ms")
    done = cosim(lab, "run", "pass.yaml", *raw, "--out", "sim")
    assert done.code == 2
    assert "w + (Vp - Vs)/1000" in done.err
    replayed = cosim(lab, "replay", "sim", "--format", "csv")
    assert 0 < int(rows(replayed.out)[0]["sent"]) < 100


def test_faults_are_told_with_what_came_back_and_when(lab: Path) -> None:
    path = lab / "pass.yaml"
    path.write_text(path.read_text(encoding="utf-8") + PINGS, encoding="utf-8")
    cut = ("--set", "faults=[{kind: link-cut, between: [ann, bob], from: 200ms, to: 600ms}]")
    done = cosim(lab, "run", "pass.yaml", "--duration", "1s", *cut, "--out", "sim")
    assert done.code == 0, done.err
    found = dict(re.findall(r"^ link-cut +(\S+) +0\.6 +(\d+) +\d", done.out, re.MULTILINE))
    assert found == {"state/bob": "20", "ping/ann": "4", "ping/ann/reply": "0"}
    assert recovery(done.out) == recovery(cosim(lab, "replay", "sim").out)
    told = json.loads(cosim(lab, "replay", "sim", "--format", "json").out)["recoveries"]
    assert [(one["fault"], one["flow"], one["end_s"], one["lost"]) for one in told] == [
        ("link-cut", flow, 0.6, int(lost)) for flow, lost in sorted(found.items())
    ]
    assert all(0 < one["recovered_s"] < 0.2 for one in told)
    pinged = {row["trial"]: row for row in rows((lab / "sim" / "trial.csv").read_text(encoding="utf-8"))}
    row = pinged["sim/ping/ann"]
    assert (row["rtt_sent"], row["rtt_received"], row["rtt_payload_bytes"]) == ("10", "6", "56")
    assert float(row["rtt_loss"]) == pytest.approx(0.4)
    # Both ways take some 0.1 ms; the policy holds nothing, but who answers wakes at a window's end only.
    assert 0 < float(row["rtt_min_s"]) <= float(row["rtt_median_s"]) <= float(row["rtt_max_s"]) < 0.01
    assert not pinged["sim/state/bob"]["rtt_sent"]


def recovery(printed: str) -> str:
    return printed.partition("recovery\n")[2].partition("ended at:")[0]


def test_who_does_not_answer_is_named_and_what_was_before_is_kept(lab: Path) -> None:
    stall = "faults=[{kind: stalled-federate, federate: network, from: 200ms, stall: 1min}]"
    done = cosim(lab, "run", "pass.yaml", "--set", stall, "--deadline", "200ms", "--out", "sim")
    assert done.code == 3
    assert "network has not answered for 0.2 s: asked to advance from 0.19" in done.err
    replayed = cosim(lab, "replay", "sim")
    assert "(failed): UnansweredError: network has not answered" in replayed.err
    assert event_hash(replayed) == event_hash(done)
    assert "--deadline 30s" in cosim(lab, "run", "pass.yaml", "--deadline", "0s").err


def test_a_recording_has_a_capture_per_robot_and_becomes_mcap(lab: Path) -> None:
    cosim(lab, "run", "pass.yaml", "--duration", "200ms", "--out", "sim")
    assert [path.name for path in sorted((lab / "sim" / "captures").iterdir())] == ["ann.pcap", "bob.pcap"]
    done = cosim(lab, "replay", "sim", "--mcap", "sim.mcap")
    assert done.code == 0, done.err
    assert "written: sim.mcap" in done.err
    with (lab / "sim.mcap").open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert topics == {"/tf", "/states/ann", "/states/bob", "/packets/state/bob"}
    refused = cosim(lab, "replay", "sim", "--mcap", "none/sim.mcap")
    assert (refused.code, "choose another --mcap" in refused.err) == (2, True), refused.err


def test_equal_seeds_give_equal_hashes_whatever_the_load(lab: Path) -> None:
    """Once alone, and once while another process takes what it can get of each processor."""
    alone = cosim(lab, "run", "pass.yaml", "--seed", "7")
    with ExitStack() as busy:
        for _ in os.sched_getaffinity(0):
            process = busy.enter_context(subprocess.Popen((sys.executable, "-c", "while True: pass")))
            busy.callback(process.kill)
        beside = cosim(lab, "run", "pass.yaml", "--seed", "7")
    assert (alone.code, beside.code) == (0, 0), alone.err + beside.err
    assert event_hash(alone) == event_hash(beside)
    assert event_hash(alone) != event_hash(cosim(lab, "run", "pass.yaml", "--seed", "8"))


def test_fieldkit_reads_simulations_beside_trials(lab: Path) -> None:
    """Robots 30 ft apart, as in the stored trial that they are compared with."""
    options = ("--set", "agents.bob.along=9.144m", "--duration", "500ms", "--seeds", "2")
    for policy in ("sliding_window", "scheduled"):
        assert cosim(lab, "run", "pass.yaml", *options, "--policy", policy, "--out", policy).code == 0
    (cell,) = [one for one in rows(here(lab, "aggregate", "scheduled", "--format", "csv").out) if of_loss(one)]
    assert (cell["n_valid"], cell["backend"], cell["distance_m"]) == ("2", "cosim", "9.144")
    assert cell["procedure"] == "pass state/bob (scheduled 10 ms)"
    both = here(lab, "compare", "scheduled", "sliding_window", "--format", "csv")
    assert [one["n_b"] for one in rows(both.out) if of_loss(one)] == ["2"], both.err
    trial = here(
        lab, "compare", str(TRIAL), "scheduled", "--by", "scenario,distance_m,protocol", "--force", "--format", "csv"
    )
    assert [one["n_b"] for one in rows(trial.out) if of_loss(one)] == ["2"], trial.err
    page = here(lab, "report", "scheduled", str(TRIAL), "-o", "page.html")
    assert page.code == 0, page.err
    assert "pass state/bob (scheduled 10 ms)" in (lab / "page.html").read_text(encoding="utf-8")
    for form in ("csv", "parquet"):
        assert here(lab, "export", "scheduled", "--format", form, "-o", f"all.{form}").code == 0
    assert len(rows((lab / "all.csv").read_text(encoding="utf-8"))) == 2
    refused = here(lab, "export", "scheduled/seed-1", "--format", "mcap", "-o", "one.mcap")
    assert refused.code == 2, "a simulation has no time line of a trial"
    assert "Traceback" not in refused.err


def of_loss(row: dict[str, str]) -> bool:
    return row["quantity"] == "datagram_loss"


def test_a_reader_that_goes_away_ends_it_in_silence(lab: Path) -> None:
    command = f"set -o pipefail; '{sys.executable}' -m fieldkit cosim run pass.yaml --window 11ms | true"
    done = subprocess.run(
        ("bash", "-c", command), cwd=lab, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_without_a_terminal_nothing_is_coloured_and_nothing_redraws(lab: Path) -> None:
    done = cosim(lab, "run", "pass.yaml", "--window", "11ms")
    assert "\x1b" not in done.out
    assert not done.err
