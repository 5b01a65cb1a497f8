"""Where `report` and `export` write: into no pipe, device or folder, and what they say instead."""

import os
from pathlib import Path

import pytest

from fieldkit.cli import main
from tests.helpers.tables import ROW, write


@pytest.mark.parametrize("words", [["report"], ["export", "--format", "csv"]], ids=" ".join)
def test_what_is_no_file_is_neither_read_nor_replaced(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    table, out = write(tmp_path, [ROW]), tmp_path / "out"
    os.mkfifo(out)
    assert main([*words, str(table), "-o", str(out)]) == 2
    assert capsys.readouterr().err.endswith("remedy: choose another -o\n")
    assert out.is_fifo()
