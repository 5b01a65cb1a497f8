"""Malicious bags: small files with which a library would fill the memory or the disk, or would run forever."""

import bz2
import os
import signal
import sqlite3
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import sandbox
from fieldkit.ros.bags import bag
from tests.ros.bags.test_measure_bag import write_bag, write_ros2_bag
from tests.ros.bags.test_measure_battery import TOPIC, TYPE, message, ros1

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MIB = 1 << 20


@pytest.fixture
def one_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the CPU limit from 10 s to 1 s."""
    monkeypatch.setattr(sandbox, "CPU_S", 1)


@pytest.fixture
def unpacking_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[sandbox.SandboxedReader]:
    """A reader that unpacks 1 kB and is killed before its answer, in each try by the next signal of the query."""
    (tmp_path / "unpacks.py").write_text(_UNPACKING_MODULE, encoding="utf-8")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    reader = sandbox.SandboxedReader("unpacks")
    yield reader
    reader.stop()


_UNPACKING_MODULE = """
import os, tempfile
from pathlib import Path
from fieldkit.measure.evidence import sandbox_process

def answer(question):
    if "says" in question:
        return {"said": "x" * question["says"]}
    Path(tempfile.mkdtemp(), "unpacked").write_bytes(bytes(1000))
    ended = Path(question["ended"])
    ended.write_text(ended.read_text() + "|" if ended.exists() else "|")
    signals = question["signals"][len(ended.read_text()) - 1 :]
    if signals:
        os.kill(os.getpid(), signals[0])
    return {"said": "whole"}

