"""The command `fieldkit aggregate`."""

import csv
import io
import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from fieldkit.analysis import result_tables
from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.cli import main
from fieldkit.core.columns import Kind
from fieldkit.core.model import Interval
from fieldkit.trial.plan import PLAN_FILE
from tests.helpers.paths import DATA
from tests.helpers.single import additional_repeats
from tests.helpers.stored_trials import TRIALS
from tests.helpers.tables import ROW, RepeatRow, parsed, repeats, replace, write

LOSSY = next(TRIALS.glob("20261122T013134*"))
SCHEMA_1_TABLE = DATA / "fieldkit" / "1" / "trial.csv"


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """Return a folder with eight trials: two distances, with and without a wall, in both topologies."""
    for distance, metres in (("30ft", 9.144), ("5m", 5.0)):
        for scenario in ("los", "nlos"):
            for topology in ("master", "masterless"):
                name = f"{distance}_{scenario}_{topology}"
                row = replace(ROW, trial=name, distance=distance, distance_m=metres, topology=topology)
                row = replace(row, procedure=scenario, scenario=scenario)
                tcp = replace(row, protocol="tcp", ip_loss=None, tcp_byte_loss=0.001)
                rows = [*repeats(row, 4), replace(row, repeat=5, status="void"), *tcp_repeats(tcp, 4)]
                write(tmp_path / name, rows)
    return tmp_path


def tcp_repeats(row: RepeatRow, count: int) -> list[RepeatRow]:
    return [replace(repeat, ip_loss=None) for repeat in repeats(row, count)]


def output_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["aggregate", *arguments]) == 0
    return capsys.readouterr().out


def records(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_expectations_of_trials_under_one_condition_are_judged_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, expect in enumerate(("rtt_median_s > 1 us, tcp rtt_loss < 2 %", "rtt_median_s > 1 us, no_such < 1")):
        folder = tmp_path / f"{number}" / LOSSY.name
        shutil.copytree(LOSSY, folder)
        plan = (folder / PLAN_FILE).read_text(encoding="utf-8")
        (folder / PLAN_FILE).write_text(plan.replace("  steps:\n", f"  expect: [{expect}]\n  steps:\n", 1))
        table = (folder / "trial.csv").read_text(encoding="utf-8")
        (folder / "trial.csv").write_text(table.replace(LOSSY.name, f"trial {number}"), encoding="utf-8")
    assert main(["aggregate", str(tmp_path), "--quantity", "rtt_median_s", "--quantity", "rtt_loss"]) == 0
    output = capsys.readouterr()
    _, _, judgements = output.out.partition(" expected ")
    assert [re.split("  +", line)[:2] for line in judgements.splitlines()[2:]] == [
        [" rtt_median_s > 1 us", "tcp"], [" rtt_median_s > 1 us", "udp"], [" tcp rtt_loss < 2 %", "tcp"],
    ]  # fmt: skip
    assert output.out.count("  holds\n") == 2
    assert "1: an expectation is omitted: the expected figure 'no_such' does not exist" in output.err.replace(
        f"/{LOSSY.name}", ""
    )
    assert "expected" not in output_of(capsys, str(tmp_path), "--quantity", "datagram_loss")
    assert "expected" not in output_of(capsys, str(tmp_path), "--format", "csv")


@pytest.mark.parametrize("form", ["table", "csv", "json", "markdown", "latex"])
def test_quantity_missing_in_some_repeats_has_its_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str
) -> None:
    rows = repeats(ROW, 10)
    write(tmp_path, [*rows[:7], *(replace(row, rtt_median_s=None) for row in rows[7:])])
    output = output_of(capsys, str(tmp_path), "--format", form, "--quantity", "rtt_median_s")
    if form == "csv":
        (record,) = records(output)
        assert (record["n"], record["n_valid"]) == ("7", "10")
    elif form == "json":
        (cell,) = json.loads(output)["cells"]
        assert (cell["estimates"]["rtt_median_s"]["n"], cell["n_valid"]) == (7, 10)
    else:
        assert "7 of 10" in output


def test_different_procedures_with_the_same_name_cause_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    identity = {"profiles_sha256": "aaaa", "code_sha256": "cccc"}
    for name, procedure in (("one", "bbbb"), ("two", "dddd")):  # as after --record 1s and --record 15s
        write(tmp_path / name, repeats(replace(ROW, trial=name, procedure_sha256=procedure, **identity), 3))
    assert main(["aggregate", str(tmp_path), "--quantity", "ip_loss"]) == 0
    assert capsys.readouterr().err == "note: A procedure differs between its trials\n"
    assert main(["aggregate", str(tmp_path / "one"), "--quantity", "ip_loss"]) == 0
    assert capsys.readouterr().err == ""


