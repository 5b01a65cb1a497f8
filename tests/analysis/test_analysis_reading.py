"""Reading of several tables of repeats as a single table."""

import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis import table_files
from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.duplicates import deduplicated
from fieldkit.analysis.repeats import Repeats, parse
from fieldkit.analysis.table_files import read
from fieldkit.core.columns import SCHEMA_VERSION
from fieldkit.core.errors import ConfigurationError, EvidenceError, shell_command
from fieldkit.trial.columns import trial_columns
from fieldkit.trial.rows import to_csv
from tests.helpers.tables import ROW, parsed, repeats, replace, write

CLONE_FS: Final = 0x200
"""linux/sched.h"""


def are_equal(first: Repeats, second: Repeats) -> bool:
    texts_are_equal = all(
        (array == second.texts[name]).all() for name, array in first.texts.items() if name != "source"
    )
    return texts_are_equal and all(
        np.array_equal(array, second.numbers[name], equal_nan=True) for name, array in first.numbers.items()
    )


def test_rows_have_their_source(tmp_path: Path) -> None:
    paths = [write(tmp_path / "a", repeats(ROW, 2)), write(tmp_path, repeats(ROW, 1), "b.csv")]
    assert list(read(paths, trial_columns()).texts["source"]) == [str(tmp_path / "a")] * 2 + [str(tmp_path / "b.csv")]


def test_a_missing_text_of_a_dataset_is_empty(tmp_path: Path) -> None:
    identity = {"schema_version": 1, "trial": "t", "protocol": "udp", "attempt": 1, "status": "failed"}
    rows = [
        identity | {"repeat": number, "reason": reason} for number, reason in enumerate(["late", None, "dead"], 1)
    ]
    pd.DataFrame(rows).to_parquet(tmp_path / "part-0.parquet", index=False)
    assert list(read([tmp_path], trial_columns()).texts["reason"]) == ["late", "", "dead"]


def test_a_dataset_is_read_from_a_thread_with_another_working_folder(tmp_path: Path) -> None:
    """Threads of pyarrow have the working folder of the process, for example after a test in a mount namespace."""
    (tmp_path / "results").mkdir()
    row = {"schema_version": 1, "trial": "t", "protocol": "udp", "attempt": 1, "status": "valid"}
    for number in range(8):
        path = tmp_path / "results" / f"part-{number}.parquet"
        pd.DataFrame([row | {"repeat": number}]).to_parquet(path, index=False)
    read([tmp_path / "results"], trial_columns())  # starts the threads

    def read_relative() -> int:
        assert ctypes.CDLL(None).unshare(CLONE_FS) == 0
        os.chdir(tmp_path)  # changes the folder of this thread only
        return len(read([Path("results")], trial_columns()))

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(read_relative).result() == 8
    assert Path.cwd() != tmp_path


def test_tables_of_other_versions_are_in_the_order_of_the_paths(tmp_path: Path) -> None:
    rows = repeats(ROW, 6)
    paths = [write(tmp_path / str(n), [row]) for n, row in enumerate(rows)]
    old_columns = ("schema_version", "trial", "protocol", "repeat", "attempt", "status", "transfer_s")
    for path, row in list(zip(paths, rows, strict=True))[::2]:
        values = [str(getattr(row, name)) for name in old_columns]
        path.write_text(f"{','.join(old_columns)}\n{','.join(values)}\n", encoding="utf-8")
    rows_read = read(paths, trial_columns())
    assert rows_read.column("transfer_s") == pytest.approx([row.transfer_s for row in rows])
    assert rows_read.column("scenario") == ["", "los"] * 3
    assert rows_read.column("file_loss") == [None, 0.2] * 3


UNITS = {column.name: column.unit for column in trial_columns()}
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "text": st.text(st.characters(exclude_categories=["Cs"]), max_size=8),
    "hash": st.sampled_from(["", "6372e70369712148", "0012", "nan", "true", "1e5"]),
    "bool": st.booleans(),
    "ns": st.integers(0, 2**63 - 1),
    "count": st.integers(0, 2**53) | st.integers(0, 9),
    "B": st.integers(0, 2**53),
}
"""Values of a column by its unit. Columns with other units have floats."""


