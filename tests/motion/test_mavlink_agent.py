"""The MAVLink recorder: frames compared with pymavlink, and recordings over all kinds of connections."""

import json
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v10 import common as v1
from pymavlink.dialects.v20 import common as d

from fieldkit.agent.autopilots import mavlink, mavlink_frames
from fieldkit.agent.links import devices
from fieldkit.agent.links.client import MessageRate
from fieldkit.motion.logs import tlog
from fieldkit.remote import agent
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from tests.helpers import drones
from tests.helpers.drones import Sender

ConnectionKind = Callable[[], AbstractContextManager[str]]
REQUESTED = {"32": 20_000, "30": -1}
"""The recorder requests LOCAL_POSITION_NED at 50 Hz, and no ATTITUDE."""


def real_frames() -> list[bytes]:
    """Return frames of MAVLink 1 and 2, with and without signatures."""
    mavlink1, mavlink2, signed = v1.MAVLink(None, srcSystem=3), Sender(), Sender()
    signed.link.signing.secret_key = b"k" * 32
    signed.link.signing.sign_outgoing = True
    attitude = d.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0, 0, 0)
    text = d.MAVLink_statustext_message(4, b"\xfe\xfd" * 20)
    return [
        bytes(v1.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0, 0, 0).pack(mavlink1)),
        *(encoder.frame(message) for encoder in (mavlink2, signed) for message in (attitude, text, drones.beat())),
    ]


FRAMES = real_frames()


@given(st.lists(st.sampled_from(FRAMES), max_size=8), st.lists(st.integers(0, 400), max_size=5))
def test_frames_are_complete_for_any_division_of_the_stream(sent_frames: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(sent_frames)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    buffer, received_frames = bytearray(), list[bytes]()
    for start, end in pairwise(edges):
        buffer += stream[start:end]
        received_frames += mavlink_frames.frames(buffer)
    assert received_frames == sent_frames
    assert not buffer


@given(st.binary(max_size=700))
def test_frames_in_any_bytes_are_parts_of_these_bytes_in_order(data: bytes) -> None:
    offset = 0
    for frame in mavlink_frames.frames(bytearray(data)):
        assert mavlink_frames.frame_bytes(frame) == len(frame)
        mavlink_frames.parse_frame(frame)
        offset = data.index(frame, offset) + len(frame)


def test_frames_are_received_after_an_incomplete_frame() -> None:
    partial_stream = FRAMES[1][7:] + b"".join(FRAMES)
    assert list(mavlink_frames.frames(bytearray(partial_stream)))[-len(FRAMES) :] == FRAMES


def test_created_frames_are_read_by_pymavlink() -> None:
    writer, reader = mavlink_frames.FrameWriter(), d.MAVLink(None)
    reader.robust_parsing = False
    heartbeat, command, second_command = reader.parse_buffer(
        writer.heartbeat() + writer.command((7, 1), 511, 32, 100_000) + writer.command((7, 1), 511, 0, 0)
    )
    assert (heartbeat.type, heartbeat.autopilot, heartbeat.get_srcComponent()) == (
        d.MAV_TYPE_LOG,
        d.MAV_AUTOPILOT_INVALID,
        d.MAV_COMP_ID_LOG,
    )
    assert (command.command, command.param1, command.param2) == (d.MAV_CMD_SET_MESSAGE_INTERVAL, 32, 100_000)
    assert (command.target_system, command.target_component) == (7, 1)
    assert [frame.get_seq() for frame in (heartbeat, command, second_command)] == [0, 1, 2]


@pytest.mark.parametrize("is_mavlink1", [False, True])
def test_checksums_equal_those_of_pymavlink(is_mavlink1: bool) -> None:
    link = d.MAVLink(None, srcSystem=7)
    for message in (drones.beat(), d.MAVLink_command_ack_message(511, 2)):
        frame = bytes(message.pack(link, force_mavlink1=is_mavlink1))
        assert mavlink_frames.is_intact(frame)
        for offset in range(1 if is_mavlink1 else 3, len(frame)):
            changed_frame = bytes((*frame[:offset], frame[offset] ^ 1, *frame[offset + 1 :]))
            assert not mavlink_frames.is_intact(changed_frame)
    unknown_message = bytes(d.MAVLink_system_time_message(1, 2).pack(link, force_mavlink1=is_mavlink1))
    assert not mavlink_frames.is_intact(unknown_message), "the CRC_EXTRA of another message is unknown"


@dataclass
class RecorderResult:
    """The result of a recorder."""

    code: int
    summary: dict[str, Any]
    log: Path


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("agent") / "agent.pyz"
    path.write_bytes(agent.content())
    return path


@contextmanager
def recording(program: Path, log: Path, connection: str, **arguments: object) -> Iterator[RecorderResult]:
    """Run a recorder while the body runs. It is ready when the body starts, and is stopped like a job."""
    request = json.dumps({"connection": connection, "intervals_us": {}, **arguments})
    argv = (sys.executable, str(program), "mavlink", request, str(log))
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith(b"waiting for the heartbeat")
        result = RecorderResult(-1, {}, log)
        try:
            assert process.stderr.readline() == b"up, MAVLink\n"
            yield result
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=60)
            assert errors == b""
            result.code, result.summary = process.returncode, json.loads(output)
        finally:
            process.kill()


