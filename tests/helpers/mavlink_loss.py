"""Records MAVLink behind a router while the kernel drops messages, in a separate network namespace.

Arguments: the log to write, the duration in seconds, and the percentage of periodic messages to drop. The program
writes a JSON object with the counters of the kernel, the router and the recorder to standard output. It changes the
firewall of its namespace.
"""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import common as d

from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from tests.helpers import drones
from tests.helpers.mavlink_router import MavlinkRouter

RATE_HZ: Final = 20
STREAMS_WITHIN_S: Final = 60.0
PERIODIC: Final = (d.MAVLINK_MSG_ID_ATTITUDE, d.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
_RULES: Final = """\
table ip lossy {{
  counter periodic {{ }}
  counter dropped {{ }}
  chain dice {{
    numgen random mod 100 < {percent} counter name "dropped" drop
  }}
  chain incoming {{
    type filter hook input priority 0;
    udp sport {port} @th,120,24 {{ {kinds} }} counter name "periodic" goto dice
  }}
}}
"""
"""The id of a MAVLink 2 message is in bytes 7 to 9 of its frame, little-endian; the UDP header has 8 bytes."""


def message_id_hex(message_id: int) -> str:
    """The id of a message in the byte order in which the kernel compares it."""
    return "0x" + message_id.to_bytes(3, "little").hex()


def wait_for_streams(log: Path) -> None:
    """Wait until the log has a message of each stream; the log does not show losses before the first message."""
    deadline_s = time.monotonic() + STREAMS_WITHIN_S
    # The id of a message is in bytes 7 to 9 of its MAVLink 2 frame, which starts with 0xfd.
    headers = [re.compile(rb"\xfd.{6}" + re.escape(kind.to_bytes(3, "little")), re.DOTALL) for kind in PERIODIC]
    while not all(header.search(log.read_bytes()) for header in headers):
        assert time.monotonic() < deadline_s, "a stream did not start"
        time.sleep(0.01)


def counters() -> dict[str, int]:
    """The packet count of each named counter."""
    completed = subprocess.run(("nft", "-j", "list", "counters"), capture_output=True, text=True, check=True)
    entries = [entry["counter"] for entry in json.loads(completed.stdout)["nftables"] if "counter" in entry]
    return {entry["name"]: entry["packets"] for entry in entries}


def other_station(port: int, stop: threading.Event) -> None:
    """Send commands as another ground station; the router does not forward their acknowledgements to the recorder."""
    sender = drones.Sender(255, 190)
    request = d.MAVLink_command_long_message(
        *(drones.SYSTEM, 1, d.MAV_CMD_REQUEST_MESSAGE, 0, d.MAVLINK_MSG_ID_AUTOPILOT_VERSION, *(0,) * 6)
    )
    with socket.create_connection(("127.0.0.1", port)) as stream:
        stream.settimeout(0.2)
        while not stop.wait(0.25):
            stream.sendall(sender.frame(drones.beat()) + sender.frame(request))
            stream.recv(65_536)


def main(log: Path, duration_s: float, percent: int) -> dict[str, Any]:
    """Record messages; return the counts."""
    subprocess.run(("ip", "link", "set", "lo", "up"), check=True)
    stop = threading.Event()
    with drones.at_udp(firmware=ARDUCOPTER) as port, MavlinkRouter(port) as router:
        intervals_us = {str(message_id): round(1e6 / RATE_HZ) for message_id in PERIODIC}
        request = json.dumps({"connection": f"udpout:127.0.0.1:{router.udp}", "intervals_us": intervals_us})
        argv = (sys.executable, "-m", "fieldkit.agent", "mavlink", request, str(log))
        station_thread = threading.Thread(target=other_station, args=(router.tcp, stop))
        with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as recorder:
            try:
                assert recorder.stderr is not None
                while recorder.stderr.readline() != b"up, MAVLink\n":
                    assert recorder.poll() is None
                station_thread.start()
                wait_for_streams(log)
                kinds = ", ".join(map(message_id_hex, PERIODIC))
                rules = _RULES.format(percent=percent, port=router.udp, kinds=kinds)
                subprocess.run(("nft", "-f", "-"), input=rules.encode(), check=True)
                time.sleep(duration_s)
                subprocess.run(("nft", "flush", "chain", "ip", "lossy", "incoming"), check=True)
                time.sleep(0.5)  # later messages reveal that the last dropped one is missing
                recorder.send_signal(signal.SIGINT)
                report, _ = recorder.communicate(timeout=60)
            finally:
                recorder.kill()
                stop.set()
                station_thread.join()
        return {**counters(), "withheld": router.withheld, "ended_us": json.loads(report)["ended_us"]}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main(Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))))
