"""A job in the virtual machine of `test_wifi_variants.py`: WPA3, monitor interfaces, meshes and roaming.

It prints results as JSON. The labs have three robots in topology `master`, or two robots and two access points.
"""

import json
import struct
import subprocess
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import load_profile
from fieldkit.core.model import Role, Vector
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.provisioning import profile_in_lab
from sim_backends.emulated.running_robots import RunningRobots, running_robots
from sim_backends.world.world import load_world

PROFILE = load_profile("turtlebot3_burger")
ADDRESSES = {Role.SENDER: "10.42.0.1", Role.RECEIVER: "10.42.0.2", Role.RELAY: "10.42.0.3"}
CAST = {
    role: Robot(name=f"r{number}", address=address, profile=PROFILE)
    for number, (role, address) in enumerate(ADDRESSES.items())
}
RADIO = {"fading": False, "shadowing_db": 0.0}
TRIANGLE: dict[str, Vector] = {"r0": (0.0, 0.0, 1.0), "r1": (10.0, 0.0, 1.0), "r2": (5.0, 5.0, 1.0)}
# At this distance from the access point, frames at higher rates are lost.
EDGE: dict[str, Vector] = {**TRIANGLE, "r2": (75.0, 0.0, 1.0)}
# The range of these radios is 91 m in the open.
ROW: dict[str, Vector] = {"r0": (0.0, 0.0, 1.0), "r1": (140.0, 0.0, 1.0), "r2": (70.0, 0.0, 1.0)}
# The robot in the middle of the row is out of range.
GAP: dict[str, Vector] = {**ROW, "r2": (9000.0, 0.0, 1.0)}
ACCESS_POINTS = {"left": {"at_m": (0, 0), "height": "1m"}, "right": {"at_m": (120, 0), "height": "1m"}}
ROAMING = {"short": "2s", "threshold_dbm": -65, "long": "60s", "channels": 3}
START: dict[str, Vector] = {"r0": (5.0, 0.0, 1.0), "r1": (5.0, 5.0, 1.0)}
END: dict[str, Vector] = {**START, "r0": (80.0, 0.0, 1.0)}
JOIN_S = 60.0
CAPTURE = ("tcpdump", "-i", "mon0", "-y", "IEEE802_11_RADIO", "-c", "20", "-e", "-n", "--immediate-mode")

FILE_CAPTURE = ("tcpdump", "-i", "mon0", "-y", "IEEE802_11_RADIO", "-U", "-w", "-", "--immediate-mode")

Running = RunningRobots[Role]


def run_on_robot(running: Running, role: Role, *argv: str) -> str:
    """Return the output of a program in the network of a robot."""
    command = ("nsenter", "-t", str(running.robots[role].pid), "-n", *argv)
    return subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False).stdout


def ping(running: Running, count: int) -> int:
    """Return the number of replies from the receiver to the sender."""
    argv = ("ping", "-c", str(count), "-i", "0.2", "-W", "1", ADDRESSES[Role.RECEIVER])
    return int(run_on_robot(running, Role.SENDER, *argv).split(" received")[0].rsplit(" ", 1)[-1])


def wait_for_link(running: Running) -> bool:
    end_s = time.monotonic() + JOIN_S
    while time.monotonic() < end_s:
        if ping(running, 1):
            return True
    return False


def frames(capture: bytes) -> list[tuple[str, int, str]]:
    """Return frame control (hexadecimal), bytes without FCS, and receiver of each frame in a capture (radiotap)."""
    frame_facts, offset = [], 24
    while offset + 16 <= len(capture):
        (size_bytes,) = struct.unpack_from("<I", capture, offset + 8)
        packet = capture[offset + 16 : offset + 16 + size_bytes]
        frame = packet[int.from_bytes(packet[2:4], "little") :]
        frame_facts.append((frame[:2].hex(), len(frame), frame[4:10].hex(":")))
        offset += 16 + size_bytes
    return frame_facts


def access_point(running: Running) -> str:
    """Return the address of the sender's access point, or an empty text if it has none."""
    words = run_on_robot(running, Role.SENDER, "iw", "dev", "wlan0", "link").split()
    return words[2] if words[:2] == ["Connected", "to"] else ""


