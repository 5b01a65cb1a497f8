"""Runs in the virtual machine of `test_virtual_machine.py`: a trial, then two radios on the medium.

The trial, in the current folder, has the access point of its relay. The two radios are an ad-hoc network. The last
line has the results as JSON. Imports need most of the time, so that the trial and the medium share one process.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fieldkit.cli import main as fieldkit
from sim_backends.linux_wifi import medium_program
from sim_backends.linux_wifi.hwsim_socket import open_registered
from sim_backends.linux_wifi.radios import find_radios

NEAR = {"r0": [0, 0, 1], "r1": [10, 0, 1]}
FAR = {**NEAR, "r1": [9000, 0, 1]}
SETUP = {
    "seed": 1,
    "options": {"fading": False},
    "radios": {f"r{number}": {"address": f"42:00:00:00:{number:02d}:00"} for number in range(2)},
}
CELL = ("lab", "2437", "HT20", "fixed-freq", "02:11:22:33:44:55")
JOIN_S = 240.0


def run(*argv: str, may_fail: bool = False) -> str:
    """Return the output of a program; the job ends if it fails."""
    ended = subprocess.run(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if ended.returncode and not may_fail:
        sys.exit(f"{' '.join(argv)} failed with {ended.returncode}: {ended.stdout}")
    return ended.stdout


def within(robot: int, *argv: str, may_fail: bool = False) -> str:
    return run("ip", "netns", "exec", f"r{robot}", *argv, may_fail=may_fail)


def ping(robot: int, address: str, *, count: int) -> int:
    """Return the number of replies.

    Traffic class CS7 is sent in access category VO, which has no block-ACK sessions: in one, mac80211 ignores tries.
    """
    text = within(robot, "ping", "-c", str(count), "-i", "0.2", "-W", "1", "-Q", "224", address, may_fail=True)
    return int(text.split(" received")[0].rsplit(" ", 1)[-1])


def wait_for_link(robot: int, address: str) -> bool:
    end_s = time.monotonic() + JOIN_S
    while time.monotonic() < end_s:
        if ping(robot, address, count=1):
            return True
    return False


class Medium:
    """The medium program with the registered socket of this process; a fork, because imports need seconds here."""

    def __init__(self, fd: int) -> None:
        request_read, self._requests = os.pipe()
        reply_read, reply_write = os.pipe()
        self._pid = os.fork()
        if not self._pid:
            os.dup2(request_read, 0)
            os.dup2(reply_write, 1)
            sys.argv[1:] = ["--fd", str(fd)]
            os._exit(medium_program.main())
        os.close(request_read)
        os.close(reply_write)
        self._replies = os.fdopen(reply_read)
        self.request(SETUP)
        self.place(NEAR)

    def request(self, request: Mapping[str, object]) -> dict[str, Any]:
        os.write(self._requests, json.dumps(request).encode() + b"\n")
        reply: dict[str, Any] = json.loads(self._replies.readline())
        if "error" in reply:
            sys.exit(f"the medium refused {request}: {reply}")
        return reply

    def place(self, positions: Mapping[str, list[int]]) -> None:
        self.request({"do": "place", "positions": positions, "velocities": {}})

    def totals(self) -> dict[str, Any] | None:
        """Return the totals of the link from radio 0 to radio 1."""
        links = self.request({"do": "totals"})["links"]
        return next((link for link in links if (link["transmitter"], link["receiver"]) == ("r0", "r1")), None)

    def kill(self) -> None:
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)


def start_network() -> None:
    for number, radio in enumerate(find_radios()[:2]):
        run("ip", "netns", "add", f"r{number}")
        run("iw", "phy", radio.phy, "set", "netns", "name", f"r{number}")
        within(number, "ip", "link", "set", "lo", "up")
        within(number, "ip", "link", "set", radio.interface, "name", "wlan0")
        within(number, "ip", "addr", "add", f"10.0.0.{number + 1}/24", "dev", "wlan0")
        within(number, "iw", "dev", "wlan0", "set", "type", "ibss")
        within(number, "ip", "link", "set", "wlan0", "up")
        within(number, "iw", "dev", "wlan0", "ibss", "join", *CELL)


def station_and_totals(medium: Medium) -> tuple[str, object]:
    """Return the station dump of radio 0 and the medium's totals, taken while no frame was sent in between."""
    while True:
        before = medium.totals()
        dump = within(0, "iw", "dev", "wlan0", "station", "dump")
        if medium.totals() == before:
            return dump, before


def main() -> None:
    results: dict[str, object] = {}

    def note(name: str, value: object) -> None:
        results[name] = value
        uptime_s = Path("/proc/uptime").read_text().split()[0]
        sys.stdout.write(f"{uptime_s} s: {name} = {value}\n")
        sys.stdout.flush()

    note("trial", fieldkit(["trial", "los", "30ft", *sys.argv[1:]]))
    kernel = open_registered()
    medium = Medium(kernel.fileno())
    # Another netlink socket of this process, as of `getaddrinfo`: its end must not end the registration.
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as other:
        other.bind((0, 0))
        note("port_of_other_socket", (other.getsockname()[0], os.getpid()))
    start_network()
    note("ad_hoc", wait_for_link(0, "10.0.0.2"))
    note("near", ping(0, "10.0.0.2", count=10))
    medium.place(FAR)
    note("far", ping(0, "10.0.0.2", count=3))
    medium.place(NEAR)
    note("near_again", wait_for_link(0, "10.0.0.2"))
    note("dump_and_totals", station_and_totals(medium))
    note("counts", medium.request({"do": "totals"}))
    medium.kill()
    note("without_medium", ping(0, "10.0.0.2", count=3))
    medium = Medium(kernel.fileno())
    note("restarted", wait_for_link(0, "10.0.0.2"))
    sys.stdout.write(f"RESULTS {json.dumps(results)}\n")


main()
