"""Test datagrams of the agent through real sockets on loopback, among foreign datagrams."""

import json
import socket
import subprocess
import sys
import threading

import pytest

from fieldkit.agent import datagrams
from fieldkit.agent.datagrams import DatagramPorts
from tests.helpers.paths import ROOT


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def ports() -> DatagramPorts:
    return DatagramPorts("127.0.0.1", "239.255.0.1", free_port(), free_port(), token="t1")


def test_each_sequence_number_is_counted_once_per_kind(ports: DatagramPorts) -> None:
    arguments = {"ports": vars(ports), "peers": [], "count": 3, "interval_s": 0.0, "limit_s": 60.0}
    command = [sys.executable, "-m", "fieldkit.agent", "datagrams", json.dumps(arguments)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "up\n"
        datagrams.send(ports, ["127.0.0.1"], 3, 0.0)
        datagrams.send(ports, ["127.0.0.1"], 2, 0.0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_socket:
            for foreign_datagram in (
                b"RTPS\x02\x03",
                b"",
                b"fieldkit t2 unicast 0 ",
                b"fieldkit t1 unicast 9 ",
                b"\xff" * 60_000,
            ):
                other_socket.sendto(foreign_datagram, ("127.0.0.1", ports.unicast_port))
        process.terminate()
        output, _ = process.communicate(timeout=60)
    assert json.loads(output) == {"127.0.0.1": {"unicast": 3, "fragmented": 3, "multicast": 3}}


def test_a_port_in_use_is_an_error(ports: DatagramPorts) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_socket:
        other_socket.bind(("127.0.0.1", ports.unicast_port))
        with pytest.raises(OSError, match="in use"):
            datagrams.receive(ports, threading.Event(), 1.0)