@st.composite
def rows_of_anything(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Return rows in which a few columns have any values that their units allow, or no value."""
    names = draw(st.lists(st.sampled_from(list(UNITS)), max_size=8, unique=True))
    values = {name: VALUES.get(UNITS[name], st.floats()) for name in names}
    return draw(st.lists(st.fixed_dictionaries({}, optional=values), max_size=4))


@given(rows_of_anything())
def test_rows_equal_those_read_from_their_table(rows: list[dict[str, Any]]) -> None:
    expected, read_back = parsed(rows), parse(to_csv(rows, trial_columns()).encode(), trial_columns())
    assert len(expected) == len(rows)
    assert are_equal(expected, read_back)
    for first, second in ((expected.numbers, read_back.numbers), (expected.texts, read_back.texts)):
        assert [(name, column.dtype) for name, column in first.items()] == [
            (name, column.dtype) for name, column in second.items()
        ]


cut_points = st.lists(st.integers(0, 12), max_size=5).map(sorted)


@given(cut_points)
def test_any_split_into_files_gives_the_same_rows(cuts: list[int]) -> None:
    rows = [*repeats(ROW, 6), *repeats(replace(ROW, protocol="tcp", reason='a "quoted", reason'), 6)]
    parts = [rows[low:high] for low, high in zip([0, *cuts], [*cuts, 12], strict=True)]
    contents = [to_csv(part, trial_columns()).encode() for part in parts]
    rows_read = read(
        [Path(str(n)) for n in range(len(parts))], trial_columns(), content=lambda path: contents[int(path.name)]
    )
    assert are_equal(rows_read, parsed(rows))
    assert aggregate(rows_read) == aggregate(parsed(rows))


@pytest.mark.parametrize(
    "save",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "\ufeff" + text,
        lambda text: text + "\n\n",
        lambda text: text.replace(",30ft,", ',"30ft",'),
    ],
    ids=["Windows", "byte order mark", "empty lines", "quotes"],
)
def test_a_table_saved_by_a_spreadsheet_is_read(tmp_path: Path, save: Callable[[str], str]) -> None:
    paths = [write(tmp_path / name, repeats(replace(ROW, trial=name), 3)) for name in "ab"]
    before = read(paths, trial_columns())
    paths[0].write_text(save(paths[0].read_text(encoding="utf-8")), encoding="utf-8", newline="")
    rows_read = read(paths, trial_columns())
    assert are_equal(rows_read, before)
    assert list(rows_read.texts["source"]) == list(before.texts["source"])


@pytest.mark.parametrize(
    ("damage", "line", "message"),
    [
        (lambda lines: [*lines[:3], lines[3][:40], *lines[4:]], 4, "cells in a table of"),
        (lambda lines: [*lines[:2], lines[2].replace("valid", "fine"), *lines[3:]], 3, "status is 'fine'"),
        (lambda lines: [*lines[:2], lines[2].replace("9.144", "near"), *lines[3:]], 3, "distance_m is 'near'"),
        (lambda lines: [*lines[:2], lines[2].replace("9.144", "inf"), *lines[3:]], 3, "distance_m is 'inf'"),
        (lambda lines: [*lines[:2], lines[2].replace("los", "l\udcffs"), *lines[3:]], 3, "not UTF-8"),
        (lambda lines: [*lines[:4], lines[4].replace("valid", '"valid')], 5, "not CSV"),
    ],
    ids=["torn", "status", "number", "infinite", "bytes", "quote"],
)
def test_the_error_of_a_damaged_line_names_file_and_line(
    tmp_path: Path, damage: Callable[[list[str]], list[str]], line: int, message: str
) -> None:
    paths = [write(tmp_path / name, repeats(replace(ROW, trial=name), 4)) for name in "abc"]
    lines = damage(paths[1].read_text(encoding="utf-8").splitlines())
    paths[1].write_text("\n".join([*lines, ""]), encoding="utf-8", errors="surrogateescape")
    with pytest.raises(EvidenceError, match=message) as error_info:
        read(paths, trial_columns())
    assert error_info.value.where == f"{paths[1]}:{line}"


def test_a_table_truncated_in_its_last_line_is_refused_or_lacks_that_line(tmp_path: Path) -> None:
    """A truncated last cell can be another valid number: 15336791.6 truncated to 1533679."""
    path = write(tmp_path / "a", repeats(ROW, 2))
    content = path.read_bytes()
    last_line_start = content.rindex(b"\n", 0, -1) + 1
    for end in range(last_line_start, len(content)):
        path.write_bytes(content[:end])
        if end == last_line_start:
            assert len(read([path], trial_columns())) == 1
            continue
        with pytest.raises(
            EvidenceError, match="the last line has no line feed: the table may be truncated"
        ) as error_info:
            read([path], trial_columns())
        assert error_info.value.where == f"{path}:3"
        assert shell_command("fieldkit", "rebuild", path.parent) in error_info.value.remedy


def test_a_newer_schema_requires_a_newer_fieldkit(tmp_path: Path) -> None:
    path = write(tmp_path, repeats(replace(ROW, schema_version=SCHEMA_VERSION + 1), 2))
    with pytest.raises(ConfigurationError, match="this version of fieldkit supports at most") as error_info:
        read([path], trial_columns())
    assert error_info.value.remedy == "upgrade fieldkit"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks schema_version, trial"),
        ("time,x\n1,2\n", "lacks"),
        ("{header},status\n", "it has more than one column status"),
        ("{header}" + 140_000 * "x", "lacks schema_version, trial"),
    ],
)
def test_a_file_without_the_required_columns_is_refused(tmp_path: Path, text: str, message: str) -> None:
    header = to_csv([], trial_columns()).strip()
    path = tmp_path / "other.csv"
    path.write_text(text.format(header=header), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message):
        read([path], trial_columns())


def test_a_trial_in_two_tables_counts_once(tmp_path: Path) -> None:
    rows = repeats(ROW, 3)
    paths = [write(tmp_path / "a", rows[:2]), write(tmp_path / "copy", rows)]
    rows_read, notes = deduplicated(read(paths, trial_columns()))
    assert rows_read.column("repeat") == [1, 2, 3]
    assert notes == (f"{tmp_path / 'copy'}: 2 rows also in {tmp_path / 'a'}, counted once",)


def test_two_tables_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    rows = repeats(ROW, 2)
    paths = [write(tmp_path / "a", rows), write(tmp_path / "b", [rows[0], replace(rows[1], transfer_s=9.0)])]
    with pytest.raises(ConfigurationError, match=r"udp-02 of .* has another transfer_s than in .*a"):
        deduplicated(read(paths, trial_columns()))


def test_only_the_requested_columns_are_read(tmp_path: Path) -> None:
    rows_read = read([write(tmp_path, repeats(ROW, 2))], trial_columns(), ["distance", "transfer_s"])
    assert rows_read.numbers.keys() == {"schema_version", "repeat", "attempt", "transfer_s"}
    assert rows_read.texts.keys() == {"trial", "protocol", "status", "distance", "source"}


def test_no_table_gives_no_row() -> None:
    assert len(read([], trial_columns())) == 0


def test_a_large_table_is_read_block_by_block_to_the_same_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = write(tmp_path, [replace(ROW, repeat=1 + n, sender=f"robot {n}") for n in range(50)])
    all_rows = read([table], trial_columns())
    monkeypatch.setattr(table_files, "_BATCH_BYTES", 1000)
    blocks = read([table], trial_columns())
    assert are_equal(blocks, all_rows)
    assert (blocks.texts["source"] == all_rows.texts["source"]).all()


def test_a_damaged_line_of_a_large_table_has_its_number_in_the_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = write(tmp_path, [replace(ROW, repeat=1 + n) for n in range(50)])
    lines = table.read_text(encoding="utf-8").splitlines()
    lines[40] = lines[40].replace(",valid,", ",vali,")
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    monkeypatch.setattr(table_files, "_BATCH_BYTES", 1000)
    with pytest.raises(EvidenceError, match=r"trial\.csv:41"):
        read([table], trial_columns())


@given(st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from([1.0, 2.0, None])), min_size=1))
def test_rows_have_equal_codes_if_and_only_if_their_columns_are_equal(keys: list[tuple[str, float | None]]) -> None:
    table = [replace(ROW, repeat=1 + n, sender=text, distance_m=metres) for n, (text, metres) in enumerate(keys)]
    codes = parse(to_csv(table, trial_columns()).encode(), trial_columns()).codes(("sender", "distance_m")).tolist()
    assert [[a == b for b in codes] for a in codes] == [[a == b for b in keys] for a in keys]
