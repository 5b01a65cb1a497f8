"""Output files and streams: pipes, devices and folders are rejected, and closed streams are no error."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.cli import main
from tests.helpers.tables import ROW, write


@pytest.mark.parametrize("argv", [["report"], ["export", "--format", "csv"]], ids=" ".join)
def test_output_that_is_not_a_regular_file_is_rejected(
    tmp_path: Path, argv: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    table, out = write(tmp_path, [ROW]), tmp_path / "out"
    os.mkfifo(out)
    assert main([*argv, str(table), "-o", str(out)]) == 2
    assert capsys.readouterr().err.endswith("remedy: choose another -o\n")
    assert out.is_fifo()


@pytest.mark.parametrize("redirections", ["1>&-", "0>&- 1>&- 2>&-"])
def test_closed_streams_cause_no_traceback(tmp_path: Path, redirections: str) -> None:
    argv = (sys.executable, "-m", "fieldkit", "aggregate", str(write(tmp_path, [ROW])))
    run = subprocess.run(("sh", "-c", f'exec "$@" {redirections}', "sh", *argv), stderr=subprocess.PIPE, check=False)
    assert (run.returncode, run.stderr) == (0, b"")
