"""A deterministic run of two robots that pass each other and exchange packets; also a program that can be killed."""

import resource
import sys
from collections.abc import Sequence
from pathlib import Path

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.policies.window_policies import SlidingWindow
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.recording.manifest import RunSettings
from sim_backends.cosim.recording.recorder import RunRecorder
from sim_backends.cosim.run_record import Window, WindowObserver
from sim_backends.network.disc import Disc
from sim_backends.network.ip import Fragment
from sim_backends.network.wire import IpPacket
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import WayPoints

MS = 1_000_000
SETTINGS = RunSettings("robots: two\n", "sliding_window", {"window_s": 0.0033}, 1)


def passing_robots(observer: WindowObserver | None = None, policy: SyncPolicy | None = None) -> Coordinator:
    """A run of two robots that move through each other's range."""
    path = [(0.0, 0.0, 0.0), (1e6, 0.0, 0.0)]
    physics = Paths([WayPoints("a", path, 1.0), WayPoints("b", [(4.5, 1.0, 0.0), (-1e6, 1.0, 0.0)], 0.7)])
    agents = Agents(
        physics,
        {
            "a": Periodic("ab", "b", period_ns=3_700_001),
            "b": Periodic("ba", "a", period_ns=5_300_000, size_bytes=333),
        },
    )
    pairs = [("a", "b"), ("b", "a")]
    return Coordinator(agents, Disc(4.0, 1_234_567), policy or SlidingWindow(0.0033), pairs, observer=observer)


class ProgressRecorder:
    """Records a run, and prints the number of windows every 100 windows."""

    def __init__(self, recorder: RunRecorder) -> None:
        self._recorder = recorder
        self.begin = recorder.begin
        self._windows = 0

    def window(self, window: Window) -> None:
        for fate in window.entered_fates:
            program_packet = fate.packet
            packet = IpPacket(
                program_packet.source,
                program_packet.destination,
                "udp",
                28 + program_packet.size_bytes,
                program_packet.identity,
                None,
            )
            self._recorder.log_ip(
                program_packet.sent_ns, program_packet.source, Fragment(packet, 0, 0, 1, 0, packet.size_bytes)
            )
        self._recorder.window(window)
        self._windows += 1
        if self._windows % 100 == 0:
            sys.stdout.write(f"{self._windows}\n")
            sys.stdout.flush()


def main(arguments: Sequence[str]) -> None:
    """Record an endless run to a folder, optionally with a maximum file size in bytes."""
    if limit_bytes := [int(argument) for argument in arguments[1:]]:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes[0], limit_bytes[0]))
    with RunRecorder(Path(arguments[0]), SETTINGS, part_every_s=0.01) as recorder:
        passing_robots(ProgressRecorder(recorder)).advance(10**18)


if __name__ == "__main__":
    main(sys.argv[1:])
