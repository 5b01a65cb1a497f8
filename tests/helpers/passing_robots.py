"""Two robots that pass each other and talk: a run of which every number is known, also as a program to be killed."""

import resource
import sys
from collections.abc import Sequence
from pathlib import Path

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.observer import Window, WindowObserver
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.sliding_window import SlidingWindow
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.recording.manifest import About
from sim_backends.cosim.recording.recorder import RunRecorder
from sim_backends.network.disc import Disc
from sim_backends.network.ip import Fragment
from sim_backends.network.wire import IpPacket
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import WayPoints

MS = 1_000_000
ABOUT = About("robots: two\n", "sliding_window", {"window_s": 0.0033}, 1)


def passing_robots(observer: WindowObserver | None = None, policy: SyncPolicy | None = None) -> Coordinator:
    """Return a run of robots that go to and fro within range of each other and out of it."""
    way = [(0.0, 0.0, 0.0), (1e6, 0.0, 0.0)]
    physics = Paths([WayPoints("a", way, 1.0), WayPoints("b", [(4.5, 1.0, 0.0), (-1e6, 1.0, 0.0)], 0.7)])
    agents = Agents(
        physics,
        {
            "a": Periodic("ab", "b", period_ns=3_700_001),
            "b": Periodic("ba", "a", period_ns=5_300_000, size_bytes=333),
        },
    )
    pairs = [("a", "b"), ("b", "a")]
    return Coordinator(agents, Disc(4.0, 1_234_567), policy or SlidingWindow(0.0033), pairs, observer=observer)


class Told:
    """Says, in a line each, how many windows there were, and captures what was sent."""

    def __init__(self, recorder: RunRecorder) -> None:
        self._recorder = recorder
        self.begin = recorder.begin
        self._windows = 0

    def window(self, window: Window) -> None:
        for fate in window.entered:
            sent = fate.packet
            packet = IpPacket(sent.source, sent.destination, "udp", 28 + sent.size_bytes, sent.identity, None)
            self._recorder.log_ip(sent.sent_ns, sent.source, Fragment(packet, 0, 0, 1, 0, packet.size_bytes))
        self._recorder.window(window)
        self._windows += 1
        if self._windows % 100 == 0:
            sys.stdout.write(f"{self._windows}\n")
            sys.stdout.flush()


def main(arguments: Sequence[str]) -> None:
    """Record a run without end into a folder, in files no larger than a number of bytes, if one is named."""
    if limit_bytes := [int(one) for one in arguments[1:]]:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes[0], limit_bytes[0]))
    with RunRecorder(Path(arguments[0]), ABOUT, part_every_s=0.01) as recorder:
        passing_robots(Told(recorder)).advance(10**18)


if __name__ == "__main__":
    main(sys.argv[1:])
