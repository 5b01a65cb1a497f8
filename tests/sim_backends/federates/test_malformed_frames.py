"""Malformed frames raise an error with the position of the wrong byte, and cause no large allocation."""

import random
import struct
import tracemalloc
from contextlib import suppress

import pytest

from docs.generator.federate_frames import agents, example_frames
from sim_backends.federates import exchanges
from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.frames import (
    HEADER_BYTES,
    MAX_AGENTS,
    MAX_FRAME_BYTES,
    FrameReader,
    MalformedFrameError,
    MessageKind,
    encode,
    read_header,
    text_bytes,
)
from tests.helpers.federate_decoders import DECODERS

BODIES = {name: frame[HEADER_BYTES:] for name, frame in example_frames().items() if name in DECODERS}


@pytest.mark.parametrize("name", sorted(DECODERS))
def test_each_cut_frame_is_refused_with_its_position(name: str) -> None:
    complete_lengths = {len(BODIES["outcomes"]) - 24} if name == "outcomes" else set()  # delay parts are optional
    for length in set(range(len(BODIES[name]))) - complete_lengths:
        with pytest.raises(MalformedFrameError, match=r"^byte \d+: ") as error_info:
            DECODERS[name](BODIES[name][:length])
        assert 0 <= error_info.value.position <= HEADER_BYTES + length
    with pytest.raises(MalformedFrameError, match=r"^byte \d+: "):
        DECODERS[name](BODIES[name] + b"\0")


@pytest.mark.parametrize("name", sorted(DECODERS))
def test_mutated_frames_raise_no_other_error_and_allocate_little_memory(name: str) -> None:
    rng = random.Random(name)
    tracemalloc.start()
    try:
        for _ in range(400):
            body = bytearray(BODIES[name])
            for _ in range(rng.randint(1, 6)):
                body[rng.randrange(len(body))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            with suppress(MalformedFrameError):
                DECODERS[name](bytes(body))
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((MAX_FRAME_BYTES + 1, 5, 0, 1, 0), "byte 0: a size of 16777217 bytes is above 16777216"),
        ((0, 99, 0, 1, 0), "byte 4: there is no kind of message 99"),
        ((0, 5, 7, 1, 0), "byte 6: the reserved field is 7, not 0"),
    ],
)
def test_a_wrong_header_is_refused(fields: tuple[int, ...], message: str) -> None:
    with pytest.raises(MalformedFrameError) as error_info:
        read_header(struct.pack("<IHHII", *fields))
    assert str(error_info.value) == message


@pytest.mark.parametrize(
    ("name", "position", "wrong_bytes", "message"),
    [
        ("hello", 0, b"HTTP/1.1", "byte 16: this is not fieldkit's protocol for federates"),
        ("hello", 8, b"\2\0", "byte 24: protocol version 2; this program supports 1"),
        ("hello", 10, b"\3", "byte 26: there is no role 3"),
        ("welcome", 0, b"\2\0", "byte 16: protocol version 2; this program supports 1"),
        ("welcome", 8, bytes(8), "byte 18: role 1 with a step of 0 ns is invalid"),
        ("states", 8, b"\xff\xff\xff\xff", "byte 24: 4294967295 items of at least 6 bytes do not fit"),
        ("states", 12, b"\x09", "byte 28: the new agent has index 9, not 2"),
        ("advance physics", 20, b"\x05", "byte 36: agent 5 was not announced"),
        ("advance physics", 24, b"\x09", "byte 40: a command of type 9 and 16 bytes is not supported"),
        ("error", 0, b"\xff\xff", "byte 16: a text of 65535 bytes is longer than 1000"),
        ("error", 2, b"\xff", "byte 18: the text is not UTF-8"),
    ],
)
def test_an_error_states_the_position_of_the_wrong_byte(
    name: str, position: int, wrong_bytes: bytes, message: str
) -> None:
    body = bytearray(BODIES[name])
    body[position : position + len(wrong_bytes)] = wrong_bytes
    with pytest.raises(MalformedFrameError) as error_info:
        DECODERS[name](bytes(body))
    assert str(error_info.value).startswith(message)


def test_an_agent_above_the_limit_is_refused() -> None:
    table = AgentTable(f"agent {number}" for number in range(MAX_AGENTS))
    body = exchanges.encode_number(0) + struct.pack("<II", 1, MAX_AGENTS) + text_bytes("new") + struct.pack("<I", 0)
    with pytest.raises(MalformedFrameError, match="byte 28: there are more than 10000 agents"):
        exchanges.decode_states(body, table)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e308])
def test_a_position_that_is_not_finite_is_refused(value: float) -> None:
    body = exchanges.encode_number(0) + struct.pack("<II", 0, 1)
    body += struct.pack("<II8d", 0, 0, value, value, 0, 0, 0, 0, 0, 0)
    with pytest.raises(MalformedFrameError, match="byte 32: the state of agent 0 is invalid"):
        exchanges.decode_states(body, agents())


def test_two_states_of_one_agent_are_refused() -> None:
    state = struct.pack("<II8d", 1, 0, *[0.0] * 8)
    with pytest.raises(MalformedFrameError, match="byte 104: agent uav has two states"):
        exchanges.decode_states(exchanges.encode_number(0) + struct.pack("<II", 0, 2) + 2 * state, agents())


def test_frames_and_texts_of_fieldkit_have_a_maximum_size() -> None:
    with pytest.raises(ValueError, match="longer than"):
        encode(MessageKind.STATES, 1, 0, bytes(17 << 20))
    with pytest.raises(ValueError, match="a text of 1001 bytes is longer than 1000"):
        text_bytes("x" * 1001)
    assert FrameReader(text_bytes("ä\ud800")).text() == "ä?"
