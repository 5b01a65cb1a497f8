"""Recorders and publishers keep running if their peers violate TCPROS."""

import fcntl
import random
import selectors
import signal
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import pytest
from rosbags.highlevel import AnyReader

from sim_backends.emulated.provisioning import definition
from sim_backends.emulated.ros import tcpros
from sim_backends.emulated.ros.robot_motion import Odometer
from sim_backends.emulated.ros.sensor_specs import Sensor
from sim_backends.emulated.ros.sensors import Publication
from sim_backends.ros1 import framing
from tests.fuzz.mutate import mutated

GOOD: Final = "/good"
HOSTILE: Final = 80
"""Number of topics with hostile publishers, and number of hostile subscribers."""
COUNT: Final = 20

_PATCHED: Final = "import sys; from sim_backends.emulated.ros import tcpros; tcpros.FOLDER = sys.argv.pop(1); "
RECORDERS: Final = {
    "ros1": f"{_PATCHED}from sim_backends.emulated.ros import rosbag; sys.exit(rosbag.main())",
    "ros2": f"{_PATCHED}from sim_backends.emulated.ros.ros2_bag import main; sys.exit(main(sys.argv[1:], 'jazzy'))",
}
ARGV: Final = {"ros1": ("record", "-O", "bag", "-a"), "ros2": ("bag", "record", "-o", "bag", "-a")}
BAGS: Final = {"ros1": "bag.bag", "ros2": "bag"}
SENSOR: Final = Sensor("/imu", "sensor_msgs/Imu", rate_hz=5.0, frame="imu", points=None)


def stream_of(topic: str, count: int) -> bytes:
    """Return the stream of a publisher of numbers: its header, then messages."""
    header = {
        "callerid": "/test",
        "latching": "0",
        "md5sum": "fdb28210bfa9d7c91146260178d9a584",
        "message_definition": "float64 data\n",
        "topic": topic,
        "type": "std_msgs/Float64",
    }
    packets = (struct.pack("<d", number) for number in range(count))
    return framing.pack(framing.pack_header(header)) + b"".join(map(framing.pack, packets))


class Publishers:
    """Publishers that send fixed bytes to every subscriber of a topic.

    Args:
        folder: Folder of their sockets.
        content: Bytes by topic.
    """

    def __init__(self, folder: Path, content: dict[str, bytes]) -> None:
        self._content = content
        self._stopped = threading.Event()
        self._unread = set(content)
        self._servers = []
        for topic in content:
            server = socket.socket(socket.AF_UNIX)
            server.bind(str(folder / topic.strip("/")))
            server.listen()
            self._servers.append((server, threading.Thread(target=self._serve, args=(server, topic))))

    def __enter__(self) -> "Publishers":
        for _, thread in self._servers:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        for server, thread in self._servers:
            with socket.socket(socket.AF_UNIX) as last_connection, suppress(OSError):
                last_connection.connect(server.getsockname())
            thread.join()
            server.close()

    def wait(self) -> None:
        """Wait until some subscriber has read, or refused to read, the bytes of each topic."""
        end_s = time.monotonic() + 60
        while self._unread:
            assert time.monotonic() < end_s, self._unread
            self._stopped.wait(0.02)

    def _serve(self, server: socket.socket, topic: str) -> None:
        while not self._stopped.is_set():
            stream, _ = server.accept()
            with stream, suppress(OSError):
                stream.sendall(self._content[topic])
                while not self._stopped.is_set() and any(fcntl.ioctl(stream, termios.TIOCOUTQ, bytes(4))):
                    self._stopped.wait(0.01)
                self._unread.discard(topic)
                if topic == GOOD:
                    self._stopped.wait()
            self._unread.discard(topic)


@pytest.mark.parametrize("ros", ["ros1", "ros2"])
def test_a_recorder_survives_hostile_publishers(ros: str, tmp_path: Path) -> None:
    rng, valid_streams = random.Random(7), [stream_of(GOOD, 3), stream_of("/other", 3), b"\xff" * 40]
    topics = {
        f"/bad{number}": mutated(rng.choice(valid_streams), valid_streams, rng)[:100_000] for number in range(HOSTILE)
    }
    # Damaged only in the messages, or only in the headers.
    topics |= {f"/torn{number}": stream_of(f"/torn{number}", 2) + rng.randbytes(40) for number in range(10)}
    topics |= {
        f"/odd{number}": stream_of(f"/odd{number}", 2).replace(b"std_msgs/Float64", type_name.ljust(16, b"x"))
        for number, type_name in enumerate(
            (b"std_msgs/Nothing", b"\xc3\x28/x", b"", b"sensor_msgs/Imu/", b"std_msgs/String_")
        )
    }
    folder = tmp_path / "ros"
    folder.mkdir()
    with Publishers(folder, topics | {GOOD: stream_of(GOOD, COUNT)}) as publishers:
        argv = (sys.executable, "-c", RECORDERS[ros], str(folder), *ARGV[ros])
        with subprocess.Popen(argv, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as recorder:
            publishers.wait()
            assert recorder.poll() is None
            recorder.send_signal(signal.SIGINT)
            _, errors = recorder.communicate(timeout=60)
    assert b"Traceback" not in errors
    with AnyReader([tmp_path / BAGS[ros]]) as reader:
        good_connections = [connection for connection in reader.connections if connection.topic == GOOD]
        messages: list[Any] = [
            reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages(good_connections)
        ]
    numbers = [message.data for message in messages]
    assert numbers == list(range(COUNT))


def test_a_publisher_survives_hostile_subscribers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcpros, "FOLDER", str(tmp_path))
    rng, request = random.Random(3), tcpros.request("/test", SENSOR.topic)
    selector = selectors.DefaultSelector()
    odometer = Odometer(tmp_path / "motion", 0)
    publication = Publication(SENSOR, definition(SENSOR.type), 0.0, odometer, selector)
    streams = []
    for number in range(HOSTILE + 1):
        stream = socket.socket(socket.AF_UNIX)
        stream.connect(str(tcpros.socket_path(SENSOR.topic)))
        stream.setblocking(False)
        with suppress(BlockingIOError):
            stream.send(request if number == HOSTILE else mutated(request, [request], rng)[:50_000])
        if number % 3 == 1:
            stream.close()
        streams.append(stream)
    for _ in range(2 * HOSTILE):
        for key, events in selector.select(0):
            key.data(events)
        publication.publish()
    header = framing.PacketSplitter()
    header.feed(streams[HOSTILE].recv(1 << 16))
    first, *_ = header
    assert framing.unpack_header(first)["topic"] == SENSOR.topic
