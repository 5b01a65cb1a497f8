"""Time that a mesh takes to find another path: `python -m benchmarks.studies.mesh_losses [--losses N]`, as root.

Three labs run at the same time. Each has a path of three hops from the sender to the receiver, and a second path. The
second path has four hops in the first lab, which has no fading, three hops in the second lab, and four hops in the
third lab; these two have fading. The first robot on the used path is switched off until the receiver answers a ping
of the sender again, or for at most `PATIENCE_S`. Then it is switched on again. The next loss (a robot that is
switched off) follows when packets use this robot again. At the end the program prints a table of the times without an
answer. 40 losses take about half an hour.
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.studies.mesh import BOUND_HELLOS
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.deadline import Deadline
from fieldkit.lab.robots import LabRobot
from fieldkit.remote.shell import Shell
from fieldkit.remote.ssh import SshShell
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.running_robots import running_robots
from sim_backends.world.world import load_world

HELLO_S: Final = 0.5
"""Hello interval of babeld."""
SETTLE_S: Final = 10.0
"""Time after switching a robot on before its route is checked: more than babeld's history of 16 hellos."""

PATIENCE_S: Final = 100.0
"""Maximum time for which a robot stays switched off."""
RETURN_S: Final = 600.0
"""Time within which packets must use the robot again."""
ANTENNA_M: Final = 0.2

Places = Mapping[str, tuple[float, float]]

THREE_HOPS: Final[Places] = {"sender": (0, 0), "first": (35, -60), "last": (95, -60), "receiver": (130, 0)}
THREE_AND_FOUR_HOPS: Final[Places] = {**THREE_HOPS, "left": (20, 75), "middle": (75, 95), "right": (130, 75)}
TWICE_THREE_HOPS: Final[Places] = {**THREE_HOPS, "left": (35, 60), "right": (95, 60)}


@dataclass(frozen=True)
class Detour:
    """A lab with two paths.

    Attributes:
        label: Description of the paths.
        places: Positions of robots, metres east and north.
        lost: Robots to switch off if they are the next hop of the sender.
        fading: True if the radio fades.
    """

    label: str
    places: Places
    lost: tuple[str, ...]
    fading: bool


DETOURS: Final = (
    Detour("paths of three and four hops", THREE_AND_FOUR_HOPS, ("first",), fading=False),
    Detour("two paths of three hops", TWICE_THREE_HOPS, ("first", "left"), fading=True),
    Detour("paths of three and four hops", THREE_AND_FOUR_HOPS, ("first",), fading=True),
)


@dataclass(frozen=True)
class DetourLab:
    """The running lab of a detour.

    Attributes:
        robots: Robots by name.
        shell: Shell on the sender.
    """

    robots: Mapping[str, EmulatedRobot]
    shell: Shell

    def is_reachable(self, within_s: float) -> bool:
        """Ping the receiver until it answers; return True if it answers within `within_s`."""
        script = 'until ping -n -c 1 -W 0.2 "$0" >/dev/null 2>&1; do sleep 0.05; done'
        argv = ("timeout", str(within_s), "sh", "-c", script, self._address("receiver"))
        return self.shell.run(argv, deadline=Deadline.after(within_s + 60), check=False).exit_code == 0

    def next_hop(self) -> str:
        """Return the name of the robot that is the sender's next hop; empty if the receiver has no route or is it."""
        argv = ("ip", "-4", "route", "show", self._address("receiver"), "proto", "babel")
        words = self.shell.run(argv, deadline=Deadline.after(60)).stdout.decode().split()
        via = words[words.index("via") + 1] if "via" in words else ""
        return next((name for name in self.robots if self._address(name) == via), "")

    def _address(self, name: str) -> str:
        return self.robots[name].spec.ip


