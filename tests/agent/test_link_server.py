"""The link server as programs on a drone use it: each connection, faults of the server, restarts of a router."""

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

from fieldkit.agent.flying.talk import AutopilotSession
from fieldkit.agent.links import places, survey
from fieldkit.agent.links.client import SharedLink
from fieldkit.agent.mavlink_frames import ATTITUDE, LOCAL_POSITION_NED
from fieldkit.remote import agent
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from tests.helpers import drones
from tests.helpers.mavlink_router import MavlinkRouter

PATIENCE_S = 60.0
WAYS = ("udpout", "tcp", "tcp of one client", "udpin", "serial")


@contextmanager
def connected_by(way: str) -> Iterator[str]:
    """Let a drone be at a kind of connection."""
    if way == "serial":
        with drones.at_terminal() as path:
            yield f"{path}:115200"
    elif way == "udpin":
        with socket.socket(type=socket.SOCK_DGRAM) as drone, socket.socket(type=socket.SOCK_DGRAM) as free:
            drone.bind(("127.0.0.1", 0))
            free.bind(("127.0.0.1", 0))
            there = free.getsockname()
            free.close()
            with drones.flying(drone.fileno(), lambda frame: drone.sendto(frame, there), drone.recv) as autopilot:
                greeting = drones.Sender(255, 190).frame(drones.beat())
                list(autopilot.receive(greeting, drones.PEER, time.monotonic_ns()))
                yield f"udpin:127.0.0.1:{there[1]}"
    else:
        with drones.at_udp() as port, MavlinkRouter(port, 1 if way.endswith("client") else 100) as router:
            yield f"udpout:127.0.0.1:{router.udp}" if way == "udpout" else f"tcp:127.0.0.1:{router.tcp}"


@contextmanager
def talking(connection: str, clients: int = 1) -> Iterator[list[AutopilotSession]]:
    """Let clients talk with an autopilot over one connection."""
    talks: list[AutopilotSession] = []
    try:
        talks.extend(AutopilotSession(connection) for _ in range(clients))
        yield talks
    finally:
        for talk in talks:
            talk.close()


def links_of(talks: list[AutopilotSession]) -> list[SharedLink]:
    """Return the links that clients talk by."""
    links = [talk.drone.link for talk in talks]
    assert all(isinstance(link, SharedLink) for link in links)
    return [link for link in links if isinstance(link, SharedLink)]


def until(talks: list[AutopilotSession], holds: Callable[[], bool]) -> float:
    """Let clients talk until something holds; return how long that took."""
    began_s = time.monotonic()
    while not holds():
        assert time.monotonic() < began_s + PATIENCE_S
        for talk in talks:
            talk.turn(0.02)
    return time.monotonic() - began_s


def servers(connection: str) -> list[int]:
    """Return the processes that serve a connection."""
    found = list[int]()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"link" in words and json.dumps({"connection": connection}).encode() in words:
            found.append(int(path.parent.name))
    return found


def assert_nothing_remains(connection: str) -> None:
    """Wait until no server serves a connection, and none of its files is left."""
    end_s = time.monotonic() + PATIENCE_S
    while servers(connection) or any(Path(places.folder()).glob(f"{places.name(connection)}.*")):
        assert time.monotonic() < end_s, servers(connection)
        threading.Event().wait(0.05)


@pytest.mark.parametrize("way", WAYS)
def test_each_connection_carries_pilot_guard_recorder_and_check(way: str) -> None:
    with connected_by(way) as connection:
        with talking(connection, 4) as talks:
            until(talks, lambda: all(talk.drone.alive and talk.drone.position_m for talk in talks))
            assert len(servers(connection)) == 1
            talks[3].drone.command(512, 148)
            until(talks, lambda: 512 in talks[3].drone.command_results)
        assert_nothing_remains(connection)


@pytest.mark.parametrize("way", WAYS)
def test_the_survey_hears_the_autopilot_at_each_connection_beside_another_program(
    way: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with connected_by(way) as connection, talking(connection) as talks:
        until(talks, lambda: talks[0].drone.alive)
        assert survey.survey(connection, threading.Event()) == 0
        found = json.loads(capsys.readouterr().out)
        assert (found["error"], found["system"]) == ("", drones.SYSTEM)
        assert len(servers(connection)) == 1


def test_the_survey_names_a_connection_that_is_not_there_and_open_ports(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 14_557))
        assert survey.survey("tcp:127.0.0.1:1", threading.Event()) == 0
    found = json.loads(capsys.readouterr().out)
    assert "Connection refused" in found["error"]
    assert found["system"] == 0
    assert "UDP port 14557" in found["candidates"]


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP], ids=lambda fault: fault.name)
def test_a_server_that_was_killed_or_suspended_is_replaced(fault: signal.Signals) -> None:
    with connected_by("tcp of one client") as connection:
        with talking(connection, 3) as talks:
            until(talks, lambda: all(talk.drone.alive for talk in talks))
            talks[0].drone.request_stream(ATTITUDE, 20)
            links = links_of(talks)
            (pid,) = servers(connection)
            os.kill(pid, fault)
            until(talks, lambda: all(link.restarts for link in links))
            until(talks, lambda: all(link.connected for link in links))
            for talk in talks:
                talk.drone._position_s = float("-inf")
            until(talks, lambda: all(talk.drone.position_m for talk in talks))
            assert len(servers(connection)) == 1
            assert servers(connection) != [pid]
            # The request of the first client is made at the new server, too.
            until(talks, lambda: links[0].messages.get(ATTITUDE) is not None and links[0].messages[ATTITUDE].hz > 14)
        assert_nothing_remains(connection)


