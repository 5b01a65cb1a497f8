"""The error of a lost worker process shows the end of its output."""

import os
from pathlib import Path

import pytest

from sim_backends.emulated.process.worker import last_line_of


@pytest.mark.parametrize(
    ("output", "line"),
    [
        (b"", ""),
        (b"\n\n", ""),
        (b"first\nlast\n\n", "last"),
        (b"noise\n" * 20_000 + b"RuntimeError: broken\n", "RuntimeError: broken"),
    ],
)
def test_the_last_line_of_long_output_is_found(tmp_path: Path, output: bytes, line: str) -> None:
    path = tmp_path / "log"
    path.write_bytes(output)
    fd = os.open(path, os.O_RDONLY)
    try:
        assert last_line_of(fd) == line
    finally:
        os.close(fd)
