"""Where commands write: into no pipe, device or folder, and into streams that are closed."""

import os
import subprocess
import sys
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


@pytest.mark.parametrize("closed", ["1>&-", "0>&- 1>&- 2>&-"])
def test_a_stream_that_the_caller_closed_is_no_traceback(tmp_path: Path, closed: str) -> None:
    words = (sys.executable, "-m", "fieldkit", "aggregate", str(write(tmp_path, [ROW])))
    run = subprocess.run(("sh", "-c", f'exec "$@" {closed}', "sh", *words), stderr=subprocess.PIPE, check=False)
    assert (run.returncode, run.stderr) == (0, b"")
