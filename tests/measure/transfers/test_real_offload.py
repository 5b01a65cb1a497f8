"""A real transfer through a router, with segmentation offload at the sender and without it at the receiver."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from fieldkit.core.model import Protocol, Role
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import tcp
from fieldkit.measure.transfers.match import match
from fieldkit.measure.transfers.transfer_spec import Transfer

pytestmark = pytest.mark.emulated

FILE_BYTES = 1_000_000
TRANSFER = Transfer(Protocol.TCP, Role.SENDER, Role.RECEIVER, "10.7.0.1", "10.8.0.1", 1234, "scan.bag", "recv.bag")

# Named namespaces are mounts below /run; in a separate mount namespace they are invisible to the host.
IN_NAMESPACES = """
set -e
mount -t tmpfs tmpfs /run
for name in sender router receiver; do ip netns add $name; done
ip -n sender link add out type veth peer name in netns router
ip -n router link add out type veth peer name in netns receiver
ip -n sender address add 10.7.0.1/24 dev out
ip -n router address add 10.7.0.2/24 dev in
ip -n router address add 10.8.0.2/24 dev out
ip -n receiver address add 10.8.0.1/24 dev in
# The router forwards single segments.
ip -n router link set out gso_max_segs 1
for link in sender:out router:in router:out receiver:in; do ip -n ${link%:*} link set ${link#*:} up; done
ip -n sender route add default via 10.7.0.2
ip -n receiver route add default via 10.8.0.2
ip netns exec router sh -c 'echo 1 >/proc/sys/net/ipv4/ip_forward'
for end in sender:out receiver:in; do
    name=${end%:*}
    ip netns exec $name tcpdump -i ${end#*:} --immediate-mode -U -s 128 -w $name.pcap port 1234 2>$name.log &
    until grep -qs 'listening on' $name.log; do sleep 0.01; done
done
ip netns exec receiver nc.traditional -l -p 1234 >received </dev/null & listener=$!
until ip netns exec receiver grep -q ':04D2 00000000:0000 0A' /proc/net/tcp; do sleep 0.01; done
ip netns exec sender nc.traditional -q 0 10.8.0.1 1234 <sent
wait $listener
last='src 10.7.0.1 and tcp[tcpflags] & tcp-fin != 0'
ip netns exec sender nstat -asz TcpRetransSegs >sent.nstat
ip netns exec receiver nstat -asz TcpExtTCPOFOQueue >received.nstat
for name in sender receiver; do
    until tcpdump -n -r $name.pcap "$last" 2>/dev/null | grep -q .; do sleep 0.01; done
done
"""


def test_offload_at_one_end_does_not_change_counts(tmp_path: Path) -> None:
    (tmp_path / "sent").write_bytes(bytes(range(250)) * (FILE_BYTES // 250))
    sandbox_command = (
        "unshare",
        "--mount",
        "--propagation",
        "private",
        "--pid",
        "--fork",
        "--kill-child",
        "--mount-proc",
    )
    subprocess.run((*sandbox_command, "sh", "-c", IN_NAMESPACES), cwd=tmp_path, check=True, timeout=60)
    assert (tmp_path / "received").read_bytes() == (tmp_path / "sent").read_bytes()
    sender, receiver = (pcap.read(tmp_path / f"{name}.pcap").packets for name in ("sender", "receiver"))
    max_sent_payload, max_received_payload = (int(packets.tcp_payload_bytes.max()) for packets in (sender, receiver))
    assert max_sent_payload > 2 * 1460 >= 2 * max_received_payload > 0

    counts = tcp.count(tcp.match_transfer(sender, receiver, TRANSFER))

    # Veth with several cores sometimes reorders packets, and TCP then retransmits, as counted by the kernel.
    kernel_retransmissions, kernel_out_of_order = (
        counter_value(tmp_path / "sent.nstat"),
        counter_value(tmp_path / "received.nstat"),
    )
    assert (counts.unique_bytes, counts.lost_bytes) == (FILE_BYTES, 0)
    assert counts.sent_bytes == counts.received_bytes
    assert (counts.retransmitted_frames > 0) == (counts.sent_bytes > FILE_BYTES) == (kernel_retransmissions > 0)
    assert counts.sent_bytes - FILE_BYTES <= kernel_retransmissions * max_received_payload
    assert counts.superframes == int((sender.tcp_payload_bytes > 1460).sum()) > 0
    sent_packets = TRANSFER.forward(sender)
    matches = match(sent_packets, TRANSFER.forward(receiver))
    assert matches.arrived.all()
    assert not matches.duplicates.any()
    # Joined segments that TCP retransmits within one millisecond have equal time stamps, and the router splits both.
    assert set(np.flatnonzero(matches.ambiguous)) <= frames_with_repeated_bytes(sent_packets)
    assert (counts.ambiguous_frames > 0) == matches.ambiguous.any()
    if counts.ambiguous_frames:
        assert counts.spurious_frames is counts.reordered_frames is None
    else:
        assert counts.spurious_frames == counts.retransmitted_frames
        assert counts.reordered_frames is not None
        assert (counts.reordered_frames > 0) >= (kernel_out_of_order > 0)


def frames_with_repeated_bytes(sent_packets: Packets) -> set[int]:
    """Return the frames that share a byte with another frame of the same time stamp."""
    payload_frames = np.flatnonzero(sent_packets.tcp_payload_bytes)
    first, stamp = sent_packets.tcp_seq[payload_frames], sent_packets.tcp_stamp[payload_frames]
    end = first + sent_packets.tcp_payload_bytes[payload_frames]
    overlaps = (stamp == stamp[:, None]) & (first < end[:, None]) & (first[:, None] < end)
    return set(payload_frames[overlaps.sum(axis=1) > 1])


def counter_value(table: Path) -> int:
    """Return the single counter in a table of nstat."""
    return int(table.read_text().splitlines()[-1].split()[1])
