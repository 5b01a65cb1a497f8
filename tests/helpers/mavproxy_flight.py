"""A flight with MAVProxy, run as a program on a robot: `python -m tests.helpers.mavproxy_flight HOST PORT LOSS`.

The program types each MAVProxy command at a terminal after it has received the result of the previous command. The
link loses the share LOSS of the datagrams in each direction. A second connection without losses shows the real state
of the drone. The program prints one line of JSON.
"""

import json
import math
import os
import pty
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from pymavlink import mavutil

from tests.helpers.mavsdk_flight import CORNERS_M, HEIGHT_M, M_PER_DEGREE, TIMEOUT_S, forward_with_losses, until

PROGRAM: Final = Path(sys.executable).with_name("mavproxy.py")
LOADED: Final = b"Loaded 4 waypoints in "
ARMED: Final = b"COMPONENT_ARM_DISARM: ACCEPTED"
DISARMED: Final = b"DISARMED"
"""Output of MAVProxy when the drone has confirmed the command, and when the drone reports that it is disarmed."""
_WAYPOINT: Final = 16
_RELATIVE: Final = 3
"""MAV_CMD_NAV_WAYPOINT, and MAV_FRAME_GLOBAL_RELATIVE_ALT: altitudes are relative to the home position."""
_RETRY_S: Final = 3.0
NEAR_M: Final = 0.3
"""Distance from a corner within which the mission continues to the next item."""


@dataclass
class DroneState:
    """State of the drone, received over a separate connection."""

    armed: bool = False
    home: tuple[float, float] = (math.nan, math.nan)
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    items: int = 0
    current: int = 0
    nearest_m: list[float] = field(default_factory=lambda: [math.inf] * len(CORNERS_M))

    def update(self, message: Any) -> None:  # noqa: ANN401 (of pymavlink)
        """Update the state from a MAVLink message."""
        match message.get_type():
            case "HEARTBEAT":
                self.armed = bool(message.base_mode & 128)
            case "HOME_POSITION":
                self.home = message.latitude / 1e7, message.longitude / 1e7
            case "MISSION_CURRENT":
                self.items, self.current = message.total, message.seq
            case "LOCAL_POSITION_NED":
                self.place_m = message.x, message.y, -message.z
                distances_m = [math.dist(self.place_m, (*corner, HEIGHT_M)) for corner in CORNERS_M]
                self.nearest_m = [min(pair) for pair in zip(self.nearest_m, distances_m, strict=True)]


def watch(host: str, port: str, state: DroneState) -> None:
    """Receive the state of the drone in an endless loop."""
    drone = mavutil.mavlink_connection(f"udpout:{host}:{port}", source_system=253)
    while True:
        drone.mav.heartbeat_send(6, 8, 0, 0, 0)
        if (message := drone.recv_match(blocking=True, timeout=0.5)) is not None:
            state.update(message)


@contextmanager
def mavproxy(port: int, folder: str) -> Iterator[tuple[Callable[[str], int], bytearray]]:
    """Run MAVProxy at a terminal; yield a function that types a line, and the output so far."""
    terminal, program_terminal = pty.openpty()
    output = bytearray()
    argv = (sys.executable, str(PROGRAM), f"--master=udpout:127.0.0.1:{port}", "--state-basedir", folder)
    with subprocess.Popen(
        argv, stdin=program_terminal, stdout=program_terminal, stderr=program_terminal, cwd=folder
    ) as program:
        os.close(program_terminal)

        def read_output() -> None:
            try:
                while data := os.read(terminal, 4096):
                    output.extend(data)
            except OSError:  # the program has ended
                return

        reader = threading.Thread(target=read_output)
        reader.start()
        try:
            yield lambda line: os.write(terminal, line.encode() + b"\n"), output
        finally:
            program.kill()
            program.wait()
            reader.join()
            os.close(terminal)


def mission(home: tuple[float, float]) -> str:
    """A waypoint file (QGC WPL 110): the home position, then the corners."""
    lines = [
        f"{number}\t{number == 0:d}\t{_RELATIVE}\t{_WAYPOINT}\t0\t0.3\t0\t0\t"
        f"{home[0] + north_m / M_PER_DEGREE:.8f}\t{home[1] + east_m / M_PER_DEGREE:.8f}\t{HEIGHT_M}\t1"
        for number, (north_m, east_m) in enumerate(((0.0, 0.0), *CORNERS_M))
    ]
    return "\n".join(["QGC WPL 110", *lines, ""])


def fly(port: int, state: DroneState) -> dict[str, object]:
    """Fly the mission; return the observations."""
    until(lambda: not math.isnan(state.home[0]))
    with tempfile.TemporaryDirectory() as folder, mavproxy(port, folder) as (type_line, output):

        def type_until(line: str, is_done: Callable[[], bool]) -> None:
            """Type a line repeatedly until it has taken effect; MAVProxy sends a command only once, and it may be
            lost.
            """
            end_s, next_s = time.monotonic() + TIMEOUT_S, 0.0
            while not is_done():
                if time.monotonic() > end_s:
                    raise TimeoutError(f"{line}: {output[-2000:].decode(errors='replace')}")
                if time.monotonic() > next_s:
                    type_line(line)
                    next_s = time.monotonic() + _RETRY_S
                time.sleep(0.05)

        until(lambda: b"Detected vehicle" in output)
        Path(folder, "corners.txt").write_text(mission(state.home), encoding="ascii")
        # The answers to the first two commands may be lost, and both commands can be repeated.
        type_until("wp load corners.txt", lambda: LOADED in output and state.items == 1 + len(CORNERS_M))
        type_until("arm throttle", lambda: ARMED in output and state.armed)
        type_until(f"takeoff {HEIGHT_M:g}", lambda: state.place_m[2] > HEIGHT_M - 0.15)
        type_until("long MISSION_START 0 0 0 0 0 0 0", lambda: state.current > 0)
        until(lambda: state.nearest_m[-1] < NEAR_M)
        type_until("long DO_SET_MODE 157 4 6", lambda: state.place_m[2] < HEIGHT_M / 2)  # PX4's AUTO and LAND
        until(lambda: DISARMED in output and not state.armed)
        output_text = output.decode(errors="replace")
    return {"nearest_m": state.nearest_m, "height_m": state.place_m[2], "output": output_text}


def main(host: str, port: str, loss: str) -> None:
    """Fly the drone at this address."""
    state = DroneState()
    threading.Thread(target=watch, args=(host, port, state), daemon=True).start()
    client_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client_socket.bind(("127.0.0.1", 0))
    threading.Thread(
        target=forward_with_losses, args=(client_socket, (host, int(port)), float(loss)), daemon=True
    ).start()
    sys.stdout.write(json.dumps(fly(client_socket.getsockname()[1], state)) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
