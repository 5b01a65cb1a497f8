"""The fast scan of pcap records of equal length finds the same frames as a scan of single records."""

import struct

from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.captures import classic_pcap, pcap
from tests.helpers.captures import Frame, file_bytes, segment

run_lists = st.lists(st.tuples(st.integers(0, 40), st.integers(1, 200)), min_size=1, max_size=12)


def frame_starts(data: bytes) -> list[int]:
    """Return the start of the frame of each record, computed from the record headers."""
    offset, starts = 24, []
    while offset < len(data):
        starts.append(offset + 16)
        offset += 16 + struct.unpack_from("<I", data, offset + 8)[0]
    return starts


@given(run_lists, st.integers(1, 20_000))
def test_runs_of_any_lengths_are_scanned(runs: list[tuple[int, int]], chunk_bytes: int) -> None:
    frames = [Frame(0, bytes(1 + size)) for size, count in runs for _ in range(count)]
    data = file_bytes(frames)
    chunks = list(classic_pcap.chunks(data, where="test", chunk_bytes=chunk_bytes))
    assert [start for chunk in chunks for start in chunk.frames.start.tolist()] == frame_starts(data)
    assert [chunk.damage for chunk in chunks] == [None] * len(chunks)


@given(st.integers(1, 5_000))
def test_a_truncated_run_gives_the_packets_before_the_cut(n_removed_bytes: int) -> None:
    content = file_bytes([Frame(index, segment(index, 0)) for index in range(100)])
    data = content[: max(24, len(content) - n_removed_bytes)]
    capture = pcap.parse(data, where="test")
    bytes_per_packet = len(segment(0, 0)) + 16
    assert len(capture.packets) == (len(data) - 24) // bytes_per_packet
    assert (capture.damage is None) == ((len(data) - 24) % bytes_per_packet == 0)
    assert capture.packets.tcp_seq.tolist() == list(range(len(capture.packets)))
