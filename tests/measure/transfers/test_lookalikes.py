"""Packets with equal headers over simulated links: counts are exact, marked as ambiguous, or missing."""

import random
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.transfers import fates, tcp, udp
from fieldkit.measure.transfers.transfer_spec import Transfer
from tests.helpers import links
from tests.helpers.captures import Frame, file_bytes, packets, segment, timed, transfer
from tests.helpers.links import MS, RECEIVER_V6, SENDER_V6, Link, PacketFates
from tests.helpers.measures import measure
from tests.helpers.nightly import examples

shares = st.sampled_from((0.0, 0.02, 0.2))
lossy_links = st.builds(
    Link,
    st.integers(0, 2**32),
    loss=shares,
    copied=shares,
    late=shares,
    jitter_ns=st.sampled_from((0, 20_000, 3 * MS)),
)
same_ids = st.sampled_from((0, None, 5))
names = st.sampled_from(("ids", "0", "v6"))
offload_sizes = st.sampled_from((1, 3, 40))


def _transfer_over(protocol: Protocol, *, ipv6: bool) -> Transfer:
    plain = transfer(protocol)
    return replace(plain, sender_address=SENDER_V6, receiver_address=RECEIVER_V6) if ipv6 else plain


def _udp(
    link: Link, contents: list[bytes], *, ids: list[int | None], step_ns: int = MS
) -> tuple[udp.UdpCounts, PacketFates]:
    """Send datagrams in sequence; return the measured counts and the true fates."""
    sent_frames = [
        Frame(10**18 + number * step_ns, links.udp(content, ip_id=ip_id), 2000)
        for number, (content, ip_id) in enumerate(zip(contents, ids, strict=True))
    ]
    arrivals = link.arrivals([frame.time_ns for frame in sent_frames])
    received_frames = [Frame(time_ns, sent_frames[index].data, 2000) for time_ns, index in arrivals]
    transfer_filter = _transfer_over(Protocol.UDP, ipv6=ids[0] is None)
    counts = udp.count(udp.match_transfer(packets(sent_frames), packets(received_frames), transfer_filter))
    return counts, PacketFates.of(len(sent_frames), [index for _, index in arrivals])


def _fates_of(counts: udp.UdpCounts) -> PacketFates:
    assert counts.packets_reordered is not None
    assert counts.loss_bursts is not None
    n_lost = counts.packets_sent - counts.packets_received
    return PacketFates(n_lost, counts.packets_duplicated, counts.packets_reordered, counts.loss_bursts)


@given(lossy_links, same_ids)
@settings(max_examples=examples(60))
def test_content_distinguishes_packets_with_equal_headers(link: Link, ip_id: int | None) -> None:
    counts, truth = _udp(link, [link.draw.randbytes(40) for _ in range(120)], ids=[ip_id] * 120)
    assert _fates_of(counts) == truth
    assert counts.packets_ambiguous == counts.possible_copies == 0


@given(lossy_links, same_ids)
@settings(max_examples=examples(100))
def test_a_count_without_content_is_correct_or_marked_as_ambiguous(link: Link, ip_id: int | None) -> None:
    counts, truth = _udp(link, [bytes(40)] * 120, ids=[ip_id] * 120)
    assert counts.packets_ambiguous == 120
    assert counts.packets_reordered is None
    if not truth.duplicated:
        assert counts.packets_received == 120 - truth.lost
        assert counts.loss_bursts is None if truth.lost else counts.loss_bursts == 0
    else:
        assert counts.possible_copies, "a copy is close to the original, or so late that any packet may be a copy"


def test_as_many_copies_as_losses_do_not_hide_the_losses() -> None:
    """6 % are lost and 6 % copied, all with id 0 and equal bytes; the number of arrivals would hide both."""
    counts, truth = _udp(Link(3, loss=0.06, copied=0.06, jitter_ns=30_000), [bytes(100)] * 500, ids=[0] * 500)
    assert (truth.lost, truth.duplicated) == (33, 29)
    assert (counts.packets_ambiguous, counts.possible_copies) == (500, 496)


def test_a_late_copy_does_not_hide_a_loss() -> None:
    """Ten equal packets 1 ms apart; the sixth is lost, and a copy of the third arrives 2.4 ms after it."""
    sent_frames = [Frame(10**18 + number * MS, links.udp(bytes(40), ip_id=0)) for number in range(10)]
    late_ns = [*(number * MS for number in range(10) if number != 5), 2 * MS + 2_400_000]
    received_frames = [Frame(10**18 + 7 * MS + number, sent_frames[0].data) for number in sorted(late_ns)]
    counts = udp.count(udp.match_transfer(packets(sent_frames), packets(received_frames), transfer(Protocol.UDP)))
    assert (counts.packets_ambiguous, counts.possible_copies) == (10, 10)


