"""Cost of the discovery of topic participants: `python -m benchmarks.cosim_discovery`.

Twenty participants are on a circle of 10 m radius. Each publishes to the next one, and starts at a random time within
an interval. The benchmark prints, over several seeds, the IP packets that they send in the first second (mean), and
the time until all writers and readers have discovered each other, at least 1 s (median and range). The results do not
depend on the machine or its load.
"""

import math
import statistics
from itertools import pairwise
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.network.ip import Fragment
from sim_backends.network.radio import RadioNetwork
from sim_backends.network.topics.discovery import DiscoveryTiming
from sim_backends.network.topics.qos import TopicFlow
from sim_backends.network.topics.rtps_transport import Topics
from sim_backends.network.wire import Wire
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State

COUNT: Final = 20
RADIUS_M: Final = 10.0
SECOND_NS: Final = 10**9
STEP_NS: Final = SECOND_NS // 100
TIMEOUT_NS: Final = 60 * SECOND_NS
STANDARD: Final = "802.11n"
SEEDS: Final = range(1, 7)

ROWS: Final = ((0.0, None), (0.1, None), (5.0, None), (0.0, "g6"), (0.1, "g6"), (1.0, "g6"))
"""Interval in seconds in which the participants start, and the mode of all frames; None for Linux's rate control."""


def discover(within_s: float, mode: str | None, seed: int) -> tuple[int, float]:
    """Return the number of packets in the first second, and the time until discovery was complete in seconds.

    The time is at least 1 s, and infinite if discovery was not complete after `TIMEOUT_NS`.
    """
    names = [f"r{number}" for number in range(COUNT)]
    places_m = {name: _place_m(number) for number, name in enumerate(names)}
    starts_ns = {
        name: int(RandomStream(seed, name, "participant's start").draw(0) * within_s * SECOND_NS) for name in names
    }
    flows = {f"{source} to {target}": TopicFlow(source, target) for source, target in pairwise([*names, names[0]])}
    topics: list[Topics] = []
    sent_ns: list[int] = []

    def log(now_ns: int, host: str, fragment: Fragment) -> None:
        if fragment.packet.source == host:
            sent_ns.append(now_ns)

    antenna = Antenna(STANDARD if mode is None else "802.11g", 15.0, -92.0)
    options = RadioOptions.model_validate({"mode": mode} if mode else {})
    radio = WifiInWorld[Fragment](seed, options, dict.fromkeys(names, antenna), None)

    def transport(wire: Wire) -> Topics:
        topics.append(Topics(wire, flows, discovery=DiscoveryTiming(starts_ns=starts_ns)))
        return topics[0]

    network = RadioNetwork(radio, names, transports={"topic": transport})
    network.log_ip(log)
    states = {name: State(place_m) for name, place_m in places_m.items()}
    for to_ns in range(STEP_NS, TIMEOUT_NS + 1, STEP_NS):
        network.advance(to_ns, (), states)
        if to_ns >= SECOND_NS and topics[0].is_matched:
            return sum(at_ns < SECOND_NS for at_ns in sent_ns), to_ns / SECOND_NS
    return sum(at_ns < SECOND_NS for at_ns in sent_ns), math.inf


def _place_m(number: int) -> Vector:
    angle = math.tau * number / COUNT
    return RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), 1.0


def main() -> None:
    """Print a row per start interval and mode."""
    print(f"{COUNT} participants, {COUNT * (COUNT - 1)} pairs of participants")
    for within_s, mode in ROWS:
        packets, after_s = zip(*(discover(within_s, mode, seed) for seed in SEEDS), strict=True)
        print(
            f"start within {within_s:g} s, {mode or STANDARD}: {statistics.mean(packets):,.0f} packets in the first "
            f"second; discovery complete after {statistics.median(after_s):.1f} s, {min(after_s):.1f} to "
            f"{max(after_s):.1f}"
        )


if __name__ == "__main__":
    main()
