"""Command output for trials of different procedures, with columns that are not declared by fieldkit."""

import csv
import io
import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import pyarrow.parquet
import pytest

from fieldkit.cli import main
from fieldkit.core.columns import Column, Figure, Kind, plain_name
from tests.helpers import vendor_trials

DISTANCES = {"10ft": 3.048, "30ft": 9.144}


REPORTED_COLUMNS = {
    "ip_loss",
    "ip_packets_sent",
    "ip_packets_received",
    "jitter_s",
    "rtt_payload_bytes",
    "rtt_median_s",
}
"""Columns of the named steps in the trials for reports. A report draws a panel for each quantity of each step."""


def write_trials(folder: Path, named_step_columns: Sequence[Column]) -> Path:
    """Write two trials per distance: with two transfers, two pings and a vendor's meter, and with the meter only."""
    for index, (distance, metres) in enumerate(DISTANCES.items()):
        for name, columns in (
            ("all", (*named_step_columns, *vendor_trials.VENDOR_COLUMNS)),
            ("meter", vendor_trials.VENDOR_COLUMNS),
        ):
            plan = vendor_trials.plan(f"{name}-{distance}", distance=distance, metres=metres, columns=columns)
            vendor_trials.write(folder, plan, vendor_trials.valid_rows(plan, seed=index))
    return folder


@pytest.fixture(scope="module")
def all_trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_trials(tmp_path_factory.mktemp("trials"), vendor_trials.NAMED_STEP_COLUMNS)


@pytest.fixture
def trials(all_trials: Path, tmp_path: Path) -> Path:
    """Return a copy of the trials with all columns of the named steps."""
    return shutil.copytree(all_trials, tmp_path, dirs_exist_ok=True)