def wait_for_handover(running: Running, left_access_point: str) -> str:
    """Return the address of the sender's next access point."""
    end_s = time.monotonic() + JOIN_S
    while (current_access_point := access_point(running)) in {left_access_point, ""} and time.monotonic() < end_s:
        time.sleep(0.2)
    return current_access_point


@contextmanager
def lab(
    settings: dict[str, object],
    *,
    roles: Collection[Role] = tuple(CAST),
    mesh: dict[str, object] | None = None,
    **radio: object,
) -> Iterator[Running]:
    options = EmulatedOptions.model_validate(
        {"wifi": "linux", "ros": "builtin", "radio": {**RADIO, **radio}, "linux_wifi": settings, "mesh": mesh}
    )
    world = load_world("open")
    profile = profile_in_lab(PROFILE, options)
    cast = {role: robot.model_copy(update={"profile": profile}) for role, robot in CAST.items() if role in roles}
    with running_robots(cast, options=options, world=world, ros=RosChoice.BUILTIN, seed=1) as running:
        yield running


def main() -> None:
    results: dict[str, object] = {}

    def record_result(name: str, value: object) -> None:
        results[name] = value
        sys.stdout.write(f"{time.monotonic():.0f} s: {name} = {value}\n")
        sys.stdout.flush()

    with lab({"security": "wpa3", "monitor": True}) as running:
        running.medium.place(TRIANGLE)
        record_result("wpa3 link", wait_for_link(running))
        record_result("wpa3 stations", run_on_robot(running, Role.RELAY, "iw", "dev", "wlan0", "station", "dump"))
        capture = subprocess.Popen(
            ("nsenter", "-t", str(running.robots[Role.SENDER].pid), "-n", *CAPTURE),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        record_result("wpa3 ping", ping(running, 20))
        record_result("frames", capture.communicate(timeout=JOIN_S)[0])
        running.medium.place(EDGE)
        record_result("edge link", wait_for_link(running))
        edge = subprocess.Popen(
            ("nsenter", "-t", str(running.robots[Role.RELAY].pid), "-n", *FILE_CAPTURE),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        record_result("edge ping", ping(running, 20))
        edge.terminate()
        record_result("edge frames", frames(edge.communicate()[0]))
    with lab({"mesh": True}) as running:
        running.medium.place(ROW)
        record_result("mesh link", wait_for_link(running))
        record_result("mesh ping", ping(running, 20))
        record_result("paths", run_on_robot(running, Role.SENDER, "iw", "dev", "wlan0", "mpath", "dump"))
        record_result(
            "interfaces", {str(role): run_on_robot(running, role, "iw", "dev", "wlan0", "info") for role in CAST}
        )
        running.medium.place(GAP)
        record_result("mesh without relay", ping(running, 3))
        running.medium.place(ROW)
        record_result("mesh again", wait_for_link(running))
        running.robots[Role.SENDER].switch_off()
        running.robots[Role.SENDER].switch_on()
        record_result("mesh after switching", wait_for_link(running))
    pair = (Role.SENDER, Role.RECEIVER)
    with lab({"monitor": True}, roles=pair, access_points=ACCESS_POINTS, roaming=ROAMING) as running:
        running.medium.place(START)
        record_result("roam link", wait_for_link(running))
        record_result("access point before", wait_for_handover(running, ""))
        events = subprocess.Popen(
            ("nsenter", "-t", str(running.robots[Role.SENDER].pid), "-n", "iw", "event", "-t"),
            stdout=subprocess.PIPE,
            text=True,
        )
        handover = subprocess.Popen(
            ("nsenter", "-t", str(running.robots[Role.SENDER].pid), "-n", *FILE_CAPTURE),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        running.medium.place(END)
        record_result("access point after", wait_for_handover(running, str(results["access point before"])))
        record_result("link over the bridge", wait_for_link(running))
        record_result("ping over the bridge", ping(running, 10))
        handover.terminate()
        record_result("handover", frames(handover.communicate()[0]))
        events.terminate()
        record_result("events", events.communicate()[0])
        record_result("scan", run_on_robot(running, Role.SENDER, "iw", "dev", "wlan0", "scan", "dump"))
    sys.stdout.write(f"RESULTS {json.dumps(results)}\n")


if __name__ == "__main__":
    main()