def test_different_ping_sizes_in_one_condition_cause_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    udp = replace(ROW, rtt_payload_bytes=8192)
    table = str(
        write(tmp_path, [*repeats(udp, 3), *tcp_repeats(replace(udp, protocol="tcp", rtt_payload_bytes=502), 3)])
    )
    assert main(["aggregate", table, "--quantity", "rtt_median_s", "--by", "distance"]) == 0
    assert capsys.readouterr().err.startswith("note: A condition has echo requests of different sizes")
    assert main(["aggregate", table, "--quantity", "rtt_median_s"]) == 0
    assert capsys.readouterr().err == ""


def test_csv_equals_the_summary_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [*tcp_repeats(replace(ROW, protocol="tcp"), 3), *repeats(ROW, 3)]
    write(tmp_path / "one", rows)
    assert output_of(capsys, str(tmp_path), "--format", "csv") == result_tables.to_csv(
        DEFAULT_BY, aggregate(parsed(rows))
    )


def test_json_and_csv_agree(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = records(output_of(capsys, str(campaign), "--format", "csv"))
    document = json.loads(output_of(capsys, str(campaign), "--format", "json"))
    assert document["by"] == list(DEFAULT_BY)
    estimates = [(cell, name, estimate) for cell in document["cells"] for name, estimate in cell["estimates"].items()]
    assert len(estimates) == len(lines)
    for line, (cell, name, estimate) in zip(lines, estimates, strict=True):
        assert (line["quantity"], line["n_void"]) == (name, str(cell["n_void"]))
        for column in ("value", "low", "wilson_high", "p95", "events"):
            assert (float(line[column]) if line[column] else None) == estimate[column]


def test_cells_are_grouped_by_the_given_columns(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("--by", "distance, scenario", "--quantity", "ip_loss", "--format", "csv")
    lines = records(output_of(capsys, str(campaign), *arguments))
    keys = [(line["distance"], line["scenario"], line["n"], line["n_void"]) for line in lines]
    assert keys == [(distance, scenario, "8", "2") for distance in ("5m", "30ft") for scenario in ("los", "nlos")]
    assert {line["quantity"] for line in lines} == {"ip_loss"}


def test_table_shows_common_values_in_the_title_and_differences_in_columns(
    campaign: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = output_of(capsys, str(campaign), "--by", "distance,backend,protocol", "--quantity", "ip_loss")
    assert re.search(r"^repeats, field\n *distance +protocol +valid +void +failed$", text, re.MULTILINE)
    assert re.search(r"^ *5m +udp +16 +4 +0$", text, re.MULTILINE)
    assert re.search(
        r"^IP packet loss \(%\), udp\n *distance +n +sent +share +95 % interval +Wilson +median +p95$",
        text,
        re.MULTILINE,
    )
    assert re.search(
        r"^ *30ft +16 +3456 +5.32 +\[\d\.\d\d, \d\.\d\d\] +\[\d\.\d\d, \d\.\d\d\] +5.32 +6.02$", text, re.MULTILINE
    )
    assert max(map(len, text.splitlines())) <= 80


def test_width_gives_the_number_of_repeats_needed(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (str(campaign), "--by", "protocol", "--width", "1%", "--width", "5 ms")
    lines = records(output_of(capsys, *arguments, "--format", "csv"))
    for line in lines:
        interval = Interval(*(float(line[name]) for name in ("value", "low", "high")))
        width = 0.01 if line["unit"] == "share" else 0.005
        assert line["more_wanted"] == str(additional_repeats(interval, int(line["n"]), width, Kind(line["estimate"])))
    assert {line["more_wanted"] == "0" for line in lines} == {True, False}
    document = json.loads(output_of(capsys, *arguments, "--format", "json"))
    counts = [estimate["more_wanted"] for cell in document["cells"] for estimate in cell["estimates"].values()]
    assert [str(count) for count in counts] == [line["more_wanted"] for line in lines]
    (loss,) = (line for line in lines if line["quantity"] == "ip_loss")
    assert re.search(
        rf"\bmore\n.*\n *\d+ .* {loss['more_wanted']}\n", output_of(capsys, *arguments, "--quantity", "ip_loss")
    )


def test_trials_of_schema_1_are_aggregated_with_new_trials(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new_table = write(tmp_path, repeats(ROW, 3))
    lines = records(output_of(capsys, str(SCHEMA_1_TABLE), str(new_table), "--by", "protocol", "--format", "csv"))
    (loss,) = (line for line in lines if (line["protocol"], line["quantity"]) == ("udp", "ip_loss"))
    n_lost, n_sent = 1 + 2 + 2 + 10 + 11 + 12, 3 * 16 + 3 * 216
    assert (loss["n"], loss["events"], loss["trials"]) == ("6", str(n_lost), str(n_sent))


def markdown(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip("|"))] for line in lines]


def test_markdown_table_has_equal_columns_in_all_lines(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = output_of(
        capsys, str(campaign), "--format", "markdown", "--quantity", "ip_loss", "--quantity", "rtt_median_s"
    )
    header, separator, *body = markdown(text)
    assert text.startswith("backend field; each value with its 95 % interval.\n\n| ")
    assert header == [
        "scenario",
        "topology",
        "distance",
        "protocol",
        "repeats",
        "IP packet loss (%)",
        "RTT, median (ms)",
    ]
    assert separator == ["---"] * 5 + ["---:"] * 2
    assert len(body) == 16
    assert {len(line) for line in body} == {7}
    assert body[1][:5] == ["los", "master", "5m", "udp", "4 valid, 1 void"]


def latex(text: str) -> tuple[str, list[list[str]]]:
    """Return the column specification of a tabular, and its lines as cells, with spanning cells repeated."""
    match = re.search(r"\\begin\{tabular\}\{(\w+)\}\n(.*)\\end\{tabular\}", text, re.DOTALL)
    assert match
    lines = [line.removesuffix(r" \\") for line in match[2].splitlines() if line.endswith(r" \\")]
    return match[1], [
        [part for cell in re.split(r"(?<!\\) & ", line) for part in spanned_cells(cell)] for line in lines
    ]


def spanned_cells(cell: str) -> Sequence[str]:
    match = re.fullmatch(r"\\multicolumn\{(\d+)\}\{c\}\{(.*)\}", cell)
    return [match[2]] * int(match[1]) if match else [cell]


def test_latex_has_rows_of_distances_and_columns_of_scenarios(
    campaign: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    by = "procedure,distance,distance_m,scenario,protocol,backend"
    text = output_of(capsys, str(campaign), "--format", "latex", "--by", by)
    columns, lines = latex(text)
    assert {len(line) for line in lines} == {len(columns)}
    quantities = ["RTT, median (ms)"] * 2 + [r"IP packet loss (\%)", r"TCP byte loss before retransmission (\%)"]
    assert lines[:3] == [
        ["", *["LOS"] * 4, *["NLOS"] * 4],
        ["", *quantities * 2],
        ["distance", *["TCP", "UDP", "UDP", "TCP"] * 2],
    ]
    assert [line[0] for line in lines[3:]] == ["5m", "30ft"]
    assert all(re.fullmatch(r"[\d.]+ \[[\d.]+, [\d.]+\]", figure) for line in lines[3:] for figure in line[1:])
    ruled_columns = re.findall(r"\\cmidrule\(lr\)\{(\d)-(\d)\}", text)
    assert ["".join(column_range) for column_range in ruled_columns] == [
        "25",
        "69",
        "23",
        "44",
        "55",
        "67",
        "88",
        "99",
    ]
    assert text.count("{") == text.count("}")
    assert text.count(r"\begin{") == text.count(r"\end{") == 2
    assert r"\caption{backend field, 8 valid repeats each; in brackets 95 \% intervals.}" in text


def test_latex_escapes_special_characters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [replace(ROW, distance=name, repeat=1 + n) for n, name in enumerate(("5m & 50% #1", r"a_b\c{d}$~^"))]
    columns, lines = latex(output_of(capsys, str(write(tmp_path, rows)), "--format", "latex"))
    assert {len(line) for line in lines} == {len(columns)}
    assert [line[0] for line in lines[3:]] == [
        r"5m \& 50\% \#1",
        r"a\_b\textbackslash{}c\{d\}\$\textasciitilde{}\textasciicircum{}",
    ]


def test_quantities_without_values_are_omitted_but_counts_remain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failed_trial = str(write(tmp_path, [replace(ROW, status="failed")]))
    assert re.search(r"^ *0 +0 +1$", output_of(capsys, failed_trial), re.MULTILINE)
    assert "| 1 failed |" in output_of(capsys, failed_trial, "--format", "markdown")
    assert json.loads(output_of(capsys, failed_trial, "--format", "json"))["cells"][0]["n_failed"] == 1
    assert main(["aggregate", failed_trial, "--format", "latex"]) == 4
    assert "no valid repeat has a value of rtt_median_s" in capsys.readouterr().err
    assert main(["aggregate", failed_trial, "--quantity", "jitter_s", "--format", "csv"]) == 0
    assert "note: no valid repeat has jitter_s" in capsys.readouterr().err
