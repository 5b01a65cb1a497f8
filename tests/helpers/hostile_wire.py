"""A host on the cable that means harm: `python -m tests.helpers.hostile_wire WHAT WORD...`.

`rtps COUNT` listens to what others say to each other, and says it again, changed. `heartbeat` says one message in the
name of the writer of a stream: that its oldest sample is far ahead. `tcpros MASTER HOST:PORT...`
connects to nodes and says what is no TCPROS, and registers publishers with the master who do so too. Says `done` at
its end.
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

from fieldkit.agent.stream import MAGIC
from tests.fuzz.mutate import mutated

TOPIC: Final = "/stream"
_ALL: Final = 0x0003
"""ETH_P_ALL: what the own host sends, too."""
_UDP: Final = 17
_SEEDS: Final = 40
_HEAD_BYTES: Final = 20
"""Of an RTPS message: protocol, version, vendor, and who says it."""
_DATA, _HEARTBEAT, _LITTLE_ENDIAN = 0x15, 0x07, 0x01
_AHEAD: Final = 1 << 40
_MOST_BYTES: Final = 60_000
_EVIL: Final = 8
_CONNECTIONS: Final = 15

Datagram = tuple[tuple[str, int], bytes]


def overheard() -> list[Datagram]:
    """Return RTPS messages that others sent, and where to."""
    found: list[Datagram] = []
    with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ALL)) as ear:
        while len(found) < _SEEDS:
            packet = ear.recv(65_536)
            size = 4 * (packet[0] & 0xF)
            payload = packet[size + 8 :]
            if packet[0] >> 4 == 4 and packet[9] == _UDP and payload.startswith(b"RTPS"):
                (port,) = struct.unpack_from(">H", packet, size + 2)
                found.append(((socket.inet_ntoa(packet[16:20]), port), payload))
    return found


def rtps(count: int) -> None:
    """Say changed messages of others, half of them with whole heads."""
    dice, heard = random.Random(count), overheard()
    seeds = [payload for _, payload in heard]
    _say("heard enough")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth:
        for number in range(count):
            to, payload = dice.choice(heard)
            kept = _HEAD_BYTES * (number % 2)
            changed = payload[:kept] + mutated(payload[kept:], seeds, dice)
            with suppress(OSError):  # its own queue is full
                mouth.sendto(changed[:_MOST_BYTES], to)


def heartbeat() -> None:
    """Say in a writer's name that its oldest sample is far ahead (RTPS 2.3, 9.4.5.6)."""
    to, payload = next(one for one in overheard() if writers(one[1]))
    writer = writers(payload)[0]
    # No reader in particular; the oldest and the newest sample; how often it was said, which must grow.
    told = bytes(4) + writer + 2 * struct.pack("<iI", _AHEAD >> 32, _AHEAD & 0xFFFFFFFF) + struct.pack("<i", 1 << 30)
    message = payload[:_HEAD_BYTES] + struct.pack("<BBH", _HEARTBEAT, _LITTLE_ENDIAN, len(told)) + told
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth:
        mouth.sendto(message, to)


def writers(payload: bytes) -> list[bytes]:
    """Return who wrote each sample of a stream in an RTPS message (9.4.5.3), by its identifier in its participant."""
    found, at = [], _HEAD_BYTES
    while at + 4 <= len(payload):
        kind, _, size = struct.unpack_from("<BBH", payload, at)
        content = payload[at + 4 : at + 4 + size] if size else payload[at + 4 :]
        if kind == _DATA and MAGIC in content:
            found.append(content[8:12])
        at += 4 + len(content)
    return found


def header(**fields: str) -> bytes:
    """Return a connection header of TCPROS."""
    lines = [f"{name}={value}".encode() for name, value in fields.items()]
    packed = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(packed)) + packed


def tcpros(master: str, ends: Sequence[tuple[str, int]]) -> None:
    """Connect to nodes as a bad subscriber, and be connected to as bad publishers."""
    kind = {"type": "std_msgs/UInt8MultiArray", "md5sum": "82373f1612381bb6ee473b5cd6f5d89c"}
    request = header(callerid="/evil", topic=TOPIC, **kind)
    answer = header(callerid="/evil", latching="0", message_definition="", topic=TOPIC, **kind)
    answer += struct.pack("<I", 20) + bytes(20)
    dice, asked = random.Random(5), threading.Semaphore(0)
    own = own_address(master)
    for number in range(_EVIL):
        data = socket.create_server((own, 0))
        changed = mutated(answer, [answer, request], dice)[:_MOST_BYTES]
        threading.Thread(target=publish, args=(data, changed, asked), daemon=True).start()
        api = SimpleXMLRPCServer((own, 0), logRequests=False, allow_none=True)
        place = ["TCPROS", own, data.getsockname()[1]]
        api.register_function(lambda *_, place=place: [1, "ready", place], "requestTopic")
        threading.Thread(target=api.serve_forever, daemon=True).start()
        uri = f"http://{own}:{api.server_address[1]}/"
        register(master, f"/evil{number}", kind["type"], uri)
    _say("registered")
    for _ in range(_EVIL):
        assert asked.acquire(timeout=60)
    _say("connected to")
    for end, _ in itertools.product(ends, range(_CONNECTIONS)):
        with socket.create_connection(end, timeout=5) as stream, suppress(OSError):
            stream.sendall(mutated(request, [request, answer], dice)[:_MOST_BYTES])


def own_address(master: str) -> str:
    """Return the own address on the way to the master."""
    host, _, port = master.removeprefix("http://").rstrip("/").rpartition(":")
    with socket.create_connection((host, int(port))) as way:
        found: str = way.getsockname()[0]
    return found


def register(master: str, name: str, kind: str, uri: str) -> None:
    """Register a publisher with the master."""
    proxy: Any = ServerProxy(master)
    code, what, _ = proxy.registerPublisher(name, TOPIC, kind, uri)
    assert code == 1, what


def publish(server: socket.socket, data: bytes, asked: threading.Semaphore) -> None:
    """Say to each subscriber what is none of its topic."""
    while True:
        stream, _ = server.accept()
        with stream, suppress(OSError):
            stream.recv(65_536)
            stream.sendall(data)
        asked.release()


def main(what: str, *words: str) -> None:
    """Do harm, and say so."""
    if what == "rtps":
        rtps(int(words[0]))
    elif what == "heartbeat":
        heartbeat()
    else:
        master, *ends = words
        tcpros(master, [(one.partition(":")[0], int(one.partition(":")[2])) for one in ends])
    _say("done")


def _say(what: str) -> None:
    sys.stderr.write(f"{time.monotonic():.3f} {what}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
