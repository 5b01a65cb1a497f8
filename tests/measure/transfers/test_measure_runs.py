"""Scans of pcap records of equal length in leaps find the same frames as a scan record by record."""

import struct

from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.captures import classic_pcap, pcap
from tests.helpers.captures import Frame, file_bytes, segment

runs = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 200)), min_size=1, max_size=12)


def records(data: bytes) -> list[int]:
    """Return the start of each record's frame from the record headers."""
    at, starts = 24, []
    while at < len(data):
        starts.append(at + 16)
        at += 16 + struct.unpack_from("<I", data, at + 8)[0]
    return starts


@given(runs, st.integers(1, 20_000))
def test_runs_of_any_lengths(some: list[tuple[int, int]], chunk_bytes: int) -> None:
    frames = [Frame(0, bytes(1 + size)) for size, count in some for _ in range(count)]
    data = file_bytes(frames)
    chunks = list(classic_pcap.chunks(data, where="test", chunk_bytes=chunk_bytes))
    assert [at for chunk in chunks for at in chunk.frames.start.tolist()] == records(data)
    assert [chunk.damage for chunk in chunks] == [None] * len(chunks)


@given(st.integers(1, 5_000))
def test_a_run_cut_anywhere_gives_what_is_before_the_cut(cut: int) -> None:
    content = file_bytes([Frame(index, segment(index, 0)) for index in range(100)])
    data = content[: max(24, len(content) - cut)]
    capture = pcap.parse(data, where="test")
    per_packet = len(segment(0, 0)) + 16
    assert len(capture.packets) == (len(data) - 24) // per_packet
    assert (capture.damage is None) == ((len(data) - 24) % per_packet == 0)
    assert capture.packets.tcp_seq.tolist() == list(range(len(capture.packets)))