sandbox_process.serve(answer)
"""


@pytest.mark.parametrize(
    ("signals", "reason"),
    [
        ([], None),
        ([signal.SIGKILL], None),  # the kernel sends this signal if the memory is full
        ([signal.SIGTERM], None),
        ([signal.SIGKILL, signal.SIGKILL], "another process or the kernel stopped its reader twice"),
        ([signal.SIGXCPU], "takes longer than 10 s"),
        ([signal.SIGSEGV], "exited with code -11"),
    ],
)
def test_a_reader_that_is_killed_externally_is_restarted_and_leaves_no_files(
    unpacking_reader: sandbox.SandboxedReader, tmp_path: Path, signals: list[signal.Signals], reason: str | None
) -> None:
    question = {"signals": signals, "ended": str(tmp_path / "ended")}
    if reason is None:
        assert unpacking_reader.query(question, 1) == {"said": "whole"}
    else:
        with pytest.raises(sandbox.ReaderError, match=reason):
            unpacking_reader.query(question, 1)
    assert list((tmp_path / "tmp").iterdir()) == []


def test_the_limit_of_an_answer_grows_with_the_file(unpacking_reader: sandbox.SandboxedReader) -> None:
    large = sandbox.ANSWER_BYTES + 1000
    assert len(unpacking_reader.query({"says": large}, 4096)["said"]) == large
    with pytest.raises(sandbox.ReaderError, match="its contents exceed the limit for a file of this size"):
        unpacking_reader.query({"says": large}, 10)
    assert len(unpacking_reader.query({"says": 10}, 10)["said"]) == 10, "the next query is answered"


def test_a_reader_needs_no_disk_space_if_it_unpacks_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "scan.bag", {"/scan": 3})
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "full"))
    assert bag.read(path).messages == 3


def test_the_limits_for_sparse_and_large_files_depend_on_the_machine(tmp_path: Path) -> None:
    path = tmp_path / "scan.bag"
    path.touch()
    os.truncate(path, 1 << 42)
    assert bag.allocated_bytes(path) < 128 * MIB
    memory_bytes, _, cpu_s = sandbox._limits(1 << 42)
    assert memory_bytes < os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert cpu_s == sandbox.MAX_CPU_S


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("nanoseconds: ", f"nanoseconds: {'9' * 400} #"),
        ("message_count: ", f"message_count: {'9' * 400} #"),
        ("message_count: ", "message_count: .nan #"),
        ("message_count: ", "message_count: -5 #"),
        ("nanoseconds_since_epoch: ", "nanoseconds_since_epoch: 1e400 #"),
        ("rosbag2_bagfile_information:", "[" * 3000),
        ("rosbag2_bagfile_information:", "- " * 3000),
        ("rosbag2_bagfile_information:", "? " * 3000),
        ("compression_mode: ", "compression_mode: 2026-13-45 #"),
    ],
)
def test_for_invalid_metadata_the_only_error_is_that_the_bag_cannot_be_read(
    tmp_path: Path, one_second: None, old: str, new: str
) -> None:
    path = write_ros2_bag(tmp_path / "scan", "db3", {"/scan": 5})
    metadata = path.parent / bag.METADATA
    text = metadata.read_text(encoding="utf-8")
    assert old in text
    metadata.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(EvidenceError, match=r"cannot be read|counts"):
        bag.read(path)


def test_metadata_with_exponential_references_is_rejected(tmp_path: Path, one_second: None) -> None:
    path = write_ros2_bag(tmp_path / "scan", "db3", {"/scan": 5})
    merged_keys = "".join(f"k{n}: &k{n} {{<<: [{', '.join([f'*k{n - 1}'] * 9)}]}}\n" for n in range(1, 30))
    (path.parent / bag.METADATA).write_text(f"k0: &k0 {{a: 1}}\n{merged_keys}", encoding="utf-8")
    with pytest.raises(EvidenceError, match="cannot be read"):
        bag.read(path)


def test_a_bag_that_exceeds_the_disk_limit_is_rejected(tmp_path: Path) -> None:
    path = write_ros2_bag(tmp_path / "scan", "db3", {"/scan": 5})
    (path.parent / "zeros.zstd").write_bytes(zstd.compress(bytes(64 * MIB)))
    metadata = path.parent / bag.METADATA
    text = metadata.read_text(encoding="utf-8").replace(path.name, "zeros.zstd")
    text = text.replace("compression_format: ''", "compression_format: zstd")
    text = text.replace("compression_mode: ''", "compression_mode: file")
    metadata.write_text(text, encoding="utf-8")
    with pytest.raises(EvidenceError, match="File too large"):
        bag.read(path)


def test_a_chunk_that_exceeds_the_memory_limit_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "scan.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(path)
    writer.set_compression(Writer.CompressionFormat.BZ2)
    zeros = bz2.compress(bytes(16 * MIB)) * 64
    writer.compressor = lambda _: zeros
    with writer:
        connection = writer.add_connection(TOPIC, TYPE, typestore=store)
        writer.write(connection, 1, store.serialize_ros1(message(Stores.ROS1_NOETIC, 0.5), TYPE))
    assert bag.read(path).messages == 1
    with pytest.raises(EvidenceError, match="more memory than the limit for a file of this size"):
        bag.battery_share(path, TOPIC)
    assert bag.battery_share(ros1(Path(tempfile.mkdtemp(dir=tmp_path)), [0.5]), TOPIC) == 0.5


def test_a_database_whose_schema_has_infinite_rows_is_rejected(tmp_path: Path, one_second: None) -> None:
    path = write_ros2_bag(tmp_path / "scan", "db3", {"/scan": 5})
    with closing(sqlite3.connect(path)) as database:
        database.executescript(
            "DROP TABLE schema; CREATE VIEW schema AS"
            " WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
            " SELECT i AS schema_version FROM n WHERE i < 0;"
        )
    with pytest.raises(EvidenceError, match="takes longer than 1 s"):
        bag.read(path)
    assert bag.read(write_ros2_bag(tmp_path / "other", "db3", {"/scan": 5})).messages == 5


def test_forked_processes_do_not_mix_up_their_answers(tmp_path: Path) -> None:
    first_bag = write_bag(tmp_path / "mine.bag", {"/scan": 3})
    second_bag = write_bag(tmp_path / "theirs.bag", {"/scan": 4})
    assert bag.read(first_bag).messages == 3
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            code = 0 if {bag.read(second_bag).messages for _ in range(50)} == {4} else 2
        finally:
            os._exit(code)
    assert {bag.read(first_bag).messages for _ in range(50)} == {3}
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
