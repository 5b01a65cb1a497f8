"""The test vectors of federates: they equal the encoded frames, and a decoder written by hand reads their values."""

import hashlib
import math
import re
import struct
from dataclasses import replace
from typing import Any

import pytest

from docs.generator.federate_frames import DRONE, HELLO, LINKS, START, WELCOME, WITHOUT_VECTOR, agents, example_frames
from sim_backends.federates import exchanges
from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.exchanges import AdvanceNetwork, NetworkOutcomes
from sim_backends.federates.frames import HEADER_BYTES, MessageKind, read_header
from sim_backends.federates.handshake import Hello, Welcome, decode_join
from sim_backends.federates.link_records import decode_links
from tests.helpers.paths import ROOT

PAGE = (ROOT / "docs" / "reference" / "federate-vectors.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| ([a-z ]+) \| `([0-9a-f]+)` \|$", PAGE, re.MULTILINE)
VECTORS = {name: bytes.fromhex(text) for name, text in ROWS}
UGV = (0, 0, 1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.25)


class ManualFrameReader:
    """A reader of frames by the tables of the documentation, without the code under test."""

    def __init__(self, frame: bytes) -> None:
        size, self.kind, reserved, self.request, self.copy = struct.unpack("<IHHII", frame[:16])
        self.remaining = frame[16:]
        assert (len(self.remaining), reserved) == (size, 0)

    def unpack_values(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(f"<{layout}")
        values, self.remaining = struct.unpack(f"<{layout}", self.remaining[:size]), self.remaining[size:]
        return values

    def text(self) -> str:
        (length,) = self.unpack_values("H")
        text, self.remaining = self.remaining[:length], self.remaining[length:]
        return text.decode()


def test_the_documentation_has_a_vector_of_each_layout() -> None:
    frames = example_frames()
    assert len(frames) == len(MessageKind)
    assert {name: frame for name, frame in frames.items() if name not in WITHOUT_VECTOR} == VECTORS


def test_the_handshake_is_read_by_hand() -> None:
    join = ManualFrameReader(VECTORS["join"])
    assert (join.kind, join.unpack_values("8sH"), join.text(), join.remaining) == (1, (b"FIELDKIT", 1), "s3cret", b"")
    hello = ManualFrameReader(VECTORS["hello"])
    assert (hello.kind, hello.request) == (2, 3)
    assert hello.unpack_values("8sHBBIQqq") == (b"FIELDKIT", 1, 1, 0, 1000, 7, 1_000_000, 2_000_000_000)
    assert hello.unpack_values("32s") == (hashlib.sha256(b"{}").digest(),)
    assert (hello.text(), hello.text(), hello.unpack_values("I")) == ("s3cret", "demo", (1,))
    assert (hello.text(), hello.text(), hello.unpack_values("Bd")) == ("ugv", "husky", (0, 0.5))
    assert hello.unpack_values("IIddddddd d") == (*UGV, 3.0)
    assert (hello.unpack_values("I"), hello.remaining) == ((2,), b"{}")
    welcome = ManualFrameReader(VECTORS["welcome"])
    assert welcome.kind == 3
    assert welcome.unpack_values("HBBIqq") == (1, 1, 0, 1 + 16, 1_000_000, -1)
    assert welcome.unpack_values("32s") == (hashlib.sha256(b"{}").digest(),)
    assert (welcome.text(), welcome.text()) == ("carts", "carts 1.0")
    assert (welcome.unpack_values("HHH"), welcome.unpack_values("H"), welcome.unpack_values("II")) == (
        (2, 1, 2),
        (0,),
        (0, 0),
    )
    assert not welcome.remaining


def test_requests_and_answers_are_read_by_hand() -> None:
    request = ManualFrameReader(VECTORS["advance physics"])
    assert (request.kind, request.unpack_values("qqI")) == (4, (11_100_000, 10_000_000, 2))
    assert request.unpack_values("IHHdd") == (0, 1, 16, 0.5, -0.125)
    *velocity, yaw_rad = request.unpack_values("IHHdddd")
    assert (velocity, math.isnan(yaw_rad), request.remaining) == ([1, 2, 32, 1.0, 0.0, 0.25], True, b"")
    states = ManualFrameReader(VECTORS["states"])
    assert (states.kind, states.unpack_values("qII"), states.text()) == (5, (11_000_000, 1, 1), "uav")
    assert (states.unpack_values("I"), states.unpack_values("II8d")) == ((2,), (*UGV, 3.0))
    *drone, heading_rad, limit_m_s2 = states.unpack_values("II8d")
    assert drone == [1, 0, -1.5, 0.0, 10.0, 0.0, 0.5, -0.25]
    assert (math.isnan(heading_rad), limit_m_s2, states.remaining) == (True, math.inf, b"")
    network = ManualFrameReader(VECTORS["advance network"])
    assert (network.kind, network.unpack_values("qqqII")) == (6, (11_099_999, 10_000_000, 1_000_000, 0, 1))
    assert (network.unpack_values("II8d"), network.unpack_values("I")) == ((*UGV, math.inf), (1,))
    assert network.unpack_values("QqQqqII") == (9, 4, 300, 10_000_000, 10_500_000, 0, 1)
    assert (network.text(), network.text(), network.remaining) == ("pose", "udp", b"")
    outcomes = ManualFrameReader(VECTORS["outcomes"])
    assert (outcomes.kind, outcomes.unpack_values("qqI")) == (7, (11_099_999, 12_000_000, 1))
    assert (outcomes.unpack_values("QqII"), outcomes.unpack_values("IQ")) == ((9, 11_000_250, 1, 0), (1, 8))
    assert (outcomes.text(), outcomes.unpack_values("3q"), outcomes.remaining) == (
        "out of range",
        (100_000, 350_000, 33),
        b"",
    )
    links = ManualFrameReader(VECTORS["links"])
    assert (links.kind, links.unpack_values("IIIdqq")) == (17, (1, 0, 0, -95.0, 11_099_999, 2_000_000))
    *link, rx_rate_bit_s = links.unpack_values("IIIdd d")
    assert (link, math.isnan(rx_rate_bit_s)) == ([1, 0, 1, -61.5, 54e6], True)
    assert (links.unpack_values("4Q"), links.remaining) == ((12, 11, 3, 1), b"")


def test_short_messages_are_read_by_hand() -> None:
    for name, kind, number in (("ping", 8, 42), ("pong", 9, 42), ("busy", 10, 10_000_000)):
        frame = ManualFrameReader(example_frames()[name])
        assert (frame.kind, frame.unpack_values("Q"), frame.remaining) == (kind, (number,), b"")
    fork = ManualFrameReader(VECTORS["fork"])
    assert (fork.kind, fork.unpack_values("I"), fork.remaining) == (11, (2,), b"")
    for name, kind, copy in (("done", 12, 0), ("release", 13, 2), ("bye", 15, 0)):
        frame = ManualFrameReader(example_frames()[name])
        assert (frame.kind, frame.copy, frame.remaining) == (kind, copy, b"")
    error = ManualFrameReader(VECTORS["error"])
    assert (error.kind, error.text(), error.remaining) == (14, "ValueError: no wheels", b"")


def body(name: str) -> bytes:
    frame = VECTORS[name]
    assert read_header(frame).size == len(frame) - HEADER_BYTES
    return frame[HEADER_BYTES:]


def test_the_decoder_of_fieldkit_reads_the_vectors() -> None:
    assert decode_join(body("join")) == "s3cret"
    assert Hello.decode(body("hello")) == HELLO
    assert Welcome.decode(body("welcome")) == replace(
        WELCOME, commands=[1, 2], transports=[], transmitters=[], emitters_m=[]
    )
    to_ns, from_ns, commands = exchanges.decode_advance_physics(body("advance physics"), agents())
    assert (to_ns, from_ns, set(commands)) == (11_100_000, 10_000_000, {"ugv", "uav"})
    table = AgentTable(["ugv"])
    at_ns, states = exchanges.decode_states(body("states"), table)
    assert (at_ns, dict(states), states.limits_m_s2) == (
        11_000_000,
        {"ugv": START, "uav": DRONE},
        {"ugv": 3.0, "uav": math.inf},
    )
    assert table.names == ["ugv", "uav"]
    network = AdvanceNetwork.decode(body("advance network"), agents())
    assert network.encode(agents()) == body("advance network")
    outcomes = NetworkOutcomes.decode(body("outcomes"), agents())
    assert outcomes.encode(agents()) == body("outcomes")
    assert outcomes.delays == [(100_000, 350_000, 33)]
    assert decode_links(body("links"), agents(), 0) == LINKS
    assert exchanges.decode_text(body("error")) == "ValueError: no wheels"


@pytest.mark.parametrize("name", sorted(VECTORS))
def test_the_header_has_the_size_of_the_body(name: str) -> None:
    assert read_header(VECTORS[name]).kind is MessageKind[name.upper().replace(" ", "_")]
    assert body(name) == VECTORS[name][16:]