def output_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main([*arguments]) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def records(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_aggregate_includes_all_declared_quantities_with_unit_and_interval(
    trials: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = records(output_of(capsys, "aggregate", str(trials), "--by", "distance", "--format", "csv"))
    by_quantity = {(line["distance"], line["quantity"]): line for line in lines}
    level, locked, loss = (by_quantity["30ft", name] for name in ("probe.level", "probe.locked", "up.ip_loss"))
    assert (level["unit"], level["estimate"], level["n"]) == ("dBm", "median", "32")
    assert -60 < float(level["low"]) < float(level["value"]) < float(level["high"]) < -40
    assert (locked["unit"], locked["estimate"]) == ("share", "flag")
    assert (loss["unit"], loss["n"], loss["trials"]) == ("share", "16", str(16 * 40)), (
        "only trials that have the column are counted"
    )
    assert not [name for _, name in by_quantity if name in {"probe.firmware", "wind"}]


def test_conditions_can_be_grouped_by_an_operators_answer(trials: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = output_of(capsys, "aggregate", str(trials), "--by", "wind", "--quantity", "probe.level", "--format", "csv")
    assert {line["wind"] for line in records(text)} == {"calm", "gusts"}
    for table in trials.glob("*/trial.yaml"):
        table.unlink()
    assert output_of(
        capsys, "aggregate", str(trials), "--by", "wind", "--quantity", "up.transfer_s", "--format", "csv"
    )


def test_tables_have_units_and_rounded_values(trials: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quantity_options = [
        word for name in ("probe.level", "probe.resets", "up.ip_loss") for word in ("--quantity", name)
    ]
    arguments = ("aggregate", str(trials), "--by", "distance", *quantity_options)
    table = output_of(capsys, *arguments)
    assert re.search(r"^probe: level \(dBm\)\n.*\n.*\n *10ft +32 +-4\d\.\d\d +\[-", table, re.MULTILINE)
    assert re.search(r"^probe: resets\n", table, re.MULTILINE)
    assert (
        "| distance | repeats | probe: level, median (dBm) | probe: resets | up: IP packet loss (%) |"
        in output_of(capsys, *arguments, "--format", "markdown")
    )
    assert r"probe: level, median (dBm)" in output_of(capsys, *arguments, "--format", "latex")
    document = json.loads(output_of(capsys, *arguments, "--format", "json"))
    assert document["cells"][0]["estimates"]["probe.level"]["unit"] == "dBm"


def test_width_in_any_unit_gives_the_number_of_repeats_needed(
    trials: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("aggregate", str(trials), "--by", "protocol", "--format", "csv", "--quantity", "probe.level")
    for width in ("0.5dBm", "0.5 dB"):
        (tcp, udp) = records(output_of(capsys, *arguments, "--width", width))
        for line in (tcp, udp):
            width_of_interval = float(line["high"]) - float(line["low"])
            assert (int(line["more_wanted"]) > 0) is (width_of_interval > 1)
    assert main([*arguments, "--width", "1V"]) == 2
    assert "units are" in capsys.readouterr().err


def test_two_runs_are_compared_in_any_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, level_dbm in (("a", -40.0), ("b", -46.0)):
        plan = vendor_trials.plan(name, distance="30ft", metres=9.144, columns=vendor_trials.VENDOR_COLUMNS)
        vendor_trials.write(tmp_path, plan, vendor_trials.valid_rows(plan, repeats=20, seed=3, level_dbm=level_dbm))
    arguments = ("compare", str(tmp_path / "a"), str(tmp_path / "b"), "--force")
    text = output_of(capsys, *arguments, "--format", "csv")
    level = next(line for line in records(text) if line["quantity"] == "probe.level")
    assert level["unit"] == "dBm"
    assert float(level["difference"]) == pytest.approx(-6)
    assert level["verdict"].startswith("B 6.00 dB less [")
    assert main([*arguments, "--threshold", "probe.level=1dB"]) == 1
    assert "may exceed 1 dB" in capsys.readouterr().out
    assert main([*arguments, "--threshold", "probe.level=20 dBm", "--threshold", "probe.volt=9V"]) == 0
    capsys.readouterr()
    assert main([*arguments, "--threshold", "probe.level=20m"]) == 2
    assert "'20m' is not a threshold\n  remedy: write for example 15dBm" in capsys.readouterr().err


def test_runs_with_different_definitions_of_a_column_are_not_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other_column = Column("probe.level", "mW", "In another unit.", figure=Figure("level", Kind.MEDIAN))
    for name, column in (("a", vendor_trials.VENDOR_COLUMNS[0]), ("b", other_column)):
        plan = vendor_trials.plan(name, distance="30ft", metres=9.144, columns=[column])
        vendor_trials.write(tmp_path, plan, vendor_trials.valid_rows(plan))
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--force"]) == 2
    assert "probe.level is a different column here (mW, median) than in" in capsys.readouterr().err


def test_exports_have_types_units_and_meanings_of_all_columns(
    trials: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(trials)
    output_of(capsys, "export", ".", "--format", "parquet", "-o", "all.parquet")
    table = pyarrow.parquet.read_table(trials / "all.parquet")
    for column in (*vendor_trials.NAMED_STEP_COLUMNS, *vendor_trials.VENDOR_COLUMNS):
        metadata = table.schema.field(column.name).metadata
        assert (metadata[b"unit"].decode(), metadata[b"meaning"].decode()) == (column.unit, column.meaning)
    assert table.column("probe.level").null_count == 0
    assert table.column("up.transfer_s").null_count == table.num_rows // 2
    output_of(capsys, "export", ".", "--format", "csv", "-o", "all.csv")
    second_output = output_of(
        capsys, "aggregate", "all.csv", "--by", "distance", "--format", "csv", "--quantity", "up.ip_loss"
    )
    assert second_output == output_of(
        capsys, "aggregate", ".", "--by", "distance", "--format", "csv", "--quantity", "up.ip_loss"
    ), "without a plan, the meaning follows from the column name after the step name"


def test_report_draws_all_steps_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = [column for column in vendor_trials.NAMED_STEP_COLUMNS if plain_name(column.name) in REPORTED_COLUMNS]
    trials = write_trials(tmp_path, columns)
    monkeypatch.chdir(trials)
    output_of(capsys, "report", ".", "-o", "page.html", "--quantity", "up.jitter_s")
    page = (trials / "page.html").read_text(encoding="utf-8")
    for title in (
        "IP packet loss against distance, by step",
        "probe: level against distance",
        "Last jitter value (RFC 3550) against distance",
    ):
        assert title in page
    for caption in ("UDP, up", "UDP, down", "UDP, p502", "UDP, probe, further figures"):
        assert f"<caption>{caption}</caption>" in page
    assert '<figure id="ip-loss-of-steps"' in page
    assert "p8192, UDP, master, 8192 bytes" in page
    assert "--quantity up.jitter_s" in page, "the page shows the command that reproduces it"
    assert main(["report", ".", "-o", "page.html", "--quantity", "up.jiter_s"]) == 2
    assert "did you mean 'up.jitter_s'" in capsys.readouterr().err


def test_report_lists_the_quantities_that_it_does_not_draw(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    columns = [Column(f"a.m{n}", "V", "Voltage.", figure=Figure(f"a: m{n}", Kind.MEDIAN)) for n in range(15)]
    for distance, metres in DISTANCES.items():
        plan = vendor_trials.plan(distance, distance=distance, metres=metres, columns=columns)
        vendor_trials.write(tmp_path, plan, vendor_trials.valid_rows(plan, repeats=2))
    output_of(capsys, "report", ".", "-o", "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "a: m11 against distance" in page
    assert "a: m12 against distance" not in page
    assert "Not drawn: a.m12, a.m13, a.m14. To draw one: --quantity a.m12." in page


def test_quantities_of_one_distance_do_not_displace_curves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    many_columns = [Column(f"a.m{n}", "V", "Voltage.", figure=Figure(f"a: m{n}", Kind.MEDIAN)) for n in range(15)]
    last = Column("b.level", "V", "Voltage.", figure=Figure("b: level", Kind.MEDIAN))
    for (distance, metres), columns in zip(DISTANCES.items(), ((*many_columns, last), (last,)), strict=True):
        plan = vendor_trials.plan(distance, distance=distance, metres=metres, columns=columns)
        vendor_trials.write(tmp_path, plan, vendor_trials.valid_rows(plan, repeats=2))
    output_of(capsys, "report", ".", "-o", "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "b: level against distance" in page
    assert "a: m0 against distance" not in page
    assert "Not drawn" not in page
    (dots,) = re.findall(r'<figure id="quantities".*?</figure>', page, re.DOTALL)
    assert all(f"a: m{n}: " in dots for n in range(15))


HOSTILE = ("<script>alert(1)</script>", r"\input{/etc/passwd}", "[x](javascript:alert)", "$2^{10}$ & #%_~", "`a`|b")


def test_texts_of_a_plan_are_escaped_in_all_formats(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    columns = [
        Column(f"a{number}", text[:20], text, figure=Figure(text, Kind.MEDIAN)) for number, text in enumerate(HOSTILE)
    ]
    plan = vendor_trials.plan("one", distance="30ft", metres=9.144, columns=columns)
    vendor_trials.write(tmp_path, plan, vendor_trials.valid_rows(plan, repeats=2))
    output_of(capsys, "report", ".", "-o", "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert "javascript:alert)</a>" not in page
    arguments = ("aggregate", ".", *(word for column in columns for word in ("--quantity", column.name)))
    latex = output_of(capsys, *arguments, "--format", "latex")
    for text in ("alert(1)", "etc/passwd", "javascript:alert"):
        assert text in latex, "the table contains each text"
    assert r"\input{" not in latex
    assert not re.search(r"(?<!\\)[$#_~^]", re.sub(r"\\textasci\w+\{\}", "", latex.split(r"\toprule")[1]))
    (n_cells,) = {
        line.count("|") - line.count(r"\|")
        for line in output_of(capsys, *arguments, "--format", "markdown").splitlines()[2:-1]
        if line
    }
    assert n_cells > 0


def test_columns_of_a_procedure_are_those_of_its_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "procedures").mkdir()
    (tmp_path / "procedures" / "two.yaml").write_text(
        "name: two\nsummary: x\nscenario: los\ntopology: masterless\nprotocols: [udp]\nrepeats: 1\nsteps:\n"
        "  - ping: {name: small, from: sender, to: receiver, payload_bytes: {udp: 502}}\n"
        "  - ask: {column: wind, question: How strong is the wind, unit: m/s}\n",
        encoding="utf-8",
    )
    listed_columns = output_of(capsys, "columns", "two")
    assert re.search(r"^ small\.rtt_median_s +s +median +Median round-trip time\.$", listed_columns, re.MULTILINE)
    assert re.search(r"^ wind +m/s +median +Answer of the operator", listed_columns, re.MULTILINE)
    assert "rtt_loss" in listed_columns
    assert "ip_loss" not in listed_columns.replace("small.", "")
    assert output_of(capsys, "columns", "procedures/two.yaml") == listed_columns
    assert main(["columns", "procedures/too.yaml"]) == 2
    assert "procedures/too.yaml: " in capsys.readouterr().err
    assert main(["columns", "too"]) == 2
    assert "did you mean 'two'" in capsys.readouterr().err
    assert main(["columns", "two", "ip_loss"]) == 2
    assert main(["columns", "show"]) == 2
    assert "fieldkit columns lists them" in capsys.readouterr().err
    assert "Median round-trip time." in output_of(capsys, "columns", "show", "rtt_median_s")
    assert "Median round-trip time." in output_of(capsys, "columns", "show", "small.rtt_median_s")
