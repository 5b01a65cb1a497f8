"""A job in the virtual machine of `test_virtual_machine.py`: runs robots on an access point, prints results as JSON.

The lab has the three robots of a trial in topology `master`. Importing modules takes most of the time.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import load_profile
from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Role
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.linux_wifi import medium_program
from sim_backends.emulated.linux_wifi.radios import find_radios
from sim_backends.emulated.linux_wifi.wifi_client import WifiClient
from sim_backends.emulated.running_robots import RunningRobots, running_robots
from sim_backends.world.world import load_world

PROFILE = load_profile("turtlebot3_burger")
CAST = {
    Role.SENDER: Robot(name="r0", address="10.42.0.1", profile=PROFILE),
    Role.RECEIVER: Robot(name="r1", address="10.42.0.2", profile=PROFILE),
    Role.RELAY: Robot(name="r2", address="10.42.0.3", profile=PROFILE),
}
OPTIONS = {"fading": False, "shadowing_db": 0.0}
NEAR = {"r0": (0.0, 0.0, 1.0), "r1": (10.0, 0.0, 1.0), "r2": (5.0, 5.0, 1.0)}
FAR = {**NEAR, "r1": (9000.0, 0.0, 1.0)}
JOIN_S = 60.0


def run(*argv: str, may_fail: bool = False) -> str:
    """Return the output of a program; the job ends if it fails."""
    result = subprocess.run(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if result.returncode and not may_fail:
        sys.exit(f"{' '.join(argv)} failed with {result.returncode}: {result.stdout}")
    return result.stdout


class Lab:
    """The robots and their medium."""

    def __init__(self, running: RunningRobots[Role]) -> None:
        self.robots = running.robots
        assert isinstance(running.medium, WifiClient)
        self.medium = running.medium

    def run_on_robot(self, role: Role, *argv: str, may_fail: bool = False) -> str:
        """Run a program in the network of a robot."""
        return run("nsenter", "-t", str(self.robots[role].pid), "-n", *argv, may_fail=may_fail)

    def ping(self, count: int) -> int:
        """Return the number of replies from the receiver to the sender."""
        argv = ("ping", "-c", str(count), "-i", "0.2", "-W", "1", CAST[Role.RECEIVER].address)
        return int(self.run_on_robot(Role.SENDER, *argv, may_fail=True).split(" received")[0].rsplit(" ", 1)[-1])

    def wait_for_link(self) -> bool:
        end_s = time.monotonic() + JOIN_S
        while time.monotonic() < end_s:
            if self.ping(1):
                return True
        return False

    def totals(self) -> dict[str, Any]:
        """Return the totals of the link from the sender to the access point."""
        reply, _ = self.medium._worker.request({"do": "totals"})
        return next(link for link in reply["links"] if (link["transmitter"], link["receiver"]) == ("r0", "r2"))

    def dump_and_totals(self) -> tuple[str, object]:
        """Return the sender's station dump and the medium's totals, taken while no frame was sent in between."""
        while True:
            totals = self.totals()
            dump = self.run_on_robot(Role.SENDER, "iw", "dev", "wlan0", "station", "dump")
            if self.totals() == totals:
                return dump, totals


def start_medium(client: WifiClient) -> None:
    """Start another medium with the registered socket of this process, as a fork."""
    request_read, requests = os.pipe()
    reply_read, reply_write = os.pipe()
    if not os.fork():
        os.dup2(request_read, 0)
        os.dup2(reply_write, 1)
        sys.argv[1:] = ["--fd", str(client._kernel.fileno())]
        os._exit(medium_program.main())
    with os.fdopen(reply_read) as replies:
        messages: tuple[Mapping[str, object], ...] = (
            {"seed": 1, "radios": client._setups, "options": OPTIONS},
            {"do": "place", "positions": NEAR, "velocities": {}},
        )
        for message in messages:
            os.write(requests, json.dumps(message).encode() + b"\n")
            assert json.loads(replies.readline()) == {}


def main() -> None:
    results: dict[str, object] = {}

    def record_result(name: str, value: object) -> None:
        results[name] = value
        uptime_s = Path("/proc/uptime").read_text().split()[0]
        sys.stdout.write(f"{uptime_s} s: {name} = {value}\n")
        sys.stdout.flush()

    options = EmulatedOptions.model_validate({"wifi": "linux", "ros": "builtin", "radio": OPTIONS})
    world = load_world("open")
    record_result("imported", True)
    with running_robots(CAST, options=options, world=world, ros=RosChoice.BUILTIN, seed=1) as running:
        lab = Lab(running)
        record_result("access_point", lab.run_on_robot(Role.RELAY, "iw", "dev", "wlan0", "station", "dump"))
        lab.medium.place(NEAR)
        record_result("link", lab.run_on_robot(Role.SENDER, "iw", "dev", "wlan0", "link"))
        lab.ping(1)
        first_dump = lab.dump_and_totals()
        record_result("near", lab.ping(10))
        record_result("dumps_and_totals", (*first_dump, *lab.dump_and_totals()))
        lab.medium.place(FAR)
        record_result("far", lab.ping(3))
        lab.medium.place(NEAR)
        record_result("near_again", lab.wait_for_link())
        record_result("counts", lab.medium._worker.request({"do": "totals"})[0])
        os.kill(lab.medium.pid, signal.SIGSTOP)
        record_result("suspended", lab.ping(3))
        os.kill(lab.medium.pid, signal.SIGCONT)
        record_result("continued", lab.wait_for_link())
        os.kill(lab.medium.pid, signal.SIGKILL)
        record_result("killed", lab.ping(3))
        try:
            lab.medium.check_alive()
        except FieldkitError as error:
            record_result("error", str(error))
        start_medium(lab.medium)
        record_result("restarted", lab.wait_for_link())
    record_result("ended", True)
    end_s = time.monotonic() + JOIN_S
    while len(find_radios()) < 3 and time.monotonic() < end_s:
        time.sleep(0.2)
    record_result("radios", [radio.interface for radio in find_radios()])
    sys.stdout.write(f"RESULTS {json.dumps(results)}\n")


main()