def test_the_arrival_of_a_single_repeated_segment_is_ambiguous() -> None:
    """The segment is sent twice, 210 ms apart, without time stamps or other packets that give the clock offset."""
    syn, data = segment(0, 0, flags=2), segment(1, 700)
    sent_frames = [Frame(10**18 + time_ms * MS, packet) for time_ms, packet in ((0, syn), (10, data), (220, data))]
    received_frames = [Frame(10**18 + time_ms * MS, packet) for time_ms, packet in ((3, syn), (223, data))]
    counts = tcp.count(tcp.match_transfer(packets(sent_frames), packets(received_frames), transfer(Protocol.TCP)))
    assert (counts.ambiguous_frames, counts.possible_copies, counts.received_bytes) == (2, 0, 700)
    assert counts.spurious_frames is counts.reordered_frames is None


def test_arrivals_of_joined_segments_repeated_immediately_are_ambiguous() -> None:
    """A frame of three segments is sent again 1 ms later. A router splits both frames."""
    syn = segment(0, 0, flags=2, ip_id=9, mss=700)
    sent_frames = timed([syn, segment(1, 2100, ip_id=10), segment(1, 2100, ip_id=13)])
    split_segments = [segment(1 + 700 * (number % 3), 700, ip_id=10 + number) for number in range(6)]
    counts = tcp.count(
        tcp.match_transfer(packets(sent_frames), packets(timed([syn, *split_segments])), transfer(Protocol.TCP))
    )
    assert (counts.ambiguous_frames, counts.lost_bytes, counts.received_bytes) == (2, 0, 4200)
    assert counts.spurious_frames is counts.reordered_frames is None


def test_a_repeat_has_no_loss_if_copies_may_hide_losses(tmp_path: Path) -> None:
    """33 of 500 equal packets are lost and 29 copied: sent packets are counted, but arrivals are not."""
    link = Link(3, loss=0.06, copied=0.06, jitter_ns=30_000)
    sent_frames = [Frame(10**18 + time * MS, links.udp(bytes(100), ip_id=0), 128) for time in range(500)]
    arrivals = link.arrivals([frame.time_ns for frame in sent_frames])
    (tmp_path / "sender.pcap").write_bytes(file_bytes(sent_frames))
    (tmp_path / "receiver.pcap").write_bytes(
        file_bytes(Frame(time, sent_frames[index].data, 128) for time, index in arrivals)
    )
    measures = measure(tmp_path, transfer(Protocol.UDP))
    assert (measures.ip_packets_sent, measures.ip_packets_doubtful, measures.datagrams_sent) == (500, 500, 500)
    assert measures.one_way_withheld == "the packets of the transfer cannot be distinguished"
    present = {name for name in measures if name.startswith(("ip_", "datagram", "byte_"))}
    assert present == {"ip_packets_sent", "ip_packets_doubtful", "datagrams_sent"}
    assert fates.read(AttemptEvidence(tmp_path), transfer(Protocol.UDP)) is None


@pytest.mark.parametrize("has_content", [True, False])
def test_ids_that_repeat_after_65536_datagrams_are_matched_correctly(has_content: bool) -> None:
    """Packets around the wrap of the ids are lost and copied, and others are lost or reordered."""
    count, draw = 70_000, random.Random(5)
    contents = [draw.randbytes(32) if has_content else bytes(32) for _ in range(count)]
    sent_frames = [
        Frame(10**18 + number * 20_000, links.udp(content, ip_id=number % 65_536), 2000)
        for number, content in enumerate(contents)
    ]
    times_ns = [frame.time_ns + 5 * 10**9 + draw.randint(MS, MS + 30_000) for frame in sent_frames]
    lost_indices, copied = {100, 65_536 + 200, *range(30_000, 30_010)}, [65_536 + 100, 200]
    arrived_indices = [number for number in range(count) if number not in lost_indices]
    arrivals = sorted(
        [(times_ns[index], index) for index in arrived_indices]
        + [(times_ns[index] + 10_000, index) for index in copied]
    )
    received_frames = [Frame(time_ns, sent_frames[index].data, 2000) for time_ns, index in arrivals]
    counts = udp.count(
        udp.match_transfer(packets(sent_frames), packets(received_frames), _transfer_over(Protocol.UDP, ipv6=False))
    )
    truth = PacketFates.of(count, [index for _, index in arrivals])
    assert _fates_of(counts) == truth
    assert (truth.lost, truth.duplicated, truth.bursts) == (12, 2, 3)
    assert counts.packets_ambiguous == counts.possible_copies == 0


def _assert_unambiguous_counts(counts: tcp.TcpCounts, truth: links.TcpTruth) -> None:
    assert (counts.sent_bytes, counts.retransmitted_frames) == (truth.sent_bytes, truth.retransmitted)
    assert (counts.duplicated_bytes, counts.lost_bytes) == (truth.duplicated_bytes, 0)