@contextmanager
def lab(detour: Detour) -> Iterator[DetourLab]:
    """Yield the robots of a detour."""
    profile = schema.load(Path(__file__).parent / "mesh" / "box.yaml", RobotProfile)
    robots = {name: LabRobot(name, profile, f"10.42.0.{number}", ()) for number, name in enumerate(detour.places, 1)}
    mesh = {"protocol": "babel", "hello": f"{HELLO_S}s"}
    options = EmulatedOptions.model_validate({"radio": {"fading": detour.fading}, "mesh": mesh})
    with running_robots(
        robots, options=options, world=load_world("open"), ros=RosChoice.BUILTIN, seed=1
    ) as lab_robots:
        lab_robots.medium.place({name: (*place, ANTENNA_M) for name, place in detour.places.items()})
        sender = SshShell(
            "sender",
            connect=lab_robots.robots["sender"].connect,
            user=USER,
            host_key=lab_robots.host_keys["sender"],
            private_key=lab_robots.private_key,
        )
        with closing(sender):
            yield DetourLab(lab_robots.robots, sender)


def healing_time_s(detour_lab: DetourLab, lost: Sequence[str]) -> float | None:
    """Wait until the next hop is one of `lost`, and switch it off; return the time until the receiver answers again.

    Returns:
        Seconds, or None if it is longer than `PATIENCE_S`.

    Raises:
        TimeoutError: Packets did not use one of these robots within `RETURN_S`.
    """
    route_deadline = Deadline.after(RETURN_S)
    time.sleep(SETTLE_S)
    while (hop := detour_lab.next_hop()) not in lost or not detour_lab.is_reachable(1.0):
        if route_deadline.expired:
            raise TimeoutError(f"packets do not use {' or '.join(lost)}, but {hop or 'no robot'}")
        time.sleep(1.0)
    detour_lab.robots[hop].switch_off()
    started_s = time.monotonic()
    try:
        return time.monotonic() - started_s if detour_lab.is_reachable(PATIENCE_S) else None
    finally:
        detour_lab.robots[hop].switch_on()


def healing_times_s(detour_lab: DetourLab, detour: Detour, losses: int) -> list[float | None]:
    """Return `healing_time_s` of each loss, and print each result."""
    times_s = []
    for number in range(losses):
        times_s.append(healing_time_s(detour_lab, detour.lost))
        print(f"{detour.label}, fading {detour.fading}, {number + 1}/{losses}: {times_s[-1]}", file=sys.stderr)
    return times_s


def row(detour: Detour, times_s: Sequence[float | None]) -> str:
    """Return a line of the table. A time longer than `PATIENCE_S` counts as `PATIENCE_S` in the median."""
    bound_s = BOUND_HELLOS * HELLO_S
    in_order = sorted(PATIENCE_S if time_s is None else time_s for time_s in times_s)
    most = f"not in {PATIENCE_S:g} s" if None in times_s else f"{in_order[-1]:.1f} s"
    above = sum(time_s > bound_s for time_s in in_order)
    fading = "yes" if detour.fading else "no"
    return f"| {detour.label} | {fading} | {len(times_s)} | {statistics.median(in_order):.1f} s | {most} | {above} |"


def main() -> None:
    """Switch robots off in all labs, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--losses", type=int, default=40, help="how often a robot is switched off in each lab")
    options = parser.parse_args()
    load_before = os.getloadavg()[0]
    with ExitStack() as stack:
        labs = [stack.enter_context(lab(detour)) for detour in DETOURS]
        pool = stack.enter_context(ThreadPoolExecutor(len(labs)))
        times_by_lab = list(pool.map(healing_times_s, labs, DETOURS, [options.losses] * len(labs)))
    bound_s = BOUND_HELLOS * HELLO_S
    print(f"| paths | fading | losses | median time | longest time | losses with more than {bound_s:.2f} s |")
    print("| --- " * 6 + "|")
    print("\n".join(map(row, DETOURS, times_by_lab)))
    print(f"load {load_before:.1f} before, {os.getloadavg()[0]:.1f} after")


if __name__ == "__main__":
    main()
