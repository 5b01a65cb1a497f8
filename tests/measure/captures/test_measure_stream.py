"""Captures that are read in chunks equal the whole file for every chunk size, and need bounded memory."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.packets import Packets
from tests.helpers.captures import TCPDUMP, file_bytes, segment, timed
from tests.helpers.dissected import rows
from tests.helpers.nightly import mark_nightly
from tests.measure.captures.test_measure_pcapng import VALID as BLOCKS

FRAMES = timed([segment(index, 100)[: 24 + index] for index in range(9)])
FILES = {
    "classic": file_bytes(FRAMES),
    "classic, shorter and shorter": file_bytes(FRAMES[::-1]),
    "pcapng": BLOCKS,
    "classic, cut": file_bytes(FRAMES)[:-7],
    "pcapng, cut": BLOCKS[:-7],
    "classic, broken": file_bytes(FRAMES[:6]) + b"\xff" * 20 + b"\x01" * 50,
    "pcapng, broken": BLOCKS + b"\xff" * 20,
    "empty": file_bytes([]),
    "an unfinished header": file_bytes(FRAMES) + bytes(15),
}


@pytest.mark.parametrize("step", mark_nightly([5, 1]))
@pytest.mark.parametrize("name", FILES)
def test_chunks_of_every_size_equal_the_whole_file(tmp_path: Path, name: str, step: int) -> None:
    """CI uses every fifth size; 5 has no common divisor with the sizes of headers and the alignment of blocks."""
    path = tmp_path / "x"
    path.write_bytes(FILES[name])
    whole_capture = pcap.parse(FILES[name], where=str(path))
    assert (
        len(whole_capture.packets)
        == whole_capture.frames
        == {"empty": 0, "classic, broken": 6}.get(name, whole_capture.frames)
    )
    for chunk_bytes in range(1, len(FILES[name]) + 2, step):
        chunks = list(pcap.stream(path, chunk_bytes=chunk_bytes))
        assert rows(Packets.concatenated(chunk.packets for chunk in chunks)) == rows(whole_capture.packets)
        assert sum(chunk.frames for chunk in chunks) == whole_capture.frames
        assert [chunk.damage for chunk in chunks] == [None] * (len(chunks) - 1) + [whole_capture.damage]
        assert chunk_bytes > 1 or name == "empty" or len(chunks) >= whole_capture.frames


@pytest.mark.parametrize("name", FILES)
def test_concatenated_chunks_equal_the_whole_file(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The number of packets per chunk is constant, or larger or smaller than in the first chunk."""
    whole_capture = pcap.parse(FILES[name], where="x")
    for chunk_bytes in (1, 100, 200, 1000):
        monkeypatch.setattr(pcap, "CHUNK_BYTES", chunk_bytes)
        joined_capture = pcap.parse(FILES[name], where="x")
        assert rows(joined_capture.packets) == rows(whole_capture.packets)
        assert (joined_capture.frames, joined_capture.damage) == (whole_capture.frames, whole_capture.damage)


@pytest.mark.parametrize("name", ["nc-udp", "nc-tcp"])
def test_a_recorded_capture_in_chunks(name: str) -> None:
    path = TCPDUMP / f"{name}.pcap"
    chunks = [chunk.packets for chunk in pcap.stream(path, chunk_bytes=1000)]
    assert len(chunks) > 5
    assert rows(Packets.concatenated(chunks)) == rows(pcap.read(path).packets)


def test_a_capture_truncated_while_it_is_read_does_not_end_the_process(tmp_path: Path) -> None:
    """If the file were mapped into memory, its missing pages would raise SIGBUS."""
    (path := tmp_path / "sender.pcap").write_bytes(FILES["classic"][:24] + FILES["classic"][24:] * 1000)
    chunks = pcap.stream(path, chunk_bytes=1 << 14)
    frames = next(chunks).frames
    os.truncate(path, 1000)
    assert frames + sum(chunk.frames for chunk in chunks) == 9000


def test_a_missing_or_empty_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    for name, message in (("none", "No such file"), ("empty", "is empty"), (".", "Is a directory")):
        with pytest.raises(EvidenceError, match=message):
            next(pcap.stream(tmp_path / name))


def test_columns_remain_available_after_the_file_is_deleted(tmp_path: Path) -> None:
    path = tmp_path / "x.pcap"
    path.write_bytes(FILES["classic"])
    packets = pcap.read(path).packets
    path.unlink()
    assert len(packets) == 9


SUM_FRAMES = """
import sys
from pathlib import Path
from fieldkit.measure.captures import pcap
before = int(open("/proc/self/statm").read().split()[1])
frames, max_pages = 0, 0
for chunk in pcap.stream(Path(sys.argv[1]), chunk_bytes=1 << 20):
    frames += chunk.frames
    max_pages = max(max_pages, int(open("/proc/self/statm").read().split()[1]))
print(frames, max_pages - before)
"""


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.pcap"
    header, record = file_bytes([]), file_bytes(timed([segment(1, 0) + bytes(4000)]))[24:]
    path.write_bytes(header + record * 16_000)
    output = subprocess.run(
        [sys.executable, "-c", SUM_FRAMES, str(path)], capture_output=True, text=True, check=True
    ).stdout
    frames, grown_pages = map(int, output.split())
    assert frames == 16_000
    assert path.stat().st_size > 64e6
    assert grown_pages * resource.getpagesize() < 16e6
