"""Three procedures that users can write from the documentation; every table has their values, labels and units.

The first has two transfers of different sizes in opposite directions while two other robots are busy. The second
runs a vendor's tool with JSON output on a robot without ROS. The third is a range walk that records the operator's
observations.
"""

import csv
import html
import io
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.helpers.labs import BOX, write_procedure
from tests.helpers.runs import rows, run_here
from tests.helpers.texts import site

pytestmark = pytest.mark.emulated

HEAD = "name: NAME\nsummary: Of a lab\nscenario: los\ntopology: masterless\nprotocols: [tcp]\nrepeats: 2\n"
SITE = """\
backend: emulated
robots:
  box-1: {profile: box}
  box-2: {profile: box}
  box-3: {profile: box}
  box-4: {profile: box}
roles:
  masterless: {sender: box-1, receiver: box-2, talker: box-3, hearer: box-4}
emulated: {late_bound: 2s}
"""
TWO_ROBOTS = site({"box-1": "box", "box-2": "box"}, emulated="late_bound: 2s")

PROCEDURES = {
    "asymmetric": """\
expect:
  - up.file_loss < 90 %
  - down.transfer_s > 60min
  - tcp up.goodput_bit_s > 1 bit/s
places:
  talker: {near: sender, left: 4m}
  hearer: {near: receiver, left: 4m}
steps:
  - soak:
      from: talker
      to: hearer
      protocol: udp
      rate: 2Mbit/s
      during:
        - capture:
            during:
              - together:
                  during:
                    - send: {name: up, from: sender, to: receiver, size: 5MB}
                    - send: {name: down, from: receiver, to: sender, size: 1MB, port: 1235}
""",
    "vendor": """\
steps:
  - run:
      robot: sender
      command: ip -json -details link show dev wlan0
      columns:
        - {name: queue, unit: packets, json: "[0].txqlen", label: queue of the radio}
        - {name: up, unit: bool, json: "contains([0].flags, 'UP')", label: radio up}
        - {name: driver, unit: text, json: "[0].linkinfo.info_kind"}
  - run:
      {name: probe, robot: receiver, put: tools/probe.sh, output: printed.txt,
      command: "{put} {distance} 'no {repeat}' {{repeat}} ${distance}",
      columns: [{name: words, unit: text, regex: "words=(.*)"}, {name: copies, unit: count, regex: "copies=(.*)"}]}
""",
    "walk": """\
steps:
  - ask: {column: grass, question: how is the grass, choices: [dry, wet], usual: dry}
  - ask: {column: wind, question: how strong is the wind, unit: m/s, least: 0, most: 40, each: repeat}
  - ask: {column: people, question: how many people are near, least: 0, each: repeat}
  - capture:
      during:
        - send: {from: sender, to: receiver, size: 100kB}
  - ping: {from: sender, to: receiver, count: 5, interval: 100ms}
""",
}
PROBE = """\
#!/bin/sh
printf 'words='
printf '<%s>' "$@"
printf '\\ncopies=%s\\n' "$(find ../.. -name probe.sh | wc -l)"
"""
"""A program that a lab copies to a robot; it prints its arguments and the number of its copies on the robot."""
DISTANCES = {"asymmetric": ["10m"], "vendor": ["10m", "20m"], "walk": ["5m", "15m"]}
ANSWERS = "wet\n3.5\n2\n4\n0\ndry\n1\n-\n2 m/s\n1\n"


@dataclass(frozen=True)
class LabResults:
    """The trials and outputs of a lab.

    Attributes:
        trials: The trials, nearest first.
        outputs: Outputs of commands by name: `trial`, `aggregate` as CSV, `compare` of the first trial with the last,
            and `table` and `all` of `aggregate`.
        page: The text of the report.
    """

    trials: tuple[Path, ...]
    outputs: Mapping[str, str]
    page: str

    def rows(self) -> list[dict[str, str]]:
        """Return all repeats."""
        return [row for trial in self.trials for row in rows(trial)]


