"""Record scans, associations, roaming and power save of Linux: `python -m benchmarks.kernel_roaming NAME`, as root.

The program runs in the virtual machine of `roaming_vs_kernel`. Its lab is described in `roaming_lab`. It prints one
event per line, with the time in microseconds:

    TIME,air,TRANSMITTER,RECEIVER,KIND,MHZ,BYTES,SLEEPS     a frame, when the kernel has passed it to the medium
    TIME,kernel,EVENT                                       a trace event of mac80211 at the robot
    TIME,mark,TEXT                                          a step of this program

SLEEPS is the power management bit. BYTES includes the FCS.
"""

import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random
from typing import Final

from benchmarks.experiment_packets import PacketSender
from benchmarks.roaming_lab import NEAR_M, ROBOT, Lab, log, mark
from sim_backends.emulated.linux_wifi.access_points import BRIDGE
from sim_backends.emulated.linux_wifi.radios import find_radios

WALK_M, FAR_M = 100.0, 90_000.0
"""Positions of the robot on the line along the access points: end of a walk, out of range."""
SPEED_M_S: Final = 1.0
CHANNELS: Final = 11
SCANS: Final = {"default": "simple:30:-65:300", "frequent": "simple:3:-55:10"}
"""Background scans of a walk: NetworkManager's, and more frequent ones."""

_FREQUENCIES_MHZ: Final = tuple(str(2412 + 5 * number) for number in range(CHANNELS))
_PAYLOAD_BYTES: Final = 100
_PLACE_S: Final = 0.2  # interval between positions during a walk
_PACKET_S: Final = 0.02  # interval of packets to the robot during a walk and during scans
_TRACING: Final = Path("/sys/kernel/tracing")
_TRACED: Final = ("drv_sw_scan_start", "drv_sw_scan_complete", "drv_config")
_TRACE_LINE: Final = re.compile(r"\s(\d+\.\d+): (\w+: .*)")


def log_trace() -> None:
    """Print the trace events of the kernel since the last call."""
    text = (_TRACING / "trace").read_text(errors="replace")
    for match in _TRACE_LINE.finditer(text):
        log(round(float(match[1]) * 1e6) * 1000, "kernel", match[2].replace(",", " "))
    (_TRACING / "trace").write_text("")


def prepare() -> None:
    """Mount the kernel's trace events, select some, and create the bridge."""
    if not any(_TRACING.iterdir()):
        _run("mount", "-t", "tracefs", "tracefs", str(_TRACING))
    (_TRACING / "trace_clock").write_text("mono")
    for event in _TRACED:
        (_TRACING / "events/mac80211" / event / "enable").write_text("1")
    for name in ("all", "default"):
        Path(f"/proc/sys/net/ipv6/conf/{name}/disable_ipv6").write_text("1")
    _run("ip", "link", "add", "name", BRIDGE, "type", "bridge")
    _run("ip", "address", "add", "10.42.0.1/24", "dev", BRIDGE)
    _run("ip", "link", "set", BRIDGE, "up")


def scan(lab: Lab, *words: str) -> None:
    """Scan with `iw` on all channels."""
    lab.run_on_robot("iw", "dev", lab.interface, "scan", "freq", *_FREQUENCIES_MHZ, *words)
    lab.wait(0.5)


class Downlink:
    """Sends packets to the robot over the bridge of the access points.

    Args:
        lab: The lab.
    """

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._sender = PacketSender(BRIDGE)

    def send(self, receiver: bytes) -> None:
        """Send a packet."""
        self._sender.send(receiver, _PAYLOAD_BYTES)

    def send_until(self, condition: Callable[[], bool]) -> None:
        """Send packets to the robot at fixed intervals until a condition is true."""
        next_s = time.monotonic()
        while not condition():
            self.send(self._lab.robot_address)
            next_s += _PACKET_S
            self._lab.wait(next_s - time.monotonic())


