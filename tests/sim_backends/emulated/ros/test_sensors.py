"""Sensors publish due messages to their subscribers, never wait for a subscriber, and load no unneeded modules."""

import json
import math
import selectors
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest

from sim_backends.emulated.provisioning import definition
from sim_backends.emulated.ros import messages, sensors, tcpros
from sim_backends.emulated.ros.robot_motion import Odometer
from sim_backends.emulated.ros.sensor_specs import Sensor
from sim_backends.emulated.ros.sensors import Publication, Subscriber
from sim_backends.ros1 import framing

HEADER: Final = framing.pack(b"the header")
REQUEST: Final = tcpros.request("/test", "/imu")
IMU: Final = Sensor("/imu", "sensor_msgs/Imu", rate_hz=5.0, frame="imu", points=None)

# Forks with an open descriptor, as a robot's init process does; the fork prints its state and raises an error.
FORK_PROGRAM: Final = """
import json, os, signal, sys
from pathlib import Path
from sim_backends.emulated.robot import services

def work():
    text = {
        "name": Path("/proc/self/comm").read_text().strip(),
        "session": os.getsid(0) == os.getpid(),
        "open": sorted(fd for fd in range(256) if Path(f"/proc/self/fd/{fd}").exists()),
        "wakes": signal.set_wakeup_fd(-1),
        "children": signal.getsignal(signal.SIGCHLD) == signal.SIG_DFL,
    }
    print(json.dumps(text))
    raise RuntimeError("no more")

read_end, write_end = os.pipe2(os.O_NONBLOCK)
signal.set_wakeup_fd(write_end)
signal.signal(signal.SIGCHLD, lambda *_: None)
pid = services.fork("worker", work, Path(sys.argv[1]))
_, status = os.waitpid(pid, 0)
print(os.waitstatus_to_exitcode(status))
"""


class Peer:
    """A subscriber of a publication, and the other end of its connection."""

    def __init__(self) -> None:
        self.selector = selectors.DefaultSelector()
        self.stream, peer_socket = socket.socketpair()
        self.subscriber = Subscriber(peer_socket, HEADER, self.selector)

    def serve_all(self) -> None:
        """Serve the subscriber until it would block."""
        while not self.subscriber.is_disconnected and (ready := self.selector.select(0)):
            for key, events in ready:
                key.data(events)

    def output(self) -> list[bytes]:
        """Return all packets that were sent to the subscriber."""
        packets = framing.PacketSplitter()
        self.stream.setblocking(False)
        while True:
            self.serve_all()
            try:
                data = self.stream.recv(1 << 16)
            except BlockingIOError:
                break
            if not data:
                break
            packets.feed(data)
        result = list(packets)
        assert packets.pending == 0
        return result


@pytest.fixture
def peer() -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.stream.close()
    if not peer.subscriber.is_disconnected:
        peer.serve_all()


def test_a_subscriber_is_answered_when_its_request_is_complete(peer: Peer) -> None:
    for byte in REQUEST[:-1]:
        peer.stream.send(bytes([byte]))
        peer.serve_all()
    assert not peer.subscriber.is_subscribed
    peer.stream.send(REQUEST[-1:])
    peer.serve_all()
    assert peer.subscriber.is_subscribed
    peer.stream.send(b"bytes after the request are ignored")
    peer.serve_all()
    assert peer.output() == [b"the header"]


@pytest.mark.parametrize("data", [b"\xff\xff\xff\xff", framing.pack(framing.pack(b"no field")), framing.pack(b"x")])
def test_a_subscriber_with_another_protocol_is_disconnected(peer: Peer, data: bytes) -> None:
    peer.stream.send(data)
    peer.serve_all()
    assert peer.subscriber.is_disconnected
    assert peer.stream.recv(1) == b""


def test_a_closed_subscriber_is_removed_and_receives_nothing(peer: Peer) -> None:
    peer.stream.send(REQUEST)
    peer.serve_all()
    peer.stream.close()
    peer.serve_all()
    assert peer.subscriber.is_disconnected
    peer.subscriber.send(HEADER)


def test_a_closed_subscriber_is_detected_while_sending(peer: Peer) -> None:
    peer.stream.close()
    peer.subscriber.send(HEADER)
    assert peer.subscriber.is_disconnected


def test_a_slow_subscriber_loses_whole_messages_without_blocking(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensors, "QUEUE_BYTES", 1 << 16)
    messages_sent = [bytes([number]) * 50_000 for number in range(100)]
    for message in messages_sent:
        peer.subscriber.send(framing.pack(message))
    messages_received = peer.output()
    assert 2 <= len(messages_received) < len(messages_sent)
    assert messages_received == messages_sent[: len(messages_received)]
    peer.subscriber.send(framing.pack(b"again"))
    assert peer.output() == [b"again"]


