"""List the possible connections to an autopilot on a computer, and test one of them."""

from __future__ import annotations

import glob
import json
import sys
import threading
import time
from contextlib import closing
from typing import Iterator

from fieldkit.agent.autopilots.autopilot import PREFLIGHT
from fieldkit.agent.flying.session import AutopilotSession

_HEARTBEAT_TIMEOUT_S = 5.0
_POLL_S = 0.1
_SERIAL_PATTERNS = ("/dev/serial/by-id/*", "/dev/ttyACM*", "/dev/ttyUSB*", "/dev/ttyAMA*", "/dev/ttyTHS*")
_TCP_PORTS, _UDP_PORTS = range(5760, 5764), range(14540, 14561)
"""Ports of mavlink-router and of simulated autopilots, according to their documentation."""
_LISTENING = "0A"
"""State of a listening socket (Linux, include/net/tcp_states.h)."""


def candidates() -> Iterator[str]:
    """Yield the serial lines and open ports of this computer to which autopilots are usually connected."""
    for pattern in _SERIAL_PATTERNS:
        yield from sorted(glob.glob(pattern))  # noqa: PTH207 (Python 3.8)
    yield from (f"TCP port {port}" for port in sorted(_open_ports("tcp") & set(_TCP_PORTS)))
    yield from (f"UDP port {port}" for port in sorted(_open_ports("udp") & set(_UDP_PORTS)))


def _open_ports(protocol: str) -> set[int]:
    """Return the ports on which programs of this computer listen (proc(5), /proc/net/tcp)."""
    with open(f"/proc/net/{protocol}", encoding="ascii") as file:  # noqa: PTH123
        # The second word of a line is ADDRESS:PORT in hexadecimal, the fourth word is the state.
        rows = [line.split() for line in file.readlines()[1:]]
    return {int(row[1].rpartition(":")[2], 16) for row in rows if protocol == "udp" or row[3] == _LISTENING}


def survey(connection: str, stop_event: threading.Event) -> int:
    """Test a connection through the link server; print the result and the candidates as a line of JSON; return 0.

    Raises:
        ValueError: The name of the connection is invalid.
    """
    system, error = 0, ""
    try:
        with closing(AutopilotSession(connection, component=PREFLIGHT)) as session:
            deadline_s = time.monotonic() + _HEARTBEAT_TIMEOUT_S
            while not session.drone.alive and not stop_event.is_set() and time.monotonic() < deadline_s:
                session.exchange(_POLL_S)
            system = session.drone.system
    except OSError as failure:
        error = failure.strerror or str(failure)
    sys.stdout.write(json.dumps({"error": error, "system": system, "candidates": list(candidates())}) + "\n")
    return 0
