"""Trials in Python have the same content as their tables, exports and captures."""

import csv
import io
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

import fieldkit
from fieldkit.api import trials as api
from fieldkit.cli import main
from fieldkit.core.columns import cell_text
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.export.table import Table
from fieldkit.trial import store
from tests.helpers import recorded, vendor_trials
from tests.helpers.recorded import AHEAD_NS, LOST, PACKETS, SECOND_NS, START_NS
from tests.helpers.stored_trials import TRIALS

STORED = sorted(TRIALS.iterdir())
LOSSY = next(path for path in STORED if path.name.startswith("20261122T013134"))


@pytest.fixture
def named_step_trials(tmp_path: Path) -> Path:
    """Return a folder with two trials that have named steps and columns of a vendor."""
    for number, columns in enumerate(
        (vendor_trials.NAMED_STEP_COLUMNS, (*vendor_trials.NAMED_STEP_COLUMNS, *vendor_trials.VENDOR_COLUMNS))
    ):
        plan = vendor_trials.plan(f"named-{number}", distance="10m", metres=10.0, columns=columns)
        vendor_trials.write(tmp_path / "trials", plan, vendor_trials.valid_rows(plan, seed=number))
    return tmp_path / "trials"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a trial that tests must not change."""
    return recorded.make(tmp_path_factory.mktemp("trials"))


@pytest.fixture
def recorded_trial(original: Path, tmp_path: Path) -> Path:
    """Return a copy of that trial, which a test may change."""
    return Path(shutil.copytree(original, tmp_path / original.name))


def as_csv(table: Table) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table.column_names)
    writer.writerows([cell_text(value) for value in row.values()] for row in table.to_pylist())
    return out.getvalue()


@pytest.mark.parametrize("folder", STORED, ids=lambda path: path.name)
def test_repeats_and_cells_equal_the_trial_tables(folder: Path) -> None:
    trials = fieldkit.load(folder)
    assert as_csv(trials.repeats) == (folder / store.TRIAL_CSV).read_text(encoding="utf-8")
    assert as_csv(trials.cells()) == (folder / store.SUMMARY_CSV).read_text(encoding="utf-8")


def test_repeats_equal_the_export(named_step_trials: Path, tmp_path: Path) -> None:
    for paths in ([TRIALS], [named_step_trials], [TRIALS, named_step_trials]):
        out = tmp_path / "out.parquet"
        assert main(["export", *map(str, paths), "--format", "parquet", "-o", str(out)]) == 0
        written = pyarrow.parquet.read_table(out)
        repeats = fieldkit.load(*paths).repeats
        assert repeats.equals(written, check_metadata=True)
        out.unlink()


def test_cells_of_named_steps_equal_aggregate(named_step_trials: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["aggregate", str(named_step_trials), "--by", "trial,protocol", "--format", "csv"]) == 0
    with pytest.warns(UserWarning, match="echo requests of different sizes"):
        cells = fieldkit.load(named_step_trials).cells(by=["trial", "protocol"])
    assert as_csv(cells) == capsys.readouterr().out
    units = {row["quantity"]: row["unit"] for row in cells.to_pylist()}
    assert (units["up.file_loss"], units["probe.level"]) == ("share", "dBm")


def test_cells_have_the_requested_quantities() -> None:
    rows = fieldkit.load(TRIALS).cells("protocol", "rtt_median_s").to_pylist()
    assert [(row["protocol"], row["quantity"]) for row in rows] == [("tcp", "rtt_median_s"), ("udp", "rtt_median_s")]
    assert all(row["low"] <= row["value"] <= row["high"] for row in rows)


def test_cells_can_be_grouped_by_source() -> None:
    with pytest.warns(UserWarning, match="echo requests of different sizes"):
        sources = {row["source"] for row in fieldkit.load(TRIALS).cells("source").to_pylist()}
    assert sources == {str(path) for path in STORED}


@pytest.mark.motion  # a stored trial has a step `move`
@pytest.mark.parametrize("folder", STORED, ids=lambda path: path.name)
def test_packet_counts_equal_those_of_the_trial(folder: Path) -> None:
    """The measurements of a trial can be calculated from its packets."""
    trials = fieldkit.load(folder)
    valid = [row for row in trials.repeats.to_pylist() if row["status"] == "valid"]
    assert valid
    for row in valid:
        check_packets(row, trials.packets(f"{row['protocol']}-{row['repeat']:02}"))


def check_packets(row: dict[str, Any], packets: Table) -> None:
    columns = packets.to_pydict()
    if row["protocol"] == "udp":
        assert packets.num_rows == row["ip_packets_sent"]
        assert columns["lost"].count(True) == row["ip_packets_sent"] - row["ip_packets_received"]
        assert [time is None for time in columns["received_ns"]] == columns["lost"]
    elif row["tcp_sent_bytes"] is None:
        assert not packets.num_rows, "no connection was established"
    else:
        assert columns["sent_again"].count(True) == row["tcp_retransmitted_segments"]
        assert (columns["lost"].count(True) > 0) is (row["tcp_byte_loss"] > 0)
    delays = packets["delay_s"].drop_null().to_numpy()
    if row["one_way_median_s"] is not None:
        assert np.median(delays) == pytest.approx(row["one_way_median_s"], abs=1e-9)
    if row["one_way_error_s"] is not None:
        error_s = np.unique(packets["delay_error_s"].drop_null().to_numpy())
        assert error_s == pytest.approx([row["one_way_error_s"]])


def test_each_packet_has_the_times_at_which_it_was_captured(recorded_trial: Path) -> None:
    packets = fieldkit.load(recorded_trial).packets("udp-01").to_pydict()
    start_ns = START_NS + 12 * SECOND_NS
    assert packets["sent_ns"] == [start_ns + 1_000_000 * number for number in range(PACKETS)]
    assert packets["received_ns"] == [
        None if number in LOST else sent_ns + AHEAD_NS for number, sent_ns in enumerate(packets["sent_ns"])
    ]
    assert [number for number, is_lost in enumerate(packets["lost"]) if is_lost] == list(LOST)
    assert set(packets["wire_bytes"]) == {1042}
    assert set(packets["payload_bytes"]) == {1008}
    assert set(packets["delay_s"]) == {None}, "without packets in the other direction the clock offset is unknown"


def test_packets_of_a_step_are_selected_by_its_name(recorded_trial: Path) -> None:
    path = recorded_trial / "trial.yaml"
    before, step, after = path.read_text(encoding="utf-8").partition("- transfer:\n")
    keys, ping, remaining = after.partition("      - ping:\n")
    up, down = (f"{step}          name: {name}\n{keys}" for name in ("up", "down"))
    path.write_text(f"{before}{up}      {down.replace('1234', '4321')}{ping}{remaining}", encoding="utf-8")
    (recorded_trial / store.MANIFEST_FILE).unlink(missing_ok=True)
    trials = fieldkit.load(recorded_trial)
    assert (trials.packets("udp-01", "up").num_rows, trials.packets("udp-01", "down").num_rows) == (PACKETS, 0)
    assert trials.packets("udp-01")["step"].to_pylist() == ["up"] * PACKETS
    with pytest.raises(ConfigurationError, match="no transfer of los is named 'across'") as error_info:
        trials.packets("udp-01", "across")
    assert error_info.value.remedy == "its transfers: 'up', 'down'"


def test_a_missing_value_of_a_grouping_column_is_null() -> None:
    with pytest.warns(UserWarning, match="echo requests of different sizes"):
        cells = fieldkit.load(TRIALS).cells("reason", "rtt_loss")
    assert None in cells["reason"].to_pylist()


def test_every_column_has_its_unit(recorded_trial: Path) -> None:
    trials = fieldkit.load(recorded_trial)
    for table in (trials.repeats, trials.cells(), trials.packets("udp-01")):
        assert all(field.metadata[b"unit"] and field.metadata[b"meaning"] for field in table.schema)
    assert trials.packets("udp-01").schema.field("sent_ns").metadata[b"unit"] == b"ns"


def test_tables_become_data_frames(recorded_trial: Path) -> None:
    trials = fieldkit.load(recorded_trial)
    assert list(trials.repeats.to_pandas()["status"]) == ["void", "valid"]
    assert trials.packets("udp-01").to_pandas()["lost"].sum() == len(LOST)


def test_only_data_frames_need_pandas(recorded_trial: Path) -> None:
    program = """