def record_scans(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Scan without an association, and during one: without packets, with packets to the robot, and from it."""
    del random
    for words in ((), ("passive",)):
        mark(f"scan {' '.join(words)}")
        scan(lab, *words)
    lab.connect("wpa2", channels=1)
    for words in ((), ("passive",)):
        mark(f"associated scan {' '.join(words)}")
        scan(lab, *words)
    mark("associated scan with packets to the robot")
    lab.start(f"{ROBOT}-scan", "iw", "dev", lab.interface, "scan", "freq", *_FREQUENCIES_MHZ)
    end_s = time.monotonic() + 6
    downlink.send_until(lambda: time.monotonic() > end_s)
    mark("associated scan with packets from the robot")
    lab.start(f"{ROBOT}-ping", "ping", "-i", "0.02", "-q", "10.42.0.1")
    lab.wait(1)
    scan(lab)
    lab.stop(f"{ROBOT}-ping")


def record_associations(lab: Lab, count: int) -> None:
    """Associate again several times."""
    for _ in range(count):
        mark("association")
        lab.reassociate()


def record_lost_frames(lab: Lab) -> None:
    """Associate while the medium loses a frame of the association."""
    for source, kind in (
        (ROBOT, "authentication-1"),
        ("left", "authentication-2"),
        (ROBOT, "reassociation-request"),
        ("left", "reassociation-response"),
        ("left", "eapol-1"),
        (ROBOT, "eapol-2"),
        ("left", "eapol-3"),
        (ROBOT, "eapol-4"),
    ):
        mark(f"loss of {source} {kind}")
        lab.lost.append((source, kind))
        lab.reassociate()
        lab.lost.clear()


def record_link_losses(lab: Lab, random: Random, count: int) -> None:
    """Take the robot out of range until it has lost its link, and back."""
    for _ in range(count):
        lab.wait(random.uniform(0.5, 1.5))
        connections = lab.connections
        mark("out of range")
        lab.place(FAR_M)
        lab.wait_for(lambda: lab.is_disconnected, "loss of the link")
        mark("in range")
        lab.place(NEAR_M)
        lab.wait_for(lambda: lab.connections > connections, "association after the loss of the link")  # noqa: B023


def record_walk(lab: Lab, downlink: Downlink, name: str) -> None:
    """Walk from the left access point to the right one, with packets to the robot."""
    lab.place(0.0)
    lab.connect("wpa2", channels=CHANNELS, scan=SCANS[name])
    lab.wait(2)
    mark(f"walk {name}")
    start_s = time.monotonic()
    placed_s = [start_s]

    def has_arrived() -> bool:
        now_s = time.monotonic()
        if now_s >= placed_s[0] + _PLACE_S:
            placed_s[0] += _PLACE_S
            lab.place(min((now_s - start_s) * SPEED_M_S, WALK_M))
        return (now_s - start_s) * SPEED_M_S > WALK_M

    downlink.send_until(has_arrived)
    mark("arrived")
    lab.place(NEAR_M)


def record_power_save(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Send packets and broadcasts to the robot while it sleeps, and packets that keep it awake."""
    lab.connect("wpa2", channels=1)
    lab.run_on_robot("iw", "dev", lab.interface, "set", "power_save", "on")
    for text, receiver, number in (("packet", lab.robot_address, 150), ("broadcast", b"\xff" * 6, 100)):
        for _ in range(number):
            lab.wait(random.uniform(0.5, 0.9))
            mark(text)
            downlink.send(receiver)
    lab.wait(1)
    for _ in range(20):
        mark("frequent packet")
        downlink.send(lab.robot_address)
        lab.wait(0.05)
    lab.wait(1)


def record_security(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Associate with WPA2, with and without losses, lose the link, and associate with WPA3."""
    del downlink
    lab.connect("wpa2", channels=3)
    record_associations(lab, 5)
    record_lost_frames(lab)
    record_link_losses(lab, random, 12)
    lab.start_access_points("wpa3")
    lab.connect("wpa3", channels=3)


def record_walks(lab: Lab, downlink: Downlink, random: Random) -> None:
    """Walk with each kind of background scan."""
    del random
    for name in SCANS:
        record_walk(lab, downlink, name)


RECORDINGS: Final[Mapping[str, Callable[[Lab, Downlink, Random], None]]] = {
    "scans": record_scans,
    "associations": record_security,
    "walks": record_walks,
    "power-save": record_power_save,
}
"""The recordings by name; each has a separate virtual machine."""


def main() -> None:
    """Make the recording that the command line names."""
    prepare()
    lab = Lab(find_radios()[:3])
    lab.start_access_points("wpa2")
    RECORDINGS[sys.argv[1]](lab, Downlink(lab), Random(1))
    log_trace()
    for name in (f"{ROBOT}-station", "hostapd"):
        lab.stop(name)


def _run(*argv: str) -> None:
    subprocess.run(argv, check=True)


if __name__ == "__main__":
    main()
