"""How much memory a run will take, and how much there is."""

import math
from pathlib import Path
from typing import Final

from sim_backends.cosim.scenario.schema import CosimScenario

PACKET_BYTES: Final = 1200
"""What the record of a packet takes: 1000 to 1130 bytes were measured over 20,000 packets of `baylands`."""
WINDOW_BYTES: Final = 40
"""What the end of a window takes: an integer and its place in a list."""
PAIR_BYTES: Final = 1600
"""What the radio takes at most for two stations: 1540 to 1660 bytes were measured while 100 to 300 got it."""
EVENTS_PER_PACKET: Final = 10
"""Most windows for each packet where each event of the network ends one; 7 were measured with `baylands`."""

MEMINFO: Final = Path("/proc/meminfo")


def needed_bytes(scenario: CosimScenario) -> int:
    """Return about how much memory a run takes at most, its record and its radio, whatever its policy."""
    packets = sum(one.packets(scenario.duration) for one in scenario.traffic)
    windows = scenario.duration / scenario.physics.step + packets * EVENTS_PER_PACKET
    return round(packets * PACKET_BYTES + windows * WINDOW_BYTES) + radio_bytes(scenario)


def radio_bytes(scenario: CosimScenario) -> int:
    """Return about how much of it the radio takes at most, which grows with the pairs of agents."""
    return 0 if scenario.radio.fixed else math.comb(len(scenario.agents), 2) * PAIR_BYTES


def available_bytes() -> int | None:
    """Return how much memory this machine has left; None where it does not say."""
    try:
        lines = MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
