"""Concurrent transfers between the same robots: each transfer counts its own packets."""

import random
import struct
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Protocol, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.checks import transfer_checks
from fieldkit.measure.transfers import transfer_measures
from fieldkit.measure.transfers.transfer_spec import Transfer
from tests.helpers.captures import RECEIVER, SENDER, Frame, file_bytes, ipv4, transfer

MTU_BYTES = 1480
SECOND_NS = 1_000_000_000


@dataclass
class Flow:
    """A UDP transfer of netcat: datagrams of 8,192 bytes, of which the last is shorter."""

    name: str
    port: int
    size_bytes: int
    first_id: int
    is_reverse: bool = False
    sent_packets: int = 0
    arrived_packets: int = 0
    sent_datagrams: int = 0
    complete_datagrams: int = 0
    received_bytes: bytearray = field(default_factory=bytearray)

    @property
    def content(self) -> bytes:
        return random.Random(self.port).randbytes(self.size_bytes)

    @property
    def transfer(self) -> Transfer:
        base = replace(transfer(Protocol.UDP), port=self.port, sent_file=f"{self.name}.bag", name=self.name)
        base = replace(base, received_file=f"{self.name}.recv.bag")
        if not self.is_reverse:
            return base
        return replace(
            base,
            source=Role.RECEIVER,
            destination=Role.SENDER,
            sender_address=RECEIVER,
            receiver_address=SENDER,
            captures=base.captures[::-1],
        )

    def packets(self) -> Iterator[list[bytes]]:
        """Yield the packets of each datagram."""
        content = self.content
        for number, start in enumerate(range(0, len(content), 8192)):
            payload = content[start : start + 8192]
            datagram = struct.pack(">HHHH", 30_000 + self.port, self.port, len(payload) + 8, 0) + payload
            addresses = {"src": RECEIVER, "dst": SENDER} if self.is_reverse else {}
            offsets = range(0, len(datagram), MTU_BYTES)
            yield [
                ipv4(
                    datagram[offset : offset + MTU_BYTES][:100],
                    protocol=17,
                    size=len(datagram[offset : offset + MTU_BYTES]),
                    ip_id=self.first_id + number,
                    offset=offset,
                    more=offset + MTU_BYTES < len(datagram),
                    **addresses,
                )
                for offset in offsets
            ]


def send_all(folder: Path, flows: list[Flow], random_generator: random.Random, loss: float) -> None:
    """Send datagrams of all flows in random order, and write the captures and received files of both robots."""
    at_sender, at_receiver, now_ns = list[Frame](), list[Frame](), 1_700_000_000 * SECOND_NS
    waiting = [list(flow.packets()) for flow in flows]
    while any(waiting):
        index = random_generator.choice([index for index, remaining in enumerate(waiting) if remaining])
        flow, fragments = flows[index], waiting[index].pop(0)
        start = flow.sent_datagrams * 8192
        lost_flags = [random_generator.random() < loss for _ in fragments]
        for data, is_lost in zip(fragments, lost_flags, strict=True):
            now_ns += 100_000
            (at_receiver if flow.is_reverse else at_sender).append(Frame(now_ns, data, wire_bytes=1500))
            if not is_lost:
                (at_sender if flow.is_reverse else at_receiver).append(
                    Frame(now_ns + 2_000_000, data, wire_bytes=1500)
                )
        flow.sent_packets += len(fragments)
        flow.arrived_packets += len(fragments) - sum(lost_flags)
        flow.sent_datagrams += 1
        flow.complete_datagrams += not any(lost_flags)
        flow.received_bytes += b"" if any(lost_flags) else flow.content[start : start + 8192]
    for flow in flows:
        (folder / f"{flow.name}.bag").write_bytes(flow.content)
        (folder / f"{flow.name}.recv.bag").write_bytes(flow.received_bytes)
    for name, frames in (("sender.pcap", at_sender), ("receiver.pcap", at_receiver)):
        (folder / name).write_bytes(file_bytes(sorted(frames, key=lambda frame: frame.time_ns)))


@pytest.mark.parametrize("loss", [0.0, 0.2])
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32),
    sizes=st.lists(st.integers(1, 25_000), min_size=2, max_size=3),
    id_offset=st.integers(-8, 8),
    is_reverse=st.booleans(),
)
def test_each_transfer_counts_its_own_packets_even_with_equal_ids(
    loss: float, seed: int, sizes: list[int], id_offset: int, is_reverse: bool
) -> None:
    """Each socket counts IP ids from a random start (Linux, ip_select_ident_segs), so ids may be equal."""
    flows = [
        Flow(f"flow{number}", 1234 + number, size, 100 + number * id_offset, is_reverse=is_reverse and number == 1)
        for number, size in enumerate(sizes)
    ]
    with tempfile.TemporaryDirectory() as temporary_folder:
        send_all(Path(temporary_folder), flows, random.Random(seed), loss)
        evidence = AttemptEvidence(Path(temporary_folder))
        for flow in flows:
            assert transfer_measures.incomparability_reason(evidence, flow.transfer) is None
            assert not list(transfer_checks.find_contradictions(evidence, flow.transfer, finished=True))
            values = transfer_measures.measure(evidence, flow.transfer).values
            count_names = ("ip_packets_sent", "ip_packets_received", "datagrams_sent", "datagrams_received")
            assert [values[name] for name in count_names] == [
                flow.sent_packets,
                flow.arrived_packets,
                flow.sent_datagrams,
                flow.complete_datagrams,
            ]
            assert values["file_loss"] == 1 - len(flow.received_bytes) / flow.size_bytes
            assert values["paper_packets"] == flow.sent_datagrams
