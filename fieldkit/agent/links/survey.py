"""Which connections to an autopilot a computer has, and whether one of them works."""

from __future__ import annotations

import glob
import json
import sys
import threading
import time
from contextlib import closing
from typing import Iterator

from fieldkit.agent.autopilot import PREFLIGHT
from fieldkit.agent.flying.talk import AutopilotTalk

_HEARTBEAT_S = 5.0
_TURN_S = 0.1
_LINES = ("/dev/serial/by-id/*", "/dev/ttyACM*", "/dev/ttyUSB*", "/dev/ttyAMA*", "/dev/ttyTHS*")
_TCP_PORTS, _UDP_PORTS = range(5760, 5764), range(14540, 14561)
"""Ports of mavlink-router and of simulated autopilots, by their documentation."""
_LISTENS = "0A"
"""State of a listening socket (Linux, include/net/tcp_states.h)."""


def candidates() -> Iterator[str]:
    """Yield what autopilots are usually connected by, of what this computer has: serial lines, open ports."""
    for pattern in _LINES:
        yield from sorted(glob.glob(pattern))  # noqa: PTH207 (Python 3.8)
    yield from (f"TCP port {port}" for port in sorted(_open_ports("tcp") & set(_TCP_PORTS)))
    yield from (f"UDP port {port}" for port in sorted(_open_ports("udp") & set(_UDP_PORTS)))


def _open_ports(protocol: str) -> set[int]:
    """Return the ports at which programs of this computer listen (proc(5), /proc/net/tcp)."""
    with open(f"/proc/net/{protocol}", encoding="ascii") as file:  # noqa: PTH123
        rows = [line.split() for line in file.readlines()[1:]]
    return {int(row[1].rpartition(":")[2], 16) for row in rows if protocol == "udp" or row[3] == _LISTENS}


def survey(connection: str, over: threading.Event) -> int:
    """Open a connection by the link server, and print what was found as a line of JSON; return the exit code.

    Raises:
        ValueError: It is not the name of a connection.
    """
    system, error = 0, ""
    try:
        with closing(AutopilotTalk(connection, component=PREFLIGHT)) as talk:
            end_s = time.monotonic() + _HEARTBEAT_S
            while not talk.drone.alive and not over.is_set() and time.monotonic() < end_s:
                talk.turn(_TURN_S)
            system = talk.drone.system
    except OSError as failure:
        error = failure.strerror or str(failure)
    sys.stdout.write(json.dumps({"error": error, "system": system, "candidates": list(candidates())}) + "\n")
    return 0
