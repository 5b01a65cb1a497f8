"""The rows of trials as a single table: CSV as stored on disk, and Parquet with types, units and meanings."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet
import pytest

from fieldkit import __version__
from fieldkit.cli import main
from fieldkit.core.columns import SCHEMA_VERSION
from fieldkit.core.model import Role
from fieldkit.trial import store
from fieldkit.trial.columns import robot_columns, trial_columns
from tests.helpers import recorded
from tests.helpers.recorded import LOST, PACKETS, SECOND_NS, START_NS
from tests.helpers.runs import rows


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    return recorded.make_plain(tmp_path)


def export(*paths: Path, kind: str, name: str = "out") -> Path:
    out = paths[0].parent / f"{name}.{kind}"
    assert main(["export", *map(str, paths), "--format", kind, "-o", str(out)]) == 0
    return out


def test_the_exported_csv_equals_the_trial_csv(trial: Path) -> None:
    assert export(trial, kind="csv").read_bytes() == (trial / store.TRIAL_CSV).read_bytes()


def test_raw_evidence_measured_again_gives_the_same_bytes(trial: Path, tmp_path: Path) -> None:
    table_bytes = (trial / store.TRIAL_CSV).read_bytes()
    (trial / store.TRIAL_CSV).unlink()
    out = tmp_path / "again.csv"
    assert main(["export", str(trial), "--rebuild", "--format", "csv", "-o", str(out)]) == 0
    assert out.read_bytes() == table_bytes


def test_tables_with_different_columns_are_combined(trial: Path, tmp_path: Path) -> None:
    old = tmp_path / "old.csv"
    lines = (trial / store.TRIAL_CSV).read_text(encoding="utf-8").splitlines()
    last_column = lines[0].rpartition(",")[2]
    text = "".join(line.rpartition(",")[0] + "\n" for line in lines)
    old.write_text(text.replace(trial.name, "older"), encoding="utf-8")
    export(trial, old, kind="csv")
    exported_rows = rows(tmp_path, "out.csv")
    assert [row["trial"] for row in exported_rows] == [trial.name, trial.name, "older", "older"]
    assert [row[last_column] for row in exported_rows] == [*(line.rpartition(",")[2] for line in lines[1:]), "", ""]


def test_undeclared_columns_are_kept_as_text(trial: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, extra_cells = trial / store.TRIAL_CSV, ("soil_moisture,,note", "0.300,,wet", ",,")
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text(
        "".join(f"{line},{extra}\n" for line, extra in zip(lines, extra_cells, strict=True)), encoding="utf-8"
    )
    old = tmp_path / "old.csv"
    old.write_text("".join(f"{line}\n" for line in lines).replace(trial.name, "older"), encoding="utf-8")
    table = pa.parquet.read_table(export(trial, old, kind="parquet"))
    assert table.column_names[-2:] == ["soil_moisture", "note"]
    assert table["soil_moisture"].to_pylist() == ["0.300", None, None, None]
    assert capsys.readouterr().err.endswith("declares it: soil_moisture, note\n")
    export(trial, kind="csv")
    assert [row["note"] for row in rows(tmp_path, "out.csv")] == ["wet", ""]


def test_parquet_has_units_meanings_and_versions(trial: Path) -> None:
    schema = pa.parquet.read_schema(export(trial, kind="parquet"))
    for column, field in zip((*trial_columns(), *robot_columns((Role.SENDER, Role.RECEIVER))), schema, strict=True):
        assert field.name == column.name
        assert field.metadata == {b"unit": column.unit.encode(), b"meaning": column.meaning.encode()}
    assert schema.metadata[b"fieldkit_version"].decode() == __version__
    assert int(schema.metadata[b"schema_version"]) == SCHEMA_VERSION


def test_parquet_has_types_and_nulls(trial: Path) -> None:
    table = pa.parquet.read_table(export(trial, kind="parquet"))
    assert {name: str(table.schema.field(name).type) for name in ("repeat", "hash_match", "ip_loss", "status")} == {
        "repeat": "int64",
        "hash_match": "bool",
        "ip_loss": "double",
        "status": "dictionary<values=string, indices=int32, ordered=0>",
    }
    assert table["status"].to_pylist() == ["void", "valid"]
    assert table["reason"].to_pylist() == ["ping.txt is missing", None]
    assert table["hash_match"].to_pylist() == [None, False]
    assert table["ip_packets_sent"].to_pylist() == [None, PACKETS]
    assert table["ip_loss"].to_pylist() == [None, pytest.approx(len(LOST) / PACKETS)]


def test_times_keep_all_digits(trial: Path) -> None:
    path = trial / store.TRIAL_CSV
    path.write_text(path.read_text(encoding="utf-8").replace(str(START_NS), str(START_NS + 1)), encoding="utf-8")
    table = pa.parquet.read_table(export(trial, kind="parquet"))
    assert table["started_utc_ns"].to_pylist() == [START_NS + 1, START_NS + 10 * SECOND_NS]


def test_the_same_rows_give_the_same_bytes(trial: Path) -> None:
    first = export(trial, kind="parquet").read_bytes()
    assert export(trial, kind="parquet", name="again").read_bytes() == first


def test_a_table_without_rows_is_an_error(trial: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = trial / store.TRIAL_CSV
    path.write_text(path.read_text(encoding="utf-8").splitlines(keepends=True)[0], encoding="utf-8")
    assert main(["export", str(trial), "--format", "parquet", "-o", str(tmp_path / "out.parquet")]) == 4
    assert "no repeat has ended yet" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [trial]