def wait_until_size(log: Path, size_bytes: int) -> None:
    """Wait until a log has reached a size."""
    for _ in range(600):
        if log.stat().st_size >= size_bytes:
            return
        threading.Event().wait(0.05)
    raise AssertionError(f"{log} does not grow")


def message_types(path: Path) -> list[str]:
    """Return the message types of a log, read by pymavlink."""
    reader = mavutil.mavlink_connection(str(path))
    types = []
    while (message := reader.recv_msg()) is not None:
        types.append(message.get_type())
    return types


@contextmanager
def over_tcp() -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        streams: list[socket.socket] = []
        acceptor = threading.Thread(target=lambda: streams.append(server.accept()[0]))
        acceptor.start()

        def stream() -> socket.socket:
            acceptor.join()
            return streams[0]

        with _drone_answering(stream):
            yield f"tcp:127.0.0.1:{server.getsockname()[1]}"


@contextmanager
def _drone_answering(stream: Callable[[], socket.socket]) -> Iterator[None]:
    """Let a drone answer on a stream when it is open."""
    finished, ready = threading.Event(), threading.Event()

    def fly() -> None:
        with stream() as connection, drones.flying(connection.fileno(), connection.sendall, connection.recv):
            ready.set()
            finished.wait()

    thread = threading.Thread(target=fly)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()


@contextmanager
def over_udp() -> Iterator[str]:
    with drones.at_udp() as port:
        yield f"udpout:127.0.0.1:{port}"


@contextmanager
def over_udp_with_autopilot_that_sends_first() -> Iterator[str]:
    address = ("127.9.9.9", 14_550)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("127.0.0.1", 0))
        with drones.flying(
            endpoint.fileno(), lambda frame: endpoint.sendto(frame, address), endpoint.recv
        ) as autopilot:
            list(autopilot.receive(Sender(255, 190).frame(drones.beat()), ("gcs", 1), time.monotonic_ns()))
            yield f"udpin:{address[0]}:{address[1]}"


@contextmanager
def over_a_serial_line() -> Iterator[str]:
    with drones.at_terminal() as path:
        yield f"{path}:115200"


@pytest.mark.parametrize(
    "connection_kind",
    [over_udp, over_udp_with_autopilot_that_sends_first, over_tcp, over_a_serial_line],
    ids=lambda connection_kind: connection_kind.__name__,
)
def test_log_is_read_by_pymavlink(connection_kind: ConnectionKind, program: Path, tmp_path: Path) -> None:
    with (
        connection_kind() as connection,
        recording(program, tmp_path / "x.tlog", connection, intervals_us=REQUESTED) as result,
    ):
        wait_until_size(result.log, 15_000)  # a PX4 sends ATTITUDE without a request until it is switched off
    assert result.code == 0
    types = message_types(result.log)
    log_content = tlog.read(result.log, 0, result.summary["ended_us"])
    assert result.summary["frames"] == log_content.frames == len(types)
    assert (result.summary["refused"], result.summary["left_out"]) == ({}, 0)
    assert log_content.kinds == {kind: types.count(kind) for kind in set(types) - {"BAD_DATA"}}
    assert log_content.values["mavlink_loss"] == 0
    assert types.count("LOCAL_POSITION_NED") > 3 * types.count("ATTITUDE")


def test_device_sends_to_a_peer_that_restarted_at_another_port(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    device = devices.open_device(f"udpin:127.0.0.1:{port}")
    with socket.socket(type=socket.SOCK_DGRAM) as first, socket.socket(type=socket.SOCK_DGRAM) as second:
        first.settimeout(60)
        second.settimeout(60)
        for sending_socket, receiving_socket in ((first, first), (second, first), (second, second)):
            if receiving_socket is second:
                monkeypatch.setattr(devices, "_PEER_TIMEOUT_S", 0.0)
            sending_socket.sendto(Sender().frame(drones.beat()), ("127.0.0.1", port))
            select.select([device], [], [], 60)
            assert device.read()
            device.write(b"a message to the peer")
            assert receiving_socket.recv(100) == b"a message to the peer"
    device.close()


def test_refused_rate_is_reported(program: Path, tmp_path: Path) -> None:
    with (
        over_udp() as connection,
        recording(program, tmp_path / "x.tlog", connection, intervals_us={"12345": 1, "1": 500_000}) as result,
    ):
        pass
    assert result.summary["refused"] == {"12345": d.MAV_RESULT_FAILED}


def test_recorder_waits_for_the_configured_system_and_reports_it(program: Path, tmp_path: Path) -> None:
    with over_udp() as connection:
        arguments = json.dumps({"connection": connection, "intervals_us": {}, "system": 9})
        argv = (sys.executable, str(program), "mavlink", arguments, str(tmp_path / "x.tlog"))
        with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            wait_until_created(tmp_path / "x.tlog")
            wait_until_size(tmp_path / "x.tlog", 500)
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=60)
    assert errors.decode() == f"waiting for the heartbeat of an autopilot at {connection}\n"


