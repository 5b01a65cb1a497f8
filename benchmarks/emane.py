"""The EMANE experiment of the paper in a lab: `python -m benchmarks.emane [--rounds 3] [--json]`, as root.

*The paper* is the publication whose field trials fieldkit automates (docs/index.md).

The first of ten robots sends 100 pings of 64 bytes to the tenth, before and after the tenth moves by 100 m along each
axis. Each radio and round has a new lab, started by the commands of docs/studies/emane.md. ping prints 64 bytes: 56
of payload and 8 of ICMP header; the IP packet has 84 bytes. All times are round trips in ms; loss is in percent.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from benchmarks.medium import quantile
from fieldkit import __version__
from fieldkit.lab import folder, requests
from fieldkit.measure.evidence.ping import parse

RADIOS: Final = {
    "fixed links, 1 Mbit/s": "{rate: 1Mbit/s, delay: 0ms}",
    "the same, propagation over 7,335 km": "{rate: 1Mbit/s, delay: 24.467ms}",
    "Wi-Fi, free space": "{propagation: free-space, fading: false}",
    "Wi-Fi, exponent 2.5": "{exponent: 2.5, fading: false}",
    "Wi-Fi, exponent 3": "{fading: false}",
}
"""Radios by name, as values of `emulated.radio`, without fading. The first equals the model RF Pipe of EMANE."""

SITE: Final = """\
robots: {{}}
roles: {{}}
emulated: {{world: open, ros: builtin, radio: {radio}}}
"""
ROBOTS: Final = 10
PINGS: Final = 100
POSITIONS: Final = ("before", "after")
REFERENCES: Final = {
    "paper": {"mean": (5.377, 54.309), "loss": (0.0, 0.0)},
    "EMANE 1.5.3, RF Pipe": {"mean": (2.26, 2.26), "median": (2.12, 2.12), "loss": (0.0, 0.0)},
}
"""Results of the paper, and of EMANE on 2 idle cores, before and after the move, which did not change EMANE's
results."""

Figures = dict[str, float | None]


def fieldkit(lab_folder: Path, *words: str) -> str:
    """Return the output of a `fieldkit lab` command. A ping without any reply exits with 1."""
    completed = subprocess.run(
        (sys.executable, "-m", "fieldkit", "lab", *words),
        cwd=lab_folder,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if completed.returncode not in ({0, 1} if "ping" in words else {0}):
        raise SystemExit(f"fieldkit lab {' '.join(words)} exited with {completed.returncode}")
    return completed.stdout


@contextmanager
def lab(radio: str) -> Iterator[Path]:
    """Yield the folder of a running lab."""
    with tempfile.TemporaryDirectory() as name:
        lab_folder = Path(name)
        (lab_folder / "fieldkit.yaml").write_text(SITE.format(radio=radio), encoding="utf-8")
        fieldkit(lab_folder, "up", "--robots", str(ROBOTS))
        try:
            yield lab_folder
        finally:
            fieldkit(lab_folder, "down")


def measure_pings(lab_folder: Path) -> Figures:
    """Return the results of 100 pings; the times are None if none was answered, and the SNR on fixed links."""
    words = ("ping", "-c", str(PINGS), "-i", "0.1", "-W", "1", "-s", "56", f"robot-{ROBOTS}")
    ping_output = parse(fieldkit(lab_folder, "shell", "robot-1", *words))
    rtt_ms = [1e3 * value for value in ping_output.rtt_s]
    times: Figures = dict.fromkeys(("min", "mean", "median", "p99"))
    if rtt_ms:
        times = {
            "min": min(rtt_ms),
            "mean": statistics.fmean(rtt_ms),
            "median": statistics.median(rtt_ms),
            "p99": quantile(rtt_ms, 0.99),
        }
    links = requests.overview(folder.of_directory(lab_folder)).links
    snr_db = next((link.snr_db for link in links if link.ends == ("robot-1", f"robot-{ROBOTS}")), None)
    return {**times, "loss": 100 * (1 - len(rtt_ms) / PINGS), "snr_db": snr_db}


def measure_round(radio: str) -> dict[str, Figures]:
    """Return the figures of one round, before and after the move."""
    with lab(radio) as lab_folder:
        before = measure_pings(lab_folder)
        fieldkit(lab_folder, "move", f"robot-{ROBOTS}", "--by", "100m", "100m", "100m")
        return dict(zip(POSITIONS, (before, measure_pings(lab_folder)), strict=True))


def spread(values: list[float | None]) -> str:
    """Return median (lowest to highest) of the rounds that have a value."""
    present = [value for value in values if value is not None]
    if not present:
        return "-"
    median_value, low, high = statistics.median(present), min(present), max(present)
    return f"{median_value:.2f}" if low == high else f"{median_value:.2f} ({low:.2f} to {high:.2f})"


def show(rounds: dict[str, list[dict[str, Figures]]]) -> None:
    """Print the table, with the paper's and EMANE's figures first."""
    names = ("min", "mean", "median", "p99", "loss", "snr_db")
    print(f"{'ms, %, dB; median of rounds (range)':38}" + "".join(f"{name:>24}" for name in names))
    for index, position in enumerate(POSITIONS):
        for name, figures in REFERENCES.items():
            cells = (f"{figures[column][index]:g}" if column in figures else "" for column in names)
            print(f"{name + ', ' + position:38}" + "".join(f"{cell:>24}" for cell in cells))
        for name, results in rounds.items():
            cells = (spread([result[position][column] for result in results]) for column in names)
            print(f"{name + ', ' + position:38}" + "".join(f"{cell:>24}" for cell in cells))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    options = parser.parse_args()
    system = f"Python {platform.python_version()}, Linux {platform.release()}, {os.cpu_count()} cores"
    ping_version = subprocess.run(("ping", "-V"), stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()[
        0
    ]
    about = f"fieldkit {__version__}, {system}, {ping_version}; load before: {os.getloadavg()[0]:.2f}"
    rounds: dict[str, list[dict[str, Figures]]] = {name: [] for name in RADIOS}
    for _ in range(options.rounds):
        for name, radio in RADIOS.items():
            rounds[name].append(measure_round(radio))
    about += f", after: {os.getloadavg()[0]:.2f}"
    if options.json:
        print(json.dumps({"about": about, "radios": RADIOS, "rounds": rounds}, indent=2))
        return
    print(about)
    for name, radio in RADIOS.items():
        print(f"  {name}: radio: {radio}")
    show(rounds)


if __name__ == "__main__":
    main()
