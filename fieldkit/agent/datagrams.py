"""Test datagrams between robots: multicast, unicast, and unicast in fragments. Receivers count them.

The test datagrams are sent to the multicast group and the ports of a DDS domain (RTPS 2.5, section 9.6.2).
Participants of the domain ignore them, because the datagrams do not start with `RTPS`.
"""

from __future__ import annotations

import json
import select
import socket
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any, Mapping, Sequence

MULTICAST = "multicast"
UNICAST = "unicast"
FRAGMENTED = "fragmented"
SIZES = {MULTICAST: 200, UNICAST: 200, FRAGMENTED: 8000}
"""Payload size of each kind in bytes; 8,000 bytes are 6 fragments at an MTU of 1,500 bytes."""

_POLL_S = 0.2
_DRAIN_S = 0.2
"""Maximum time after a stop for counting the datagrams that arrived before it."""
_MAX_DATAGRAM_BYTES = 65_536
_MAX_SENDERS = 64
"""Maximum number of sender addresses that are counted; datagrams of further senders are ignored."""


@dataclass(frozen=True)
class DatagramPorts:
    """Addresses of the test datagrams.

    Attributes:
        address: IPv4 address of this robot on the radio.
        group: Multicast group.
        multicast_port: UDP port of multicast datagrams.
        unicast_port: UDP port of unicast datagrams.
        token: Text that identifies the datagrams of this test, at most 32 ASCII characters without spaces.
    """

    address: str
    group: str
    multicast_port: int
    unicast_port: int
    token: str


def send(ports: DatagramPorts, peers: Sequence[str], count: int, interval_s: float) -> None:
    """Send `count` datagrams of each kind: multicast to the group, the other kinds to each peer.

    Raises:
        OSError: A datagram could not be sent, for example because there is no route.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((ports.address, 0))
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(ports.address))
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 0)
        for kind, size in SIZES.items():
            for number in range(count):
                head = f"fieldkit {ports.token} {kind} {number} ".encode("ascii")
                datagram = head + bytes(size - len(head))
                if kind == MULTICAST:
                    sender.sendto(datagram, (ports.group, ports.multicast_port))
                else:
                    for peer in peers:
                        sender.sendto(datagram, (peer, ports.unicast_port))
                time.sleep(interval_s)


def receive(ports: DatagramPorts, stop_event: threading.Event, limit_s: float) -> dict[str, dict[str, int]]:
    """Count the datagrams of the test until `stop_event` is set, for at most `limit_s`.

    Writes `up` to standard error when the sockets are open.

    Returns:
        Number of distinct datagrams by address of the sender, then by kind.

    Raises:
        OSError: Another program uses the unicast port, or uses the multicast port and does not share it, or this
            robot does not have the address.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as multicast, socket.socket(
        socket.AF_INET, socket.SOCK_DGRAM
    ) as unicast:
        for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT):
            multicast.setsockopt(socket.SOL_SOCKET, option, 1)
        multicast.bind(("", ports.multicast_port))
        membership = socket.inet_aton(ports.group) + socket.inet_aton(ports.address)
        multicast.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        unicast.bind((ports.address, ports.unicast_port))
        sys.stderr.write("up\n")
        sys.stderr.flush()
        return _count([multicast, unicast], ports.token, stop_event, time.monotonic() + limit_s)


def _count(
    sockets: Sequence[socket.socket], token: str, stop_event: threading.Event, end_s: float
) -> dict[str, dict[str, int]]:
    numbers_by_sender: dict[str, dict[str, set[bytes]]] = {}
    while True:
        if stop_event.is_set():
            end_s = min(end_s, time.monotonic() + _DRAIN_S)
        readable, _, _ = select.select(sockets, [], [], _DRAIN_S if stop_event.is_set() else _POLL_S)
        # Datagrams that arrived before the stop are still counted.
        if time.monotonic() >= end_s or (stop_event.is_set() and not readable):
            break
        for endpoint in readable:
            data, (address, _port) = endpoint.recvfrom(_MAX_DATAGRAM_BYTES)
            words = data[:128].split(b" ")
            if len(words) < 4 or words[:2] != [b"fieldkit", token.encode("ascii")]:
                continue
            kind = words[2].decode("ascii", "replace")
            is_counted_sender = address in numbers_by_sender or len(numbers_by_sender) < _MAX_SENDERS
            # A number has at most four digits, so a faulty sender cannot fill the memory.
            if is_counted_sender and len(data) == SIZES.get(kind) and words[3].isdigit() and len(words[3]) <= 4:
                numbers_by_sender.setdefault(address, {}).setdefault(kind, set()).add(words[3])
    return {
        address: {kind: len(numbers) for kind, numbers in numbers_by_kind.items()}
        for address, numbers_by_kind in numbers_by_sender.items()
    }


def run(arguments: Mapping[str, Any], stop_event: threading.Event) -> int:
    """Send test datagrams if there are peers, otherwise receive them and print their counts.

    Returns:
        The exit code: 0, or 3 after an error of the network.
    """
    ports = DatagramPorts(**arguments["ports"])
    try:
        if arguments["peers"]:
            send(ports, arguments["peers"], arguments["count"], arguments["interval_s"])
        else:
            print(json.dumps(receive(ports, stop_event, arguments["limit_s"])), flush=True)  # noqa: T201
    except OSError as error:
        sys.stderr.write(f"error: {error}\n")
        return 3
    return 0
