"""Columns of packets are stored in few bytes, and read as 64-bit integers."""

import numpy as np

from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.packets import NO_ECHO, Packets
from tests.helpers.captures import file_bytes, segment, timed

PACKETS = pcap.parse(file_bytes(timed([segment(index, 100) for index in range(5)])), where="x").packets
BYTES_PER_PACKET = 115
EIGHT_BYTES = {"time_ns", "src", "dst", "tcp_stamp", "content"}
"""Columns that need eight bytes: nanoseconds, halves of addresses, 32-bit values with a special value, and a hash."""
WIDE_TYPES = [np.dtype(kind) for kind in (np.int64, np.uint64, np.bool_)]


def test_a_packet_needs_few_bytes_and_is_read_as_64_bit_integers() -> None:
    bytes_per_packet = sum(column.nbytes for column in vars(PACKETS).values()) / len(PACKETS)
    assert bytes_per_packet < BYTES_PER_PACKET
    assert {name for name, column in vars(PACKETS).items() if column.dtype.itemsize == 8} == EIGHT_BYTES
    for name in vars(PACKETS):
        assert getattr(PACKETS, name).dtype in WIDE_TYPES, name


def test_every_sequence_number_of_an_echo_is_stored() -> None:
    columns = {name: getattr(PACKETS, name) for name in vars(PACKETS)}
    numbers = np.array([NO_ECHO, 0, 1, 2**15, 2**16 - 1])
    assert Packets(**columns | {"echo_seq": numbers}).echo_seq.tolist() == numbers.tolist()


def test_sums_of_columns_do_not_overflow() -> None:
    columns = {name: getattr(PACKETS, name) for name in vars(PACKETS)}
    largest = Packets(**columns | {"tcp_seq": np.full(5, 2**32 - 1), "protocol": np.full(5, 255)})
    assert (largest.tcp_seq + largest.tcp_payload_bytes > 2**32).all()
    assert (largest.protocol + 1 == 256).all()
    assert (largest.where(slice(0, 2)).tcp_seq == 2**32 - 1).all()


def test_concatenated_packets_have_the_rows_of_all_parts() -> None:
    all_packets = Packets.concatenated([PACKETS, PACKETS.where(slice(1, 3))])
    assert all_packets.sport.tolist() == [*PACKETS.sport.tolist(), *PACKETS.sport.tolist()[1:3]]
    assert all_packets.echo.tolist() == [*PACKETS.echo.tolist(), *PACKETS.echo.tolist()[1:3]]
