"""What the lab and the medium say to each other: one JSON line each way, strictly in turn, over a socket pair."""

import array
import json
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from fieldkit.deadline import Deadline
from sim_backends.radio.parameters import LinkCounters, LinkParameters, Pair

LINE_LIMIT_BYTES: Final = 8 << 20

Message = dict[str, Any]


@dataclass(frozen=True)
class PortCounters:
    """What crossed the TUN device of one robot.

    Attributes:
        read: Packets that the robot sent.
        written: Packets that the robot was given.
        refused: Packets that arrived and that the robot's kernel did not take.
        unroutable: Packets to an address that no robot has.
        not_ipv4: Packets of another protocol than IPv4, which the medium does not carry.
    """

    read: int
    written: int
    refused: int
    unroutable: int
    not_ipv4: int


@dataclass(frozen=True)
class MediumStats:
    """What the medium did so far.

    Attributes:
        scheduling: `fifo 1`, or why the process runs without real-time priority.
        late_max_ns: By how much the latest packet was handed over after it had arrived, in ns.
        links: Counters per directed link.
        ports: Counters per robot.
    """

    scheduling: str
    late_max_ns: int
    links: dict[Pair, LinkCounters]
    ports: dict[str, PortCounters]


def send(channel: socket.socket, message: Message, deadline: Deadline, descriptors: Sequence[int] = ()) -> None:
    """Send one message, and with it copies of file descriptors.

    Raises:
        OSError: The other side is gone, or did not take it before the deadline.
        ValueError: The message is longer than a line may be.
    """
    line = json.dumps(message).encode() + b"\n"
    if len(line) > LINE_LIMIT_BYTES:
        raise ValueError(f"a message of {len(line)} bytes is longer than {LINE_LIMIT_BYTES}")
    rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", descriptors))] if descriptors else []
    channel.settimeout(deadline.remaining_s)
    sent = channel.sendmsg([line], rights)
    channel.settimeout(deadline.remaining_s)
    channel.sendall(line[sent:])


def receive(channel: socket.socket, deadline: Deadline) -> tuple[Message, list[int]] | None:
    """Return the next message and the file descriptors that came with it; None when the other side is gone.

    Raises:
        OSError: The message was not there by the deadline, or the connection broke.
        ValueError: The line is too long or no JSON.
    """
    line = bytearray()
    descriptors: list[int] = []
    while not line.endswith(b"\n"):
        channel.settimeout(deadline.remaining_s)
        data, received, _, _ = socket.recv_fds(channel, 1 << 16, 1, socket.MSG_CMSG_CLOEXEC)
        descriptors += received
        if not data:
            return None
        line += data
        if len(line) > LINE_LIMIT_BYTES:
            raise ValueError(f"a message is longer than {LINE_LIMIT_BYTES} bytes")
    message: Message = json.loads(line)
    return message, descriptors


def pack_links(links: dict[Pair, LinkParameters]) -> list[Any]:
    """Return `links` as JSON rows."""
    return [[*pair, vars(parameters)] for pair, parameters in links.items()]


def unpack_links(rows: list[Any]) -> dict[Pair, LinkParameters]:
    """Return what `pack_links` packed."""
    return {(sender, receiver): LinkParameters(**values) for sender, receiver, values in rows}


def pack_stats(stats: MediumStats) -> Message:
    """Return `stats` as a message."""
    return {
        "scheduling": stats.scheduling,
        "late_max_ns": stats.late_max_ns,
        "links": [[*pair, vars(counters)] for pair, counters in stats.links.items()],
        "ports": {name: vars(counters) for name, counters in stats.ports.items()},
    }


def unpack_stats(message: Message) -> MediumStats:
    """Return what `pack_stats` packed."""
    return MediumStats(
        scheduling=message["scheduling"],
        late_max_ns=message["late_max_ns"],
        links={(sender, receiver): LinkCounters(**values) for sender, receiver, values in message["links"]},
        ports={name: PortCounters(**values) for name, values in message["ports"].items()},
    )
