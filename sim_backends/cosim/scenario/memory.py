"""How much memory a run will take, and how much there is."""

from pathlib import Path
from typing import Final

from sim_backends.cosim.scenario.schema import CosimScenario

PACKET_BYTES: Final = 1200
"""What the record of a packet takes: 1000 to 1130 bytes were measured over 20,000 packets of `baylands`."""
WINDOW_BYTES: Final = 40
"""What the end of a window takes: an integer and its place in a list."""
EVENTS_PER_PACKET: Final = 10
"""Most windows for each packet where each event of the network ends one; 7 were measured with `baylands`."""

MEMINFO: Final = Path("/proc/meminfo")


def needed_bytes(scenario: CosimScenario) -> int:
    """Return about how much memory the record of a run takes at most, whatever its policy."""
    packets = sum(one.packets(scenario.duration) for one in scenario.traffic)
    windows = scenario.duration / scenario.physics.step + packets * EVENTS_PER_PACKET
    return round(packets * PACKET_BYTES + windows * WINDOW_BYTES)


def available_bytes() -> int | None:
    """Return how much memory this machine has left; None where it does not say."""
    try:
        lines = MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
