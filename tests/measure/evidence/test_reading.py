"""Comparison of evidence files by size and content, and refusal of special files."""

import os
from pathlib import Path

import pytest

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import reading


@pytest.mark.parametrize(("change", "is_equal"), [(b"", True), (b"x", False)])
@pytest.mark.parametrize("offset", [0, 1 << 20, (3 << 20) - 1])
def test_files_are_compared_byte_for_byte(tmp_path: Path, offset: int, change: bytes, is_equal: bool) -> None:
    content = bytearray(3 << 20)
    (tmp_path / "a").write_bytes(content)
    content[offset : offset + len(change)] = change
    (tmp_path / "b").write_bytes(content)
    assert reading.size(tmp_path / "a") == reading.size(tmp_path / "b") == 3 << 20
    assert reading.have_equal_bytes(tmp_path, "a", "b") is is_equal


def test_a_file_is_not_equal_to_its_prefix(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"x" * 10)
    (tmp_path / "b").write_bytes(b"x" * 11)
    assert not reading.have_equal_bytes(tmp_path, "a", "b")


@pytest.mark.parametrize("read_function", [reading.size, reading.text, reading.mapped])
def test_a_pipe_and_a_device_are_refused(tmp_path: Path, read_function: object) -> None:
    assert callable(read_function)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    for name in ("pipe", "device"):
        with pytest.raises(EvidenceError, match="is not a regular file"):
            read_function(tmp_path / name)


def test_text_above_the_size_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "MAX_TEXT_BYTES", 1 << 20)
    (tmp_path / "ping.txt").write_bytes(b"\n" * (1 << 20))
    assert len(reading.text(tmp_path / "ping.txt")) == 1 << 20
    (tmp_path / "ping.txt").write_bytes(b"\n" * ((1 << 20) + 1))
    with pytest.raises(EvidenceError, match="longer than 1 MiB"):
        reading.text(tmp_path / "ping.txt")