def run_trial(folder: Path, name: str) -> str:
    """Run a trial in a new lab; return its output."""
    (folder / "robots").mkdir(parents=True)
    (folder / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    (folder / "fieldkit.yaml").write_text(SITE if "talker" in PROCEDURES[name] else TWO_ROBOTS, encoding="utf-8")
    (folder / "answers.txt").write_text(ANSWERS, encoding="utf-8")
    (folder / "tools").mkdir()
    (folder / "tools" / "probe.sh").write_text(PROBE, encoding="utf-8")
    (folder / "tools" / "probe.sh").chmod(0o755)
    write_procedure(folder, HEAD.replace("NAME", name) + PROCEDURES[name])

    run = run_here(folder, "trial", name, *DISTANCES[name], "--answers", "answers.txt")
    assert run.code == (1 if "expect:" in PROCEDURES[name] else 0), run.err + run.out
    return run.out


def analyse(folder: Path, trial_output: str) -> LabResults:
    def run_command(*words: str) -> str:
        run = run_here(folder, *words)
        assert run.code == 0, run.err + run.out
        return run.out

    outputs = {"trial": trial_output}
    trials = tuple(sorted((folder / "trials").iterdir()))
    ends = (str(trials[0]), str(trials[-1]))
    outputs["aggregate"] = run_command("aggregate", "trials", "--format", "csv")
    outputs["compare"] = run_command("compare", *ends, "--by", "protocol")
    outputs["table"] = run_command("aggregate", "trials")
    outputs["all"] = run_command("aggregate", "trials", "--all")
    run_command("report", "trials")
    run_command("export", ends[0], "--format", "mcap", "-o", "time.mcap")
    page = (folder / "report.html").read_text(encoding="utf-8")
    words = html.unescape(re.sub(r"<style.*?</style>|<[^>]+>", " ", page, flags=re.DOTALL)).split()
    return LabResults(trials, outputs, " ".join(words))


@pytest.fixture(scope="module")
def lab_results(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, LabResults]:
    base = tmp_path_factory.mktemp("strangers")
    return {name: analyse(base / name, run_trial(base / name, name)) for name in PROCEDURES}


def test_each_procedure_has_about_ten_lines_of_steps() -> None:
    assert all(len(text.partition("steps:\n")[2].splitlines()) <= 12 for text in PROCEDURES.values())


def test_both_transfers_are_measured_separately(lab_results: Mapping[str, LabResults]) -> None:
    for row in lab_results["asymmetric"].rows():
        assert (row["status"], row["others"]) == ("valid", "hearer=box-4 talker=box-3")
        assert (row["up.sent_bytes"], row["down.sent_bytes"]) == ("5000000", "1000000")
        assert (row["up.hash_match"], row["down.hash_match"]) == ("true", "true")
        for name, size_bytes in (("up", 5e6), ("down", 1e6)):
            completion_s = float(row[f"{name}.completion_s"])
            assert float(row[f"{name}.goodput_bit_s"]) == pytest.approx(8 * size_bytes / completion_s, rel=0.001)
            # The receiving program closes the connection some time after the last frame.
            assert completion_s == pytest.approx(float(row[f"{name}.transfer_s"]), abs=0.25)
        # The load uses the same channel, so the sum is more than 2 Mbit/s of 65 Mbit/s, without preambles.
        assert float(row["sender_busy_share"]) > 0.1


def test_the_output_of_a_vendors_tool_fills_columns(lab_results: Mapping[str, LabResults]) -> None:
    results = lab_results["vendor"]
    outputs = [path for trial in results.trials for path in sorted(trial.glob("repeats/*/run.txt"))]
    for row, output in zip(results.rows(), outputs, strict=True):
        (link,) = json.loads(output.read_text(encoding="utf-8"))
        assert (row["queue"], row["up"], row["driver"]) == (str(link["txqlen"]), "true", "tun")


def test_a_program_of_the_lab_gets_the_distance_and_the_repeat(lab_results: Mapping[str, LabResults]) -> None:
    results = lab_results["vendor"]
    values = [(row["probe.words"], row["probe.copies"]) for row in results.rows()]
    expected = [f"<{at}><no {number}><{{repeat}}><${{distance}}>" for at in ("10m", "20m") for number in (1, 2)]
    assert values == [(words, "1") for words in expected], "the copy is deleted after each attempt"
    assert not [path for trial in results.trials for path in trial.rglob("probe.sh")]


def test_the_answers_of_the_operator_are_stored(lab_results: Mapping[str, LabResults]) -> None:
    outputs = [(row["distance"], row["grass"], row["wind"], row["people"]) for row in lab_results["walk"].rows()]
    assert outputs == [
        ("5m", "wet", "3.5", "2"),
        ("5m", "wet", "4", "0"),
        ("15m", "dry", "1", ""),
        ("15m", "dry", "2", "1"),
    ]


LABELS = {
    "asymmetric": {
        "up.transfer_s": ("s", "up: transfer time", "", "ms"),
        "down.transfer_s": ("s", "down: transfer time", "down: transfer time", "ms"),
        "up.goodput_bit_s": ("bit/s", "up: goodput", "up: goodput", "Mbit/s"),
        "down.tcp_byte_loss": ("share", "down: TCP byte loss before retransmission", "down: radio loss", "%"),
    },
    "vendor": {
        "queue": ("packets", "queue of the radio", "queue of the radio", "packets"),
        "up": ("share", "radio up", "radio up", "%"),
    },
    "walk": {
        "wind": ("m/s", "wind", "wind", "m/s"),
        "people": ("number", "people", "people", ""),
        "rtt_median_s": ("s", "RTT", "RTT, 502-byte ping", "ms"),
    },
}
"""By column: unit in files, label, label in the trial's table (empty if only --all shows it), and unit in tables."""


@pytest.mark.parametrize("name", PROCEDURES)
def test_the_aggregate_contains_all_values(lab_results: Mapping[str, LabResults], name: str) -> None:
    results = lab_results[name]
    cells = list(csv.DictReader(io.StringIO(results.outputs["aggregate"])))
    expected = {quantity: unit for quantity, (unit, *_) in LABELS[name].items()}
    assert {cell["quantity"]: cell["unit"] for cell in cells}.items() >= expected.items()
    for cell in cells:
        column, _, _ = cell["quantity"].partition("=")  # a text column has a line per value
        values = [row[column] for row in results.rows() if row["distance"] == cell["distance"]]
        assert int(cell["n"]) == sum(value != "" for value in values), cell


@pytest.mark.parametrize("name", PROCEDURES)
def test_tables_have_labels_and_units(lab_results: Mapping[str, LabResults], name: str) -> None:
    results = lab_results[name]
    for _, label, trial_label, unit in LABELS[name].values():
        for table, row in (("trial", trial_label), ("compare", label)):
            lines = [
                line
                for line in results.outputs[table].splitlines()
                if re.match(rf" {row or label}(, median)?  ", line)
            ]
            assert bool(lines) is bool(row), (table, label)
            assert all(unit in line for line in lines)
        title = rf"^{trial_label if label == 'RTT' else label}{re.escape(f' ({unit})') if unit else ''}$"
        assert re.search(title, results.outputs["all"], re.MULTILINE), title
        # The report has a table for each named step.
        assert re.search(rf"{label.rpartition(': ')[2]}\b.*? [0-9.]+ ?{unit}", results.page)


def test_text_answers_are_counted_in_all_outputs(lab_results: Mapping[str, LabResults]) -> None:
    results = lab_results["walk"]
    cells = {
        (cell["distance"], cell["quantity"]): cell
        for cell in csv.DictReader(io.StringIO(results.outputs["aggregate"]))
    }
    assert [cells[key]["events"] for key in (("5m", "grass=wet"), ("15m", "grass=dry"))] == ["2", "2"]
    assert re.search(r"^ grass +wet 2$", results.outputs["trial"], re.MULTILINE)
    assert re.search(r"^ 15m +2  dry 2$", results.outputs["table"].partition("\ngrass\n")[2], re.MULTILINE)
    assert re.search(
        r"^ grass +wet 2 +dry 2 +words are counted, not judged$", results.outputs["compare"], re.MULTILINE
    )
    assert re.search(
        r"TCP, expected and lab-defined figures condition repeats wind, median people, median grass 5m 2 valid "
        r"3\.75 m/s \[[^]]+\]\* 1\.00 \[[^]]+\]\* wet 2 15m 2 valid 1\.50 m/s \[[^]]+\]\* 1\.00 \(1 of 2\) dry 2 ",
        results.page,
    )


def test_expectations_and_verdicts_are_in_the_report(lab_results: Mapping[str, LabResults]) -> None:
    page = lab_results["asymmetric"].page
    assert "Expectations 2 of 3 hold." in page
    assert re.search(r"up\.file_loss < 90 % TCP, 10m holds 0\.00 % \[0\.00, [0-9.]+\]", page)
    assert re.search(r"down\.transfer_s > 60min TCP, 10m does not hold [0-9.]+ m?s \[", page)
    assert "Expectations" not in lab_results["walk"].page


def test_each_transfer_has_a_separate_timeline(lab_results: Mapping[str, LabResults]) -> None:
    results = lab_results["asymmetric"]
    folder = results.trials[0].parents[1]
    page = (folder / "report.html").read_text(encoding="utf-8")
    spans = re.findall(r"((?:send|receive) \w+) from ([0-9.]+) to ([0-9.]+) s", page)
    # The lanes are in the order of their start, which is random for two that run at the same time.
    assert sorted(lane for lane, _, _ in spans) == ["receive down", "receive up", "send down", "send up"]
    assert all(float(start_s) < float(stop_s) for _, start_s, stop_s in spans)
    assert [float(start_s) for _, start_s, _ in spans] == sorted(float(start_s) for _, start_s, _ in spans)
    assert "up, TCP, masterless Marked: segments retransmitted" in results.page
    assert "down, TCP, masterless Marked: segments retransmitted" in results.page
    values: dict[str, list[str]] = {}
    with (folder / "time.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            values.setdefault(channel.topic, []).append(json.loads(message.data).get("phase", ""))
    assert {topic: set(phases) for topic, phases in values.items() if "/phase" in topic} == {
        f"/{role}/phase/{name}": {"transfer", "idle"} for role in ("sender", "receiver") for name in ("up", "down")
    }