import sys, fieldkit
class WithoutPandas:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "pandas":
            raise ModuleNotFoundError(f"No module named {name!r}")
sys.meta_path.insert(0, WithoutPandas())
trials = fieldkit.load(sys.argv[1])
print(len(trials.repeats), len(trials.cells()) > 0, len(trials.packets("udp-01")))
trials.repeats.to_pandas()
"""
    completed = subprocess.run(
        (sys.executable, "-c", program, str(recorded_trial)), capture_output=True, text=True, check=False
    )
    assert completed.stdout == f"2 True {PACKETS}\n"
    assert "ModuleNotFoundError: No module named 'pandas'" in completed.stderr


@pytest.mark.parametrize(
    ("repeat", "error", "message"),
    [
        ("udp-02", ConfigurationError, "there is no repeat 'udp-02'"),
        ("udp-01.void1", EvidenceError, "there are no complete captures of both ends"),
    ],
)
def test_unknown_attempts_and_transfers_are_rejected(
    recorded_trial: Path, repeat: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        fieldkit.load(recorded_trial).packets(repeat)


def test_a_repeat_of_several_trials_needs_its_trial() -> None:
    trials = fieldkit.load(TRIALS)
    with pytest.raises(ConfigurationError, match="2 trials have a repeat 'udp-01'") as error_info:
        trials.packets("udp-01")
    assert f"{LOSSY.name}/udp-01" in error_info.value.remedy


def test_packets_without_unchanged_evidence_are_rejected(tmp_path: Path) -> None:
    shutil.copytree(LOSSY, trial := tmp_path / LOSSY.name)
    table = shutil.copy(trial / store.TRIAL_CSV, tmp_path / "alone.csv")
    with pytest.raises(EvidenceError, match="evidence of udp-02 is not available"):
        fieldkit.load(table).packets("udp-02")
    with (trial / store.REPEATS / "udp-02" / "receiver.pcap").open("ab") as capture:
        capture.write(b"more")
    with pytest.raises(EvidenceError, match="is not available"):
        fieldkit.load(trial).packets("udp-02")
    assert fieldkit.load(trial).packets("udp-01").num_rows


def test_paths_without_a_trial_are_rejected_as_by_commands(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no path"):
        fieldkit.load()
    with pytest.raises(ConfigurationError, match="no such file or folder"):
        fieldkit.load(tmp_path / "gone")
    with pytest.raises(ConfigurationError, match="there is no trial in this folder"):
        fieldkit.load(tmp_path)
    other = tmp_path / "other.csv"
    other.write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.warns(UserWarning, match="read as text"), pytest.raises(ConfigurationError, match="not a table of"):
        fieldkit.load(other)


def test_a_damaged_table_is_rejected_with_its_line(tmp_path: Path) -> None:
    lines = (LOSSY / store.TRIAL_CSV).read_text(encoding="utf-8").splitlines(keepends=True)
    damaged = tmp_path / "damaged.csv"
    damaged.write_text("".join([*lines[:2], lines[2].replace("udp,", "udp,x", 1).replace("tcp,", "tcp,x", 1)]))
    with pytest.raises(EvidenceError, match=r"damaged\.csv:3"):
        fieldkit.load(damaged)
    damaged.write_text("".join(lines)[:-1])
    with pytest.raises(EvidenceError, match="the last line has no line feed"):
        fieldkit.load(damaged)


@pytest.mark.parametrize(
    ("by", "quantities", "message"), [("protocl", None, "by: "), ("protocol", ["ip_los"], "quant")]
)
def test_a_mistyped_column_is_rejected(by: str, quantities: list[str] | None, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as error_info:
        fieldkit.load(TRIALS).cells(by, quantities)
    assert error_info.value.remedy.startswith("did you mean")


def test_notes_of_commands_are_warnings(tmp_path: Path) -> None:
    shutil.copytree(LOSSY, tmp_path / "1")
    (tmp_path / "2").mkdir()
    (tmp_path / "2" / "trial.yaml").touch()
    with pytest.warns(UserWarning, match="is omitted"):
        fieldkit.load(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fieldkit.load(tmp_path / "1")


def test_rebuild_measures_the_evidence_again(recorded_trial: Path) -> None:
    stored_repeats = fieldkit.load(recorded_trial).repeats
    (recorded_trial / store.TRIAL_CSV).unlink()
    with pytest.warns(UserWarning, match="valid repeats may lack values now"):  # its UDP repeat has no snapshots
        repeats = fieldkit.load(recorded_trial, rebuild=True).repeats
    assert repeats.equals(stored_repeats)


def test_the_package_imports_its_readers_lazily() -> None:
    program = "import sys; before = set(sys.modules); import fieldkit; print(*sorted(set(sys.modules) - before))"
    completed = subprocess.run((sys.executable, "-c", program), capture_output=True, text=True, check=True)
    assert completed.stdout == "fieldkit\n"
    assert fieldkit.load is api.load
    with pytest.raises(AttributeError, match="has no attribute 'lod'"):
        fieldkit.lod  # type: ignore[attr-defined]  # noqa: B018


def test_a_cell_has_its_figures_by_name(named_step_trials: Path) -> None:
    trials = fieldkit.load(LOSSY)
    cell = trials.cell(protocol="udp")
    row = next(
        row
        for row in trials.cells(quantities="file_loss").to_pylist()
        if (row["protocol"], row["quantity"]) == ("udp", "file_loss")
    )
    figure = cell.file_loss
    assert (figure.value, figure.low, figure.high, figure.n) == (row["value"], row["low"], row["high"], row["n"])
    assert (figure.name, figure.unit, cell.n_valid, cell.condition["protocol"]) == (
        "file_loss",
        "share",
        row["n"],
        "udp",
    )
    assert figure in list(cell)
    with pytest.warns(UserWarning, match="echo requests of different sizes"):
        up = fieldkit.load(named_step_trials).cell(trial="named-0", protocol="udp")["up.file_loss"]
    assert (up.n, up.unit) == (8, "share")


def test_the_interval_of_a_single_repeat_is_infinite(recorded_trial: Path) -> None:
    figure = fieldkit.load(recorded_trial).cell().ip_loss
    assert (figure.n, figure.low, figure.high) == (1, -np.inf, np.inf)


@pytest.mark.parametrize(
    ("condition", "message", "remedy"),
    [
        (
            {},
            "there are 4 cells; the condition must select exactly one",
            "they differ in procedure: 'driveaway', 'los', 'selfheal'; ",
        ),
        (
            {"protocol": "sctp"},
            "no cells have protocol='sctp'; the condition must select exactly one",
            "protocol: 'tcp', 'udp'",
        ),
        ({"protocl": "udp"}, "cell: there is no column 'protocl'", "did you mean 'protocol'?"),
    ],
)
def test_an_ambiguous_cell_is_rejected(condition: dict[str, str], message: str, remedy: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as error_info:
        fieldkit.load(TRIALS).cell(**condition)
    assert remedy in error_info.value.remedy


def test_a_figure_without_repeats_is_rejected() -> None:
    cell = fieldkit.load(LOSSY).cell(protocol="udp")
    with pytest.raises(ConfigurationError, match="valid repeats has a figure 'file_los'") as error_info:
        cell.file_los  # noqa: B018
    assert error_info.value.remedy == "did you mean 'file_loss'?"
    assert not hasattr(cell, "__deepcopy__")