class FakeClock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return round(self.now_s * 1e9)


class FakeLink:
    """A link with messages from a test; it is also the selector that reports them."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.messages: dict[int, MessageRate] = {}
        self.dropped_frames = 0

    def select(self, _: float) -> bool:
        return bool(self.frames)

    def receive(self) -> Iterator[bytes]:
        frames, self.frames = self.frames, []
        yield from frames

    def send(self, frame: bytes) -> None:
        assert frame


@pytest.mark.parametrize(("arrives", "is_refused"), [(False, False), (True, False), (False, True)])
def test_requested_message_must_arrive_60_s_after_the_first_heartbeat(
    arrives: bool, is_refused: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    clock, link, sender = FakeClock(), FakeLink(), Sender()
    monkeypatch.setattr(mavlink, "time", clock)
    arguments = mavlink.FlightRecording("udpout:127.0.0.1:1", {"30": 100_000, "32": 100_000})
    recorder = mavlink.FlightRecorder(arguments, link, str(tmp_path / "x.tlog"))  # type: ignore[arg-type]

    def iterate(at_s: float, *messages: d.MAVLink_message) -> None:
        clock.now_s = 100.0 + at_s
        link.frames = [sender.frame(message) for message in messages]
        recorder.send()
        recorder.receive(0.1, link)  # type: ignore[arg-type]
        recorder.check()

    iterate(500.0)  # the autopilot is switched on late
    iterate(500.0, drones.beat(), d.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0))
    iterate(559.9, drones.beat())
    assert not recorder.ready
    if arrives:
        iterate(559.95, d.MAVLink_local_position_ned_message(1, 0, 0, 0, 0, 0, 0))
    if is_refused:
        link.messages = {32: MessageRate(100_000, d.MAV_RESULT_DENIED, 0.0)}
    if arrives or is_refused:
        iterate(560.1, drones.beat())
        assert recorder.ready
        iterate(2000.0)
    else:
        with pytest.raises(mavlink.MissingMessageError, match="requested messages in 60 s; missing: 32"):
            iterate(560.1, drones.beat())
    recorder.end()


def test_recorder_stops_after_the_timeout_of_first_messages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An autopilot has no position during its boot, which takes longer than the timeout here."""
    monkeypatch.setattr(mavlink, "_TIMEOUT_S", 2.0)
    with drones.autopilot_at_udp(firmware=ARDUCOPTER, boot_s=3600.0) as (port, _):
        arguments = mavlink.FlightRecording(f"udpout:127.0.0.1:{port}", {"32": 100_000})
        with pytest.raises(mavlink.MissingMessageError, match="all requested messages in 2 s; missing: 32"):
            mavlink.record(arguments, str(tmp_path / "x.tlog"), threading.Event())


def wait_until_created(path: Path) -> None:
    for _ in range(600):
        if path.exists():
            return
        threading.Event().wait(0.05)
    raise AssertionError(path)


@pytest.mark.parametrize(
    ("connection", "message"),
    [
        ("tcp:127.0.0.1:1", "Connection refused"),
        ("/dev/null:115200", "Inappropriate ioctl"),
        ("/dev/none:115200", "No such file"),
        ("/dev/null:7", "/dev/null:7 has no valid baud rate; write for example /dev/null:57600"),
        ("/dev/null", "/dev/null has no valid baud rate"),
        ("usb:1:2", "is not a connection: it must start with udpout:"),
    ],
)
def test_connection_that_cannot_be_opened_is_reported(
    connection: str, message: str, program: Path, tmp_path: Path
) -> None:
    arguments = json.dumps({"connection": connection, "intervals_us": {}})
    argv = (sys.executable, str(program), "mavlink", arguments, str(tmp_path / "x.tlog"))
    completed = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=60)
    assert completed.returncode == 3
    assert f"error: MAVLink over {connection}: " in completed.stderr
    assert message in completed.stderr


@pytest.mark.parametrize("serial", [False, True], ids=["udp", "serial"])
def test_hostile_bytes_do_not_stop_the_recorder_or_damage_the_log(
    serial: bool, program: Path, tmp_path: Path
) -> None:
    damage = drones.damage_randomly(1)
    drone = drones.at_terminal(damage) if serial else drones.at_udp(damage)
    with drone as address:
        connection = f"{address}:115200" if serial else f"udpout:127.0.0.1:{address}"
        with recording(program, tmp_path / "x.tlog", connection, intervals_us=REQUESTED) as result:
            wait_until_size(result.log, 12_000)
    assert result.code == 0
    log_content = tlog.read(result.log, drones.SYSTEM, result.summary["ended_us"])
    assert log_content.frames == result.summary["frames"]
    assert int(log_content.values["mavlink_damaged"]) > 10
    assert log_content.kinds["LOCAL_POSITION_NED"] > 5
