"""The link server with its clients: all kinds of connections, faults of the server, and restarts of a router."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as d

from fieldkit.agent.autopilots.mavlink_frames import ATTITUDE, LOCAL_POSITION_NED
from fieldkit.agent.flying.session import AutopilotSession
from fieldkit.agent.links import link_files, survey
from fieldkit.agent.links.client import SharedLink
from fieldkit.remote import agent
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from tests.helpers import drones
from tests.helpers.mavlink_router import MavlinkRouter

PATIENCE_S = 60.0
LINK_KINDS = ("udpout", "tcp", "tcp of one client", "udpin", "serial")


@contextmanager
def drone_at(kind: str) -> Iterator[str]:
    """Provide a drone at a kind of connection."""
    if kind == "serial":
        with drones.at_terminal() as path:
            yield f"{path}:115200"
    elif kind == "udpin":
        with socket.socket(type=socket.SOCK_DGRAM) as drone, socket.socket(type=socket.SOCK_DGRAM) as free_socket:
            drone.bind(("127.0.0.1", 0))
            free_socket.bind(("127.0.0.1", 0))
            address = free_socket.getsockname()
            free_socket.close()
            with drones.flying(drone.fileno(), lambda frame: drone.sendto(frame, address), drone.recv) as autopilot:
                greeting = drones.Sender(255, 190).frame(drones.beat())
                list(autopilot.receive(greeting, drones.PEER, time.monotonic_ns()))
                yield f"udpin:127.0.0.1:{address[1]}"
    else:
        with drones.at_udp() as port, MavlinkRouter(port, 1 if kind.endswith("client") else 100) as router:
            yield f"udpout:127.0.0.1:{router.udp}" if kind == "udpout" else f"tcp:127.0.0.1:{router.tcp}"


@contextmanager
def connected_sessions(connection: str, clients: int = 1) -> Iterator[list[AutopilotSession]]:
    """Let clients exchange messages with an autopilot over one connection."""
    sessions: list[AutopilotSession] = []
    try:
        sessions.extend(AutopilotSession(connection) for _ in range(clients))
        yield sessions
    finally:
        for session in sessions:
            session.close()


def links_of(sessions: list[AutopilotSession]) -> list[SharedLink]:
    """Return the links of clients."""
    links = [session.drone.link for session in sessions]
    assert all(isinstance(link, SharedLink) for link in links)
    return [link for link in links if isinstance(link, SharedLink)]


def exchange_until(sessions: list[AutopilotSession], condition: Callable[[], bool]) -> float:
    """Let clients exchange messages until a condition is true; return the duration."""
    start_s = time.monotonic()
    while not condition():
        assert time.monotonic() < start_s + PATIENCE_S
        for session in sessions:
            session.exchange(0.02)
    return time.monotonic() - start_s


def servers(connection: str) -> list[int]:
    """Return the process ids of the servers of a connection."""
    pids = list[int]()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            arguments = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"link" in arguments and json.dumps({"connection": connection}).encode() in arguments:
            pids.append(int(path.parent.name))
    return pids


def assert_nothing_remains(connection: str) -> None:
    """Wait until a connection has no server, and its files are deleted."""
    end_s = time.monotonic() + PATIENCE_S
    while servers(connection) or any(Path(link_files.folder()).glob(f"{link_files.name(connection)}.*")):
        assert time.monotonic() < end_s, servers(connection)
        threading.Event().wait(0.05)


@pytest.mark.parametrize("kind", LINK_KINDS)
def test_each_connection_is_shared_by_four_programs(kind: str) -> None:
    with drone_at(kind) as connection:
        with connected_sessions(connection, 4) as sessions:
            exchange_until(
                sessions, lambda: all(session.drone.alive and session.drone.position_m for session in sessions)
            )
            assert len(servers(connection)) == 1
            sessions[3].drone.commands.send(512, 148)
            exchange_until(sessions, lambda: 512 in sessions[3].drone.command_results)
        assert_nothing_remains(connection)


@pytest.mark.parametrize("kind", LINK_KINDS)
def test_survey_detects_the_autopilot_beside_another_program(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    with drone_at(kind) as connection, connected_sessions(connection) as sessions:
        exchange_until(sessions, lambda: sessions[0].drone.alive)
        assert survey.survey(connection, threading.Event()) == 0
        survey_result = json.loads(capsys.readouterr().out)
        assert (survey_result["error"], survey_result["system"]) == ("", drones.SYSTEM)
        assert len(servers(connection)) == 1


def test_survey_reports_a_missing_connection_and_open_ports(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 14_557))
        assert survey.survey("tcp:127.0.0.1:1", threading.Event()) == 0
    survey_result = json.loads(capsys.readouterr().out)
    assert "Connection refused" in survey_result["error"]
    assert survey_result["system"] == 0
    assert "UDP port 14557" in survey_result["candidates"]


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP], ids=lambda fault: fault.name)
def test_killed_or_suspended_server_is_replaced(fault: signal.Signals) -> None:
    with drone_at("tcp of one client") as connection:
        with connected_sessions(connection, 3) as sessions:
            exchange_until(sessions, lambda: all(session.drone.alive for session in sessions))
            sessions[0].drone.commands.request_stream(ATTITUDE, 20)
            links = links_of(sessions)
            (pid,) = servers(connection)
            os.kill(pid, fault)
            exchange_until(sessions, lambda: all(link.restarts for link in links))
            exchange_until(sessions, lambda: all(link.connected for link in links))
            for session in sessions:
                session.drone._position_s = float("-inf")
            exchange_until(sessions, lambda: all(session.drone.position_m for session in sessions))
            assert len(servers(connection)) == 1
            assert servers(connection) != [pid]
            # The request of the first client is repeated to the new server.
            exchange_until(
                sessions, lambda: links[0].messages.get(ATTITUDE) is not None and links[0].messages[ATTITUDE].hz > 14
            )
        assert_nothing_remains(connection)


def test_router_restart_stops_no_program() -> None:
    with drones.at_udp() as port, MavlinkRouter(port) as router:
        connection = f"tcp:127.0.0.1:{router.tcp}"
        with connected_sessions(connection, 2) as sessions:
            exchange_until(sessions, lambda: all(session.drone.alive for session in sessions))
            links = links_of(sessions)
            (pid,) = servers(connection)
            router.restart(2.0)
            exchange_until(sessions, lambda: not any(link.connected for link in links))
            assert all(link.lost_since_s is not None for link in links)
            exchange_until(sessions, lambda: all(link.connected for link in links))
            for session in sessions:
                session.drone._position_s = float("-inf")
            exchange_until(sessions, lambda: all(session.drone.position_m for session in sessions))
            assert servers(connection) == [pid]
        assert_nothing_remains(connection)


def test_reconnected_serial_device_stops_no_program(tmp_path: Path) -> None:
    with drones.autopilot_at_usb(tmp_path / "ttyUSB0") as (usb, _):
        connection = f"{usb.path}:115200"
        with connected_sessions(connection, 2) as sessions:
            exchange_until(sessions, lambda: all(session.drone.alive for session in sessions))
            sessions[0].drone.commands.request_stream(ATTITUDE, 20)
            links = links_of(sessions)
            (pid,) = servers(connection)
            exchange_until(sessions, lambda: ATTITUDE in links[0].messages and links[0].messages[ATTITUDE].hz > 14)
            usb.pull_out()
            exchange_until(sessions, lambda: not any(link.connected for link in links))
            exchange_until(
                sessions, lambda: "No such file" in links[0].error[1] and links[0].messages[ATTITUDE].hz == 0
            )
            usb.plug_in()
            exchange_until(sessions, lambda: all(link.connected for link in links))
            exchange_until(sessions, lambda: links[0].messages[ATTITUDE].hz > 14)
            assert servers(connection) == [pid]
        assert_nothing_remains(connection)


def test_exit_of_a_client_keeps_the_rates_of_others() -> None:
    with drone_at("udpout") as connection, connected_sessions(connection, 2) as sessions:
        exchange_until(sessions, lambda: all(session.drone.alive for session in sessions))
        links = links_of(sessions)
        sessions[0].drone.commands.request_stream(LOCAL_POSITION_NED, 10)
        sessions[1].drone.commands.request_stream(LOCAL_POSITION_NED, 40)
        exchange_until(
            sessions, lambda: links[0].messages[LOCAL_POSITION_NED].hz > 28 if links[0].messages else False
        )
        sessions[1].drone.commands.request_stream(LOCAL_POSITION_NED, 0)
        exchange_until(sessions, lambda: links[0].messages[LOCAL_POSITION_NED].hz < 14)
        exchange_until(sessions, lambda: not links[1].messages)
        assert links[0].messages[LOCAL_POSITION_NED].interval_us == 100_000


def test_rate_that_another_station_changed_is_requested_again() -> None:
    with drones.at_udp(firmware=ARDUCOPTER) as port:
        connection = f"udpout:127.0.0.1:{port}"
        with connected_sessions(connection) as sessions:
            exchange_until(sessions, lambda: sessions[0].drone.alive)
            (link,) = links_of(sessions)
            sessions[0].drone.commands.request_stream(ATTITUDE, 20)
            exchange_until(sessions, lambda: ATTITUDE in link.messages and link.messages[ATTITUDE].hz > 17)
            # REQUEST_DATA_STREAM as sent by MAVProxy: all streams at 4 Hz.
            station = drones.Sender(255, 230)
            link.send(station.frame(d.MAVLink_request_data_stream_message(drones.SYSTEM, 1, 0, 4, 1)))
            exchange_until(sessions, lambda: link.messages[ATTITUDE].hz < 16)
            exchange_until(sessions, lambda: link.messages[ATTITUDE].hz > 17)


def test_server_continues_after_the_job_that_started_it(tmp_path: Path) -> None:
    program = tmp_path / "agent.pyz"
    program.write_bytes(agent.content())
    with drone_at("tcp of one client") as connection:
        arguments = json.dumps({"connection": connection, "intervals_us": {}})
        argv = (sys.executable, str(program), "mavlink", arguments, str(tmp_path / "x.tlog"))
        with subprocess.Popen(argv, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, process_group=0) as recorder:
            assert recorder.stderr is not None
            while recorder.stderr.readline() != b"up, MAVLink\n":
                assert recorder.poll() is None
            with connected_sessions(connection) as sessions:
                (pid,) = servers(connection)
                os.killpg(recorder.pid, signal.SIGKILL)
                recorder.wait()
                exchange_until(sessions, lambda: sessions[0].drone.alive)
                assert servers(connection) == [pid]
        assert_nothing_remains(connection)