class Topic:
    """A topic with a clock that is set by the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.now_s = 1000.0
        clock = SimpleNamespace(
            monotonic=lambda: self.now_s, monotonic_ns=lambda: round(1e9 * self.now_s), time_ns=lambda: 1
        )
        monkeypatch.setattr(sensors, "time", clock)
        monkeypatch.setattr(tcpros, "FOLDER", str(folder))
        self.selector = selectors.DefaultSelector()
        self.publication = Publication(
            IMU, definition(IMU.type), self.now_s, Odometer(folder / "motion", 0), self.selector
        )

    def subscriber(self) -> socket.socket:
        """Return the stream of a subscriber that has requested the topic."""
        stream = socket.socket(socket.AF_UNIX)
        stream.connect(str(tcpros.socket_path(IMU.topic)))
        stream.sendall(REQUEST)
        self.serve()
        return stream

    def serve(self) -> None:
        """Serve all sockets until they would block."""
        while ready := self.selector.select(0):
            for key, events in ready:
                key.data(events)


def read_messages(stream: socket.socket) -> list[Any]:
    """Return the connection header, if it was received, and the numbers of the received messages."""
    packets = framing.PacketSplitter()
    packets.feed(stream.recv(1 << 20, socket.MSG_DONTWAIT))
    return [
        framing.unpack_header(packet) if b"callerid=" in packet else int.from_bytes(packet[:4], "little")
        for packet in packets
    ]


def test_messages_are_numbered_and_due_by_the_clock_also_after_a_pause(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    topic = Topic(monkeypatch, tmp_path)
    assert topic.publication.publish() == math.inf
    topic.now_s = 1000.31
    first = topic.subscriber()
    assert topic.publication.publish() == pytest.approx(0.09)
    topic.now_s = 1000.41
    assert topic.publication.publish() == pytest.approx(0.19)
    header, *numbers = read_messages(first)
    assert header["topic"] == "/imu"
    assert header["md5sum"] == definition(IMU.type).md5
    assert header["message_definition"] == definition(IMU.type).text
    assert numbers == [2]
    topic.now_s = 1000.85  # the process was delayed: overdue messages are sent immediately, in order
    topic.publication.publish()
    assert topic.publication.publish() == pytest.approx(0.15)
    assert read_messages(first) == [3, 4]
    first.close()
    topic.serve()
    assert topic.publication.publish() == math.inf
    topic.now_s = 4600.05  # messages without subscribers are skipped
    second = topic.subscriber()
    assert topic.publication.publish() == pytest.approx(0.15)
    topic.now_s = 4600.21
    topic.publication.publish()
    assert read_messages(second)[1:] == [18001]
    second.close()


def test_a_socket_left_by_a_killed_process_is_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    Topic(monkeypatch, tmp_path)
    topic = Topic(monkeypatch, tmp_path)
    stream = topic.subscriber()
    assert len(read_messages(stream)) == 1
    stream.close()


def test_the_noise_does_not_depend_on_the_process() -> None:
    """A robot's sensors restart after a reboot, and Python's hashes differ from process to process."""
    program = (
        "from sim_backends.emulated.ros import messages, sensor_specs; "
        f"print(messages.Source(sensor_specs.{IMU!r}).message(1, 2).hex())"
    )
    result = subprocess.run((sys.executable, "-c", program), capture_output=True, text=True, check=True)
    assert result.stdout.strip() == messages.Source(IMU).message(1, 2).hex()


def test_a_fork_has_its_own_name_session_log_and_descriptors(tmp_path: Path) -> None:
    log = tmp_path / "log"
    result = subprocess.run(
        (sys.executable, "-c", FORK_PROGRAM, str(log)), capture_output=True, text=True, check=True
    )
    assert result.stdout == "1\n"
    output, *trace = log.read_text(encoding="utf-8").splitlines()
    assert json.loads(output) == {"name": "worker", "session": True, "open": [0, 1, 2], "wakes": -1, "children": True}
    assert trace[-1] == "RuntimeError: no more"


def test_robot_processes_import_only_the_standard_library() -> None:
    """numpy and rosbags, which the lab has, would cost each robot 20 MB and most of its startup time."""
    import_statement = "import sim_backends.emulated.robot.init"
    program = f"import sys; before = set(sys.modules); {import_statement}; print(*set(sys.modules) - before)"
    result = subprocess.run((sys.executable, "-c", program), capture_output=True, text=True, check=True)
    other_packages = {name.split(".")[0] for name in result.stdout.split()} - sys.stdlib_module_names
    assert other_packages == {"fieldkit", "sim_backends"}