@given(lossy_links, offload_sizes, shares, names)
@settings(max_examples=examples(100))
def test_time_stamps_identify_retransmissions_with_any_offload(
    link: Link, offload: int, retransmission_share: float, name: str
) -> None:
    ipv6 = name == "v6"
    truth = links.tcp(link, 100, ids=name == "ids", ipv6=ipv6, offload=offload, again=retransmission_share)
    counts = tcp.count(
        tcp.match_transfer(packets(truth.sender), packets(truth.receiver), _transfer_over(Protocol.TCP, ipv6=ipv6))
    )
    _assert_unambiguous_counts(counts, truth)
    assert counts.received_bytes == truth.received_bytes
    assert (counts.spurious_frames, counts.reordered_frames) == (truth.spurious, truth.reordered)
    assert counts.ambiguous_frames == 0


@given(lossy_links, offload_sizes, shares, names)
@settings(max_examples=examples(100))
def test_order_without_time_stamps_is_correct_or_missing(
    link: Link, offload: int, retransmission_share: float, name: str
) -> None:
    ipv6 = name == "v6"
    truth = links.tcp(
        link, 100, ids=name == "ids", ipv6=ipv6, offload=offload, again=retransmission_share, stamped=False
    )
    counts = tcp.count(
        tcp.match_transfer(packets(truth.sender), packets(truth.receiver), _transfer_over(Protocol.TCP, ipv6=ipv6))
    )
    _assert_unambiguous_counts(counts, truth)
    if counts.received_bytes != truth.received_bytes:
        assert counts.ambiguous_frames
        assert counts.possible_copies
    if counts.ambiguous_frames:
        assert counts.spurious_frames is counts.reordered_frames is None
        assert truth.retransmitted
        assert name != "ids" or offload > 1
    else:
        assert counts.received_bytes == truth.received_bytes
        assert (counts.spurious_frames, counts.reordered_frames) == (truth.spurious, truth.reordered)


def test_content_truncated_in_one_capture_is_not_used() -> None:
    """The snap length includes content or time stamps at one end only."""
    link = Link(8, loss=0.1, copied=0.1)
    sent_frames = [Frame(10**18 + time * MS, links.udp(link.draw.randbytes(40), ip_id=0), 68) for time in range(200)]
    arrivals = link.arrivals([frame.time_ns for frame in sent_frames])
    received_frames = [Frame(time, sent_frames[index].data[:58], 68) for time, index in arrivals]
    counts = udp.count(
        udp.match_transfer(packets(sent_frames), packets(received_frames), _transfer_over(Protocol.UDP, ipv6=False))
    )
    assert (counts.packets_sent, counts.packets_ambiguous) == (200, 200)
    assert counts.possible_copies
    truth = links.tcp(Link(8, loss=0.1), 100, ids=False, again=0.2)
    truncated_frames = [Frame(frame.time_ns, frame.data[:44], frame.wire_bytes) for frame in truth.receiver]
    short_counts = tcp.count(
        tcp.match_transfer(packets(truth.sender), packets(truncated_frames), _transfer_over(Protocol.TCP, ipv6=False))
    )
    _assert_unambiguous_counts(short_counts, truth)
    assert short_counts.ambiguous_frames
    assert short_counts.spurious_frames is short_counts.reordered_frames is None


@pytest.mark.parametrize("protocol", Protocol)
def test_captures_of_different_link_types_match(protocol: Protocol) -> None:
    """One end has VLAN tags, the other cooked frames; padding after short packets is not content."""
    if protocol is Protocol.UDP:
        link = Link(2, loss=0.1, copied=0.1, late=0.1)
        sent_frames = [Frame(10**18 + time * MS, links.udp(link.draw.randbytes(5), ip_id=0)) for time in range(200)]
        received_frames = [
            Frame(time, sent_frames[index].data)
            for time, index in link.arrivals([frame.time_ns for frame in sent_frames])
        ]
    else:
        truth = links.tcp(Link(2, loss=0.1, copied=0.1, late=0.1), 100, ids=False, again=0.1)
        sent_frames, received_frames = truth.sender, truth.receiver
    vlan, cooked = bytes(12) + b"\x81\x00\x00\x07\x08\x00", bytes(14) + b"\x08\x00"
    vlan_frames = [
        Frame(frame.time_ns, vlan + frame.data + bytes(20), frame.wire_bytes and frame.wire_bytes + 18)
        for frame in sent_frames
    ]
    cooked_frames = [
        Frame(frame.time_ns, cooked + frame.data, frame.wire_bytes and frame.wire_bytes + 16)
        for frame in received_frames
    ]
    plain = packets(sent_frames), packets(received_frames)
    framed = (
        pcap.parse(file_bytes(vlan_frames, link_type=1), where="test").packets,
        pcap.parse(file_bytes(cooked_frames, link_type=113), where="test").packets,
    )
    transfer_filter = _transfer_over(protocol, ipv6=False)
    if protocol is Protocol.UDP:
        assert udp.count(udp.match_transfer(*framed, transfer_filter)) == udp.count(
            udp.match_transfer(*plain, transfer_filter)
        )
    else:
        assert tcp.count(tcp.match_transfer(*framed, transfer_filter)) == tcp.count(
            tcp.match_transfer(*plain, transfer_filter)
        )