def test_a_router_that_restarts_ends_no_program() -> None:
    with drones.at_udp() as port, MavlinkRouter(port) as router:
        connection = f"tcp:127.0.0.1:{router.tcp}"
        with talking(connection, 2) as talks:
            until(talks, lambda: all(talk.drone.alive for talk in talks))
            links = links_of(talks)
            (pid,) = servers(connection)
            router.restart(2.0)
            until(talks, lambda: not any(link.connected for link in links))
            assert all(link.lost_since_s is not None for link in links)
            until(talks, lambda: all(link.connected for link in links))
            for talk in talks:
                talk.drone._position_s = float("-inf")
            until(talks, lambda: all(talk.drone.position_m for talk in talks))
            assert servers(connection) == [pid]
        assert_nothing_remains(connection)


def test_a_serial_device_that_disappears_and_comes_back_ends_no_program(tmp_path: Path) -> None:
    with drones.autopilot_at_usb(tmp_path / "ttyUSB0") as (usb, _):
        connection = f"{usb.path}:115200"
        with talking(connection, 2) as talks:
            until(talks, lambda: all(talk.drone.alive for talk in talks))
            talks[0].drone.request_stream(ATTITUDE, 20)
            links = links_of(talks)
            (pid,) = servers(connection)
            until(talks, lambda: ATTITUDE in links[0].messages and links[0].messages[ATTITUDE].hz > 14)
            usb.pull_out()
            until(talks, lambda: not any(link.connected for link in links))
            until(talks, lambda: "No such file" in links[0].error[1] and links[0].messages[ATTITUDE].hz == 0)
            usb.plug_in()
            until(talks, lambda: all(link.connected for link in links))
            until(talks, lambda: links[0].messages[ATTITUDE].hz > 14)
            assert servers(connection) == [pid]
        assert_nothing_remains(connection)


def test_the_end_of_one_client_does_not_slow_what_another_requested() -> None:
    with connected_by("udpout") as connection, talking(connection, 2) as talks:
        until(talks, lambda: all(talk.drone.alive for talk in talks))
        links = links_of(talks)
        talks[0].drone.request_stream(LOCAL_POSITION_NED, 10)
        talks[1].drone.request_stream(LOCAL_POSITION_NED, 40)
        until(talks, lambda: links[0].messages[LOCAL_POSITION_NED].hz > 28 if links[0].messages else False)
        talks[1].drone.request_stream(LOCAL_POSITION_NED, 0)
        until(talks, lambda: links[0].messages[LOCAL_POSITION_NED].hz < 14)
        until(talks, lambda: not links[1].messages)
        assert links[0].messages[LOCAL_POSITION_NED].interval_us == 100_000


def test_a_rate_that_another_station_changed_is_requested_again() -> None:
    with drones.at_udp(firmware=ARDUCOPTER) as port:
        connection = f"udpout:127.0.0.1:{port}"
        with talking(connection) as talks:
            until(talks, lambda: talks[0].drone.alive)
            (link,) = links_of(talks)
            talks[0].drone.request_stream(ATTITUDE, 20)
            until(talks, lambda: ATTITUDE in link.messages and link.messages[ATTITUDE].hz > 17)
            # REQUEST_DATA_STREAM, as MAVProxy sends it: all streams at 4 Hz.
            station = drones.Sender(255, 230)
            link.send(station.frame(d.MAVLink_request_data_stream_message(drones.SYSTEM, 1, 0, 4, 1)))
            until(talks, lambda: link.messages[ATTITUDE].hz < 16)
            until(talks, lambda: link.messages[ATTITUDE].hz > 17)


def test_the_server_outlives_the_job_that_started_it(tmp_path: Path) -> None:
    program = tmp_path / "agent.pyz"
    program.write_bytes(agent.content())
    with connected_by("tcp of one client") as connection:
        told = json.dumps({"connection": connection, "intervals_us": {}})
        argv = (sys.executable, str(program), "mavlink", told, str(tmp_path / "x.tlog"))
        with subprocess.Popen(argv, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, process_group=0) as recorder:
            assert recorder.stderr is not None
            while recorder.stderr.readline() != b"up, MAVLink\n":
                assert recorder.poll() is None
            with talking(connection) as talks:
                (pid,) = servers(connection)
                os.killpg(recorder.pid, signal.SIGKILL)
                recorder.wait()
                until(talks, lambda: talks[0].drone.alive)
                assert servers(connection) == [pid]
        assert_nothing_remains(connection)
