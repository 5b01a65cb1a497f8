"""Estimate of the memory that a run needs, and the memory that is available."""

import math
from pathlib import Path
from typing import Final

from sim_backends.cosim.scenario.schema import CosimScenario

PACKET_BYTES: Final = 1200
"""Size of the record of a packet: 1000 to 1130 bytes were measured over 20,000 packets of `baylands`."""
WINDOW_BYTES: Final = 40
"""Size of the record of a window: an integer and its entry in a list."""
PAIR_BYTES: Final = 1600
"""Largest memory of the radio per pair of stations: 1540 to 1660 bytes were measured with 100 to 300 stations."""
EVENTS_PER_PACKET: Final = 10
"""Largest number of windows per packet if each network event ends a window; 7 were measured with `baylands`."""

MEMINFO: Final = Path("/proc/meminfo")


def needed_bytes(scenario: CosimScenario) -> int:
    """Return the approximate maximum memory that a run needs for its record and its radio, with any policy."""
    packets = sum(traffic.packets(scenario.duration) for traffic in scenario.traffic)
    windows = scenario.duration / scenario.physics.step + packets * EVENTS_PER_PACKET
    return round(packets * PACKET_BYTES + windows * WINDOW_BYTES) + radio_bytes(scenario)


def radio_bytes(scenario: CosimScenario) -> int:
    """Return the approximate maximum memory of the radio, which is proportional to the number of pairs of agents."""
    return 0 if scenario.radio.fixed else math.comb(len(scenario.agents), 2) * PAIR_BYTES


def available_bytes() -> int | None:
    """Return the available memory of this machine; None if the system does not report it."""
    try:
        lines = MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
