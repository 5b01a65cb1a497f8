"""The C++ headers for federates, tested with the frames of the documentation."""

import shutil
import struct
import subprocess
from pathlib import Path

import pytest

from docs.generator.federate_frames import example_frames
from sim_backends.federates.compiling import CompiledProgram, included_files
from sim_backends.federates.frames import HEADER_BYTES, MAX_HELLO_BYTES

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")

SOURCE = Path(__file__).parents[2] / "helpers" / "protocol_vectors.cc"
FRAMES = example_frames()
REQUESTS = ("hello", "advance physics", "advance network")


@pytest.fixture(scope="module", params=["c++17", "c++20"])
def program(request: pytest.FixtureRequest) -> Path:
    flags = ("-O0", f"-std={request.param}", "-Wall", "-Wextra", "-Werror")
    return CompiledProgram("protocol-vectors", SOURCE, (), "apt-get install g++", flags=flags).path()


def answers(program: Path, *requests: bytes) -> bytes:
    process = subprocess.run([program], input=b"".join(requests), stdout=subprocess.PIPE, check=False, timeout=60)
    return process.stdout


def test_answers_equal_the_frames_in_the_documentation(program: Path) -> None:
    requests = [FRAMES[name] for name in (*REQUESTS, "sample links", "ping", "release", "bye", "ping")]
    expected = [FRAMES[name] for name in ("welcome", "states", "outcomes", "links", "pong")]
    assert answers(program, *requests) == b"".join(expected)
    assert answers(program, FRAMES["fork"], FRAMES["ping"]) == FRAMES["busy"] + FRAMES["error"]


def error(program: Path, request: bytes) -> str:
    answer = answers(program, request)
    assert answer[4:6] == b"\x0e\0", answer
    return answer[HEADER_BYTES + 2 :].decode()


def test_a_malformed_frame_is_refused_with_its_position(program: Path) -> None:
    for name in REQUESTS:
        body = FRAMES[name][HEADER_BYTES:]
        for malformed_body in (body[:9], body[:-1], body + b"\0"):
            message = error(
                program, struct.pack("<I", len(malformed_body)) + FRAMES[name][4:HEADER_BYTES] + malformed_body
            )
            position = int(message.removeprefix("byte ").partition(":")[0])
            assert position <= HEADER_BYTES + len(malformed_body)
        assert message.endswith("1 bytes follow the message")
    hello, physics = FRAMES["hello"], FRAMES["advance physics"]
    assert error(program, struct.pack("<I", MAX_HELLO_BYTES + 1) + hello[4:]).startswith("byte 0: a size of 4194305")
    assert error(program, hello[:4] + b"\x63" + hello[5:]) == "byte 4: there is no kind of message 99"
    assert error(program, hello[:6] + b"\1" + hello[7:]) == "byte 6: the reserved field is 1, not 0"
    assert error(program, hello[:24] + b"\2" + hello[25:]).startswith("byte 24: protocol version 2")
    assert error(program, physics[:36] + b"\5" + physics[37:]) == "byte 36: agent 5 was not announced"
    oversized = physics[:32] + b"\xff\xff\xff\xff" + physics[36:]
    assert error(program, oversized).startswith("byte 32: 4294967295 items of at least 8 bytes do not fit")


def test_the_headers_of_a_program_are_part_of_its_name() -> None:
    names = [file.name for file in included_files(SOURCE)]
    assert names[0] == SOURCE.name
    assert sorted(names[1:]) == [
        "bytes.h", "commands.h", "frames.h", "handshake.h", "links.h", "packets.h", "serving.h", "states.h",
    ]  # fmt: skip
