"""A flight by MAVProxy, as a program that runs on a robot: `python -m tests.helpers.mavproxy_flight HOST PORT LOSS`.

MAVProxy's commands are typed at a terminal, one behind what must have come before it, over a link that loses this
share of the datagrams each way. Whether the drone does it another connection tells, which loses nothing. Prints one
line of JSON.
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

from tests.helpers.mavsdk_flight import CORNERS_M, HEIGHT_M, M_PER_DEGREE, PATIENCE_S, lossy, until

PROGRAM: Final = Path(sys.executable).with_name("mavproxy.py")
LOADED: Final = b"Loaded 4 waypoints in "
ARMED: Final = b"COMPONENT_ARM_DISARM: ACCEPTED"
DISARMED: Final = b"DISARMED"
"""What MAVProxy says once the drone has answered, or no longer says that it is armed."""
_WAYPOINT: Final = 16
_RELATIVE: Final = 3
_RETRY_S: Final = 3.0
NEAR_M: Final = 0.3
"""As near to a corner as a mission goes on to the next one."""


@dataclass
class Seen:
    """What the drone itself tells, by its own connection."""

    armed: bool = False
    home: tuple[float, float] = (math.nan, math.nan)
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    items: int = 0
    current: int = 0
    nearest_m: list[float] = field(default_factory=lambda: [math.inf] * len(CORNERS_M))

    def take(self, message: Any) -> None:  # noqa: ANN401 (of pymavlink)
        """Take what a message tells."""
        match message.get_type():
            case "HEARTBEAT":
                self.armed = bool(message.base_mode & 128)
            case "HOME_POSITION":
                self.home = message.latitude / 1e7, message.longitude / 1e7
            case "MISSION_CURRENT":
                self.items, self.current = message.total, message.seq
            case "LOCAL_POSITION_NED":
                self.place_m = message.x, message.y, -message.z
                far_m = [math.dist(self.place_m, (*corner, HEIGHT_M)) for corner in CORNERS_M]
                self.nearest_m = [min(pair) for pair in zip(self.nearest_m, far_m, strict=True)]


def watch(host: str, port: str, seen: Seen) -> None:
    """Take what the drone tells, for ever."""
    drone = mavutil.mavlink_connection(f"udpout:{host}:{port}", source_system=253)
    while True:
        drone.mav.heartbeat_send(6, 8, 0, 0, 0)
        if (message := drone.recv_match(blocking=True, timeout=0.5)) is not None:
            seen.take(message)


@contextmanager
def mavproxy(port: int, folder: str) -> Iterator[tuple[Callable[[str], int], bytearray]]:
    """Run MAVProxy at a terminal; give what types a line, and what it has said."""
    ours, theirs = pty.openpty()
    said = bytearray()
    argv = (sys.executable, str(PROGRAM), f"--master=udpout:127.0.0.1:{port}", "--state-basedir", folder)
    with subprocess.Popen(argv, stdin=theirs, stdout=theirs, stderr=theirs, cwd=folder) as program:
        os.close(theirs)

        def listen() -> None:
            try:
                while piece := os.read(ours, 4096):
                    said.extend(piece)
            except OSError:  # it has ended
                return

        listener = threading.Thread(target=listen)
        listener.start()
        try:
            yield lambda line: os.write(ours, line.encode() + b"\n"), said
        finally:
            program.kill()
            program.wait()
            listener.join()
            os.close(ours)


def mission(home: tuple[float, float]) -> str:
    """Return a file of waypoints (QGC WPL 110): above home, then the corners."""
    lines = [
        f"{number}\t{number == 0:d}\t{_RELATIVE}\t{_WAYPOINT}\t0\t0.3\t0\t0\t"
        f"{home[0] + north_m / M_PER_DEGREE:.8f}\t{home[1] + east_m / M_PER_DEGREE:.8f}\t{HEIGHT_M}\t1"
        for number, (north_m, east_m) in enumerate(((0.0, 0.0), *CORNERS_M))
    ]
    return "\n".join(["QGC WPL 110", *lines, ""])


def fly(port: int, seen: Seen) -> dict[str, object]:
    """Fly, and return what was seen."""
    until(lambda: not math.isnan(seen.home[0]))
    with tempfile.TemporaryDirectory() as folder, mavproxy(port, folder) as (type_line, said):

        def typed(line: str, done: Callable[[], bool]) -> None:
            """Type a line until it is done; MAVProxy says a command once, and a link may lose it."""
            end_s, next_s = time.monotonic() + PATIENCE_S, 0.0
            while not done():
                if time.monotonic() > end_s:
                    raise TimeoutError(f"{line}: {said[-2000:].decode(errors='replace')}")
                if time.monotonic() > next_s:
                    type_line(line)
                    next_s = time.monotonic() + _RETRY_S
                time.sleep(0.05)

        until(lambda: b"Detected vehicle" in said)
        Path(folder, "corners.txt").write_text(mission(seen.home), encoding="ascii")
        # Their answers may be lost, too, and both can be said again; a take-off in the air would be refused.
        typed("wp load corners.txt", lambda: LOADED in said and seen.items == 1 + len(CORNERS_M))
        typed("arm throttle", lambda: ARMED in said and seen.armed)
        typed(f"takeoff {HEIGHT_M:g}", lambda: seen.place_m[2] > HEIGHT_M - 0.15)
        typed("long MISSION_START 0 0 0 0 0 0 0", lambda: seen.current > 0)
        until(lambda: seen.nearest_m[-1] < NEAR_M)
        typed("long DO_SET_MODE 157 4 6", lambda: seen.place_m[2] < HEIGHT_M / 2)  # PX4's AUTO and LAND
        until(lambda: DISARMED in said and not seen.armed)
        words = said.decode(errors="replace")
    return {"nearest_m": seen.nearest_m, "height_m": seen.place_m[2], "said": words}


def main(host: str, port: str, loss: str) -> None:
    """Fly the drone at this address."""
    seen = Seen()
    threading.Thread(target=watch, args=(host, port, seen), daemon=True).start()
    near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    near.bind(("127.0.0.1", 0))
    threading.Thread(target=lossy, args=(near, (host, int(port)), float(loss)), daemon=True).start()
    sys.stdout.write(json.dumps(fly(near.getsockname()[1], seen)) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
