"""Packets that arrived over several links: their count in captures on all interfaces, and its cross-checks."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.headers import COOKED_V2
from fieldkit.measure.checks import ping_duplicates
from fieldkit.measure.checks.ping_duplicates import PingEchoes
from fieldkit.measure.evidence.ping import Ping, Reply
from tests.helpers.captures import RECEIVER, SENDER, Frame, file_bytes, ipv4

WIFI, CELL = 3, 7
START_NS = 1_700_000_000_000_000_000
INTERVAL_S = 0.5
PAYLOAD_BYTES = 56
IDENTIFIER = 0xFFFF
REQUEST, REPLY = 8, 0


@dataclass(frozen=True)
class Echo:
    """An echo that one robot captured."""

    kind: int
    seq: int
    interface: int
    at_ns: int = 0

    def frame(self, *, more: bool = False) -> Frame:
        source, destination = (SENDER, RECEIVER) if self.kind == REQUEST else (RECEIVER, SENDER)
        message = struct.pack(">BBHHH", self.kind, 0, 0, IDENTIFIER, self.seq) + bytes(PAYLOAD_BYTES)
        packet = ipv4(message, protocol=1, src=source, dst=destination, more=more)
        cooked = struct.pack(">HHIHBB8s", 0x0800, 0, self.interface, 1, 0, 6, bytes(8))
        return Frame(START_NS + round(1e9 * INTERVAL_S) * self.seq + self.at_ns, cooked + packet)


def capture_echoes(*echoes: Echo, more: bool = False) -> PingEchoes:
    """Return the echoes in a capture on all interfaces."""
    frames = [echo.frame(more=more) for echo in echoes]
    return echoes_of(pcap.parse(file_bytes(frames, link_type=COOKED_V2), where="x"))


def echoes_of(capture: pcap.Capture) -> PingEchoes:
    echoes = ping_duplicates.captured_echoes(capture, SENDER, RECEIVER, PAYLOAD_BYTES + 8)
    assert echoes is not None
    return echoes


def ping_output(*replies: tuple[int, bool]) -> Ping:
    lines = tuple(Reply(seq, 0.01, None, duplicate, damaged=False) for seq, duplicate in replies)
    return Ping(PAYLOAD_BYTES, lines, (), 10, len({seq for seq, _ in replies}), ())


def exchange(seqs: Sequence[int]) -> list[Echo]:
    return [Echo(kind, seq, WIFI, kind == REPLY) for seq in seqs for kind in (REQUEST, REPLY)]


@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from([WIFI, CELL, 1 << 20])), max_size=30))
def test_each_further_interface_of_a_packet_is_a_copy(arrivals: list[tuple[int, int]]) -> None:
    requests = capture_echoes(*(Echo(REQUEST, seq, interface) for seq, interface in arrivals)).requests
    interfaces: dict[int, set[int]] = {}
    for seq, interface in arrivals:
        interfaces.setdefault(seq, set()).add(interface)
    assert requests.interface.tolist() == [interface for _, interface in arrivals]
    assert ping_duplicates.count_copies(requests) == sum(len(links) - 1 for links in interfaces.values())


def test_copies_of_received_requests_and_replies_are_added() -> None:
    receiver = capture_echoes(*exchange([1, 2]), Echo(REQUEST, 2, CELL), Echo(REQUEST, 1, WIFI), Echo(REPLY, 1, CELL))
    sender = capture_echoes(*exchange([1, 2]), Echo(REPLY, 2, CELL), Echo(REPLY, 1, CELL), Echo(REQUEST, 1, CELL))
    assert dict(ping_duplicates.measure(sender, receiver).values) == {"rtt_duplicates": 1 + 2}


def test_captures_without_interfaces_or_with_fragments_give_no_number() -> None:
    complete_capture = capture_echoes(*exchange([1]))
    frames_without_interfaces = [
        Frame(frame.time_ns, frame.data[20:]) for frame in (echo.frame() for echo in exchange([1]))
    ]
    for sender, receiver, reason in (
        (None, complete_capture, "no complete capture"),
        (complete_capture, None, "no complete capture"),
        (
            echoes_of(pcap.parse(file_bytes(frames_without_interfaces), where="x")),
            complete_capture,
            "does not contain the interface of each packet",
        ),
        (complete_capture, capture_echoes(Echo(REQUEST, 1, WIFI), more=True), "fragmented"),
    ):
        measures = ping_duplicates.measure(sender, receiver)
        assert not measures.values
        assert reason in measures.missing["rtt_duplicates"]
    assert ping_duplicates.captured_echoes(None, SENDER, RECEIVER, PAYLOAD_BYTES + 8) is None


@pytest.mark.parametrize(
    ("copies", "lines", "answers", "reasons"),
    [
        ([], [(1, False), (2, False)], [], []),
        ([Echo(REPLY, 1, CELL)], [(1, False), (1, True), (2, False)], [], []),
        ([Echo(REPLY, 1, CELL)], [(1, False), (2, False)], [], ["1 duplicate of replies that ping did not print"]),
        ([Echo(REPLY, 2, CELL, 500_000_000)], [(1, False), (2, False)], [], []),  # after the end of ping
        ([], [(1, False), (2, False)], [Echo(REPLY, 2, CELL)], ["1 answer to requests that it does not contain"]),
        ([], [(1, False), (2, False)], [Echo(REQUEST, 2, CELL), Echo(REPLY, 2, CELL)], []),
    ],
)
def test_copies_are_compared_with_the_output_of_ping_and_with_the_answers(
    copies: list[Echo], lines: list[tuple[int, bool]], answers: list[Echo], reasons: list[str]
) -> None:
    sender, receiver = capture_echoes(*exchange([1, 2]), *copies), capture_echoes(*exchange([1, 2]), *answers)
    problems = list(ping_duplicates.contradictions(ping_output(*lines), INTERVAL_S, sender, receiver))
    assert len(problems) == len(reasons)
    assert all(reason in problem for reason, problem in zip(reasons, problems, strict=True))
