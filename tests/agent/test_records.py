"""The log of a publisher or subscriber whose process is killed, or whose disk is full."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.records import Log, LogError
from fieldkit.ros.streams import topic_samples
from tests.helpers.paths import ROOT

SEVERAL_PIECES = 5 * records.PIECE_BYTES // records.RECORD.size

ENDLESS_WRITER = """
import itertools, os, sys
from fieldkit.agent.messaging import records
log = records.Log(sys.argv[1])
for number in itertools.count():
    log.note(records.SAMPLE, number + 2, size=7, sequence=number, sent_ns=number + 1)
    os.write(1, number.to_bytes(8, "little"))
"""
WRITER_UNTIL_FULL = """
import itertools, sys
from fieldkit.agent.messaging import records
log = records.Log(sys.argv[1])
try:
    for number in itertools.count():
        log.note(records.SAMPLE, number + 2, size=7, sequence=number, sent_ns=number + 1)
except records.LogError as error:
    print(number, error)
"""


def test_killed_writer_leaves_all_noted_records(tmp_path: Path) -> None:
    """Each number is sent through a pipe after its record was stored; the kill may occur at any instruction."""
    with subprocess.Popen((sys.executable, "-c", ENDLESS_WRITER, tmp_path / "log"), stdout=-1, cwd=ROOT) as process:
        assert process.stdout is not None
        process.stdout.read(8 * SEVERAL_PIECES)
        process.send_signal(signal.SIGKILL)
        remaining_output = process.stdout.read()
    n_noted = SEVERAL_PIECES + len(remaining_output) // 8

    content = topic_samples.read_log(tmp_path / "log")
    assert not content.is_complete
    samples = content.samples
    assert len(samples) - n_noted in {0, 1}, "the last record was stored, and perhaps not yet sent"
    assert samples.sequence.tolist() == list(range(len(samples)))
    assert (samples.at_ns - samples.sequence == 2).all()
    assert (samples.sent_ns - samples.sequence == 1).all()


def test_closed_log_contains_only_its_records(tmp_path: Path) -> None:
    log = Log(str(tmp_path / "log"))
    for number in range(SEVERAL_PIECES):
        log.note(records.SAMPLE, 5, sequence=number)
    log.end(6)
    size = (tmp_path / "log").stat().st_size
    assert size == len(records.MAGIC) + (SEVERAL_PIECES + 1) * records.RECORD.size
    content = topic_samples.read_log(tmp_path / "log")
    assert content.is_complete
    assert content.samples.sequence.tolist() == list(range(SEVERAL_PIECES))


def test_full_disk_is_reported_and_keeps_noted_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Log(str(tmp_path / "log"))

    def raise_no_space(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", raise_no_space)
    capacity = (records.PIECE_BYTES - len(records.MAGIC)) // records.RECORD.size
    for number in range(capacity):
        log.note(records.SAMPLE, 5, sequence=number)
    for _ in range(2):  # the error persists
        with pytest.raises(LogError, match=r"log .*/log cannot be written: No space left on device"):
            log.note(records.SAMPLE, 5, sequence=capacity)
    with pytest.raises(LogError):
        log.end(6)
    content = topic_samples.read_log(tmp_path / "log")
    assert (len(content.samples), content.is_complete) == (capacity, False)


@pytest.mark.emulated
def test_full_file_system_raises_no_signal(tmp_path: Path) -> None:
    """The last piece is allocated on disk before data are stored in it."""
    (tmp_path / "disk").mkdir()
    script = 'mount -t tmpfs -o size=200k none disk && "$@" disk/log; code=$?; cp disk/log .; exit $code'
    program = ("env", f"PYTHONPATH={ROOT}", sys.executable, "-c", WRITER_UNTIL_FULL)
    argv = ("unshare", "--mount", "sh", "-c", script, "sh", *program)
    completed = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert completed.returncode == 0, completed
    n_noted, _, output = completed.stdout.partition(" ")
    assert output == "the log disk/log cannot be written: No space left on device\n"
    assert topic_samples.read_log(tmp_path / "log").samples.sequence.tolist() == list(range(int(n_noted)))


def test_log_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="No such file"):
        Log(str(tmp_path / "nowhere" / "log"))
