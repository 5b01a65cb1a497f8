"""Cost of a move in the medium, by the number of robots: `python -m benchmarks.moves [--json]`, as root.

The medium is the process that carries packets between emulated robots. For each world and number of robots, the
benchmark moves one robot by 0.1 m in each step (after 9.9 m it returns to its start), and measures the medium's
processor time per move, and the time until the medium answers, during which it forwards no packets. The reference
moves all robots in each step, so that all links are computed.
"""

import argparse
import json
import os
import statistics
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from benchmarks.medium import RADIO
from benchmarks.namespaces import Namespace
from fieldkit.core.model import Vector
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world

SIZES: Final = (2, 10, 50)
WORLDS: Final = ("lawn", "baylands")
STEPS: Final = 300
_TICK_S: Final = 1 / os.sysconf("SC_CLK_TCK")

Figures = dict[str, float]


def measure_moves(world: str, size: int, radio: RadioOptions, *, move_all: bool) -> Figures:
    """Return the cost of a step with `size` robots, which start 5 m apart, and of which one or all move."""
    with ExitStack() as stack:
        medium = stack.enter_context(MediumClient(radio, load_world(world), seed=1))
        places: dict[str, Vector] = {}
        for number in range(size):
            address = f"10.9.0.{number + 1}/24"
            fd = stack.enter_context(Namespace()).tun("wlan0", address)
            medium.attach(f"r{number}", address, RADIO, fd)
            os.close(fd)
            places[f"r{number}"] = 5.0 * (number % 7), 5.0 * (number // 7), 0.2
        medium.place(places)
        starts = dict(places)
        waited_s: list[float] = []
        before_s = _processor_s(medium.pid)
        for step in range(1, STEPS + 1):
            offset_m = 0.1 * (step % 100)
            for name in places if move_all else ("r0",):
                east_m, north_m, up_m = starts[name]
                places[name] = east_m + offset_m, north_m, up_m
            started_s = time.monotonic()
            medium.place(places, velocities_m_s={"r0": (1.0, 0.0, 0.0)})
            waited_s.append(time.monotonic() - started_s)
        return {
            "processor_ms": (_processor_s(medium.pid) - before_s) / STEPS * 1e3,
            "answer_median_ms": statistics.median(waited_s) * 1e3,
        }


def _processor_s(pid: int) -> float:
    # After the name in parentheses: utime and stime are fields 14 and 15 of proc(5).
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK_S


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="numbers of robots")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    print(f"load before: {os.getloadavg()[0]:.2f}", file=sys.stderr)
    radios = {"steady": RadioOptions(fading=False), "fading": RadioOptions(fading=True, shadowing_db=4.0)}
    table: dict[str, Figures] = {}
    for world in WORLDS:
        for name, radio in radios.items():
            for size in options.sizes:
                for moving in ("one", "all"):
                    key = f"{world}, {name}, {size} robots, {moving} moving"
                    table[key] = measure_moves(world, size, radio, move_all=moving == "all")
                    if not options.json:
                        figures = (f"{name} {value:8.3f}  " for name, value in table[key].items())
                        print(f"{key:44}" + "".join(figures))
    if options.json:
        print(json.dumps(table, indent=2))
    print(f"load after: {os.getloadavg()[0]:.2f}", file=sys.stderr)


if __name__ == "__main__":
    main()
