"""`fieldkit cosim run` as a user types it: what it prints and keeps, bad inputs, Ctrl-C, pipes."""

import csv
import io
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.core.columns import Column
from fieldkit.trial.columns import trial_columns
from tests.helpers.runs import Run, fieldkit, finish, start

LIMIT_S = 60.0
SCENARIO = """\
name: pass
summary: one robot goes by another
world: baylands
duration: 2s
policy: {name: sliding_window, window: 10ms}
agents:
  ann: {along: 0m}
  bob: {along: 10m, motion: {kind: way-points, points_m: [[0, 5]], relative: true, speed: 1m/s}}
traffic:
  - {kind: stream, name: state, from: ann, to: bob, rate: 50Hz, size_bytes: 320}
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "pass.yaml").write_text(SCENARIO, encoding="utf-8")
    return tmp_path


def cosim(lab: Path, *words: str) -> Run:
    return fieldkit(lab, "cosim", *words)


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
    (same,) = json.loads(cosim(lab, "run", "pass.yaml", "--format", "json").out)
    assert (row["flow"], row["sent"]) == (same["flow"], str(same["sent"])) == ("state/bob", "100")
    assert cosim(lab, "run", "pass.yaml", "--format", "markdown").out.startswith("| ")


def test_options_change_the_scenario(lab: Path) -> None:
    def sent(*options: str) -> int:
        return int(rows(cosim(lab, "run", "pass.yaml", "--format", "csv", *options).out)[0]["sent"])

    assert sent("--duration", "1s") == 50
    assert sent("--set", "duration=500ms") == 25
    assert event_hash(cosim(lab, "run", "pass.yaml", "--seed", "1")) == event_hash(cosim(lab, "run", "pass.yaml"))


def test_a_folder_has_a_repeat_for_each_seed_and_equal_runs_are_equal(lab: Path) -> None:
    for name in ("one", "two"):
        done = cosim(lab, "run", "pass.yaml", "--seeds", "3", "--out", f"{name}/sim")
        assert done.code == 0, done.err
    table = (lab / "one" / "sim" / "trial.csv").read_text(encoding="utf-8")
    assert table == (lab / "two" / "sim" / "trial.csv").read_text(encoding="utf-8")
    found = rows(table)
    assert [(row["repeat"], row["seed"], row["status"]) for row in found] == [
        (str(n), str(n), "valid") for n in (1, 2, 3)
    ]
    declared: dict[str, Column] = {column.name: column for column in trial_columns()}
    for row in found:
        assert row.keys() <= declared.keys()
        assert not [name for name, text in row.items() if declared[name].problem(text)]
    assert cosim(lab, "run", "one/sim/pass.yaml", "--format", "csv").out.count("\n") == 2, "it runs again"


@pytest.mark.parametrize(
    ("words", "said", "remedy"),
    [
        (("run", "pas"), "there is no scenario 'pas'", "baylands"),
        (("run", "none.yaml"), "none.yaml: cannot be read: No such file", "ls -l none.yaml"),
        (("run", "pass.yaml", "--policy", "sliding"), "there is no sync policy 'sliding'", "sliding_window"),
        (("run", "pass.yaml", "--seed", "-1"), "'-1' is no whole number", "--help"),
        (("run", "pass.yaml", "--seeds", "0"), "must be at least 1", "--help"),
        (("run", "pass.yaml", "--seed", "1", "--seeds", "2"), "not allowed with", "--help"),
        (("run", "pass.yaml", "--set", "duration"), "--set: 'duration' does not say", "--set policy.window=5ms"),
        (("run", "pass.yaml", "--set", "lasts=1s"), "unknown key lasts", "duration"),
        (("run", "pass.yaml", "--window", "5"), "has no unit", "5s or 5ms"),
        (("run", "pass.yaml", "--duration", "0s"), "greater than 0", ""),
        (("run", "pass.yaml", "--window", "0s"), "greater than 0", ""),
        (("run", "pass.yaml", "--out", "taken"), "taken: something is in this folder", "choose another --out"),
        (("run", "pass.yaml", "--out", "pass.yaml"), "cannot be written: File exists", "choose another --out"),
        (("run", "pass.yaml", "--out", "/proc/sim"), "cannot be written: ", "choose another --out"),
        (("rnu",), "COMMAND cannot be 'rnu'", "did you mean 'run'?"),
        (("run", "pass.yaml", "--polcy", "x"), "does not take '--polcy'", "--policy"),
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


def test_ctrl_c_keeps_what_had_ended(lab: Path) -> None:
    process = start(lab, "cosim", "run", "pass.yaml", "--seeds", "100000", "--out", "sim")
    table = lab / "sim" / "trial.csv"
    while not table.exists():
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    done = finish(process)
    assert done.code == 130, done.err
    found = rows(table.read_text(encoding="utf-8"))
    assert {row["status"] for row in found[:-1]} <= {"valid"}
    assert "state/bob" in done.out, "what had ended is printed"
    assert "Traceback" not in done.err


def test_a_reader_that_goes_away_ends_it_in_silence(lab: Path) -> None:
    command = f"set -o pipefail; {sys.executable} -m fieldkit cosim run pass.yaml --seeds 100 | head -n 2"
    done = subprocess.run(
        ("bash", "-c", command), cwd=lab, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) == 2


def test_without_a_terminal_nothing_is_coloured_and_nothing_redraws(lab: Path) -> None:
    done = cosim(lab, "run", "pass.yaml")
    assert "\x1b" not in done.out
    assert not done.err
