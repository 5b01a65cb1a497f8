"""Files of packet delays of a testbed: reading, damaged files, and columns."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import DelayParts, Protocol
from fieldkit.measure.evidence import oracle_delays
from tests.helpers.captures import transfer
from tests.helpers.measures import Measures, measure

PARTS = DelayParts(packets=4, processing_ns=8, transmission_ns=1200, propagation_ns=400, queuing_ns=20_000_000_000)
TEXT = "packets 4\nprocessing_ns 8\ntransmission_ns 1200\npropagation_ns 400\nqueuing_ns 20000000000\n"
UDP = transfer(Protocol.UDP)
NO_DELAYS = Measures(paper_window_bytes=8192)
"""Measurements of a transfer whose delays are missing."""
ZERO_DELAYS = DelayParts(packets=0, processing_ns=0, transmission_ns=0, propagation_ns=0, queuing_ns=0)


def text(parts: DelayParts) -> str:
    return oracle_delays.air_delay_text(ZERO_DELAYS, parts)


def write_file(folder: Path, content: bytes) -> Path:
    path = folder / "medium.txt"
    path.write_bytes(content)
    return path


def test_delays_of_a_transfer_are_read(tmp_path: Path) -> None:
    assert oracle_delays.read_air_delay(write_file(tmp_path, TEXT.encode())) == PARTS


@pytest.mark.parametrize(
    "content",
    [
        "",
        TEXT[:-1],
        TEXT + "\n",
        TEXT + TEXT,
        TEXT.replace("packets", "frames"),
        TEXT.replace(" 8", " -8"),
        TEXT.replace(" 8", " 8.0"),
        TEXT.replace(" 8", " ٨"),
        TEXT.replace(" 8", " " + "8" * 19),
        TEXT.replace("packets 4", "packets 0"),
        "\n".join(reversed(TEXT.splitlines())) + "\n",
    ],
)
def test_invalid_contents_are_refused(tmp_path: Path, content: str) -> None:
    path = write_file(tmp_path, content.encode())
    with pytest.raises(EvidenceError):
        oracle_delays.read_air_delay(path)
    assert measure(tmp_path, UDP) == NO_DELAYS


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_or_read(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    folder = tmp_path_factory.getbasetemp()
    try:
        parts = oracle_delays.read_air_delay(write_file(folder, content))
    except EvidenceError:
        return
    assert text(parts).encode() == content


def test_columns_are_means_per_packet_in_seconds(tmp_path: Path) -> None:
    write_file(tmp_path, TEXT.encode())
    assert measure(tmp_path, UDP) == Measures(
        **NO_DELAYS,
        delay_s=5.000000402,
        delay_processing_s=2e-9,
        delay_transmission_s=3e-7,
        delay_propagation_s=1e-7,
        delay_queuing_s=5.0,
        delay_packets=4,
    )


def test_without_delivered_packets_there_is_no_delay(tmp_path: Path) -> None:
    write_file(tmp_path, text(ZERO_DELAYS).encode())
    assert measure(tmp_path, UDP) == Measures(**NO_DELAYS, delay_packets=0)


def test_without_a_file_the_columns_are_missing(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError):
        oracle_delays.read_air_delay(tmp_path / "medium.txt")
    assert measure(tmp_path, UDP) == NO_DELAYS
