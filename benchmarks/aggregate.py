"""Aggregate thousands of trial.csv files into one table, compared with pandas: `python -m benchmarks.aggregate`.

Each table has 40 repeats; all tables together have 160 conditions. The values are random, from a generator with a
fixed seed. Each round runs the command `fieldkit aggregate` once for each number of tables, which shows if the cost
grows linearly. In the same round a peer program (`pandas_peer`) reads the smallest number of tables: pandas
concatenates and groups them, and scipy computes a bootstrap interval per condition and quantity. The benchmark stops
if the counts, means, medians or 95th percentiles of the two programs differ.

`--rows N` adds one table of N repeats (a multiple of 40), like the CSV that `fieldkit export` writes for a campaign.
"""

import argparse
import json
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.analysis.quantities import quantities
from fieldkit.core.columns import SCHEMA_VERSION, Column
from fieldkit.trial.columns import trial_columns

REPEATS: Final = 40
SENT: Final = 216
"""Packets sent in each repeat."""
_COUNTED: Final = tuple(quantity for quantity in quantities(trial_columns()) if quantity.sent and quantity.arrived)
"""Quantities with a column of sent items and a column of received items."""
START_NS: Final = 1_700_000_000 * 10**9
"""Start of the first repeat."""
TABLE: Final = "table.csv"
ROOT: Final = Path(__file__).resolve().parents[1]

Figures = dict[tuple[tuple[str, ...], str], tuple[float, ...]]
"""Number of values, mean, median and 95th percentile, by condition and quantity."""


@dataclass(frozen=True)
class Run:
    """A finished process.

    Attributes:
        wall_s: Wall time in seconds.
        processor_s: Processor time in seconds.
        peak_mb: Peak memory in MB.
    """

    wall_s: float
    processor_s: float
    peak_mb: float


def write_tables(folder: Path, count: int) -> None:
    """Write `count` trials into a folder."""
    generator = np.random.default_rng(1)
    for number in range(count):
        path = folder / _condition(number)["trial"] / "trial.csv"
        path.parent.mkdir(parents=True)
        path.write_text("".join((_header(), *_lines(generator, number))), encoding="utf-8")


def write_table(path: Path, rows: int) -> None:
    """Write one table of `rows` repeats, rounded down to a multiple of `REPEATS`."""
    generator = np.random.default_rng(1)
    with path.open("w", encoding="utf-8") as file:
        file.write(_header())
        for number in range(rows // REPEATS):
            file.writelines(_lines(generator, number))


def _header() -> str:
    return ",".join(column.name for column in trial_columns()) + "\n"


def _lines(generator: np.random.Generator, number: int) -> Iterator[str]:
    """Yield the lines of a trial."""
    columns = trial_columns()
    fixed = _condition(number)
    shares = generator.random((REPEATS, len(columns))).tolist()
    counts = generator.binomial(SENT, 0.9, (REPEATS, len(columns))).tolist()
    for repeat in range(REPEATS):
        fixed |= {"protocol": ("tcp", "udp")[repeat % 2], "repeat": str(1 + repeat // 2)}
        fixed["status"] = "void" if shares[repeat][0] < 0.03 else "valid"
        fixed["started_utc_ns"] = str(START_NS + (number * REPEATS + repeat) * 10**10)
        for quantity, arrived in zip(_COUNTED, counts[repeat], strict=False):
            counted = zip(quantity.columns, (f"{1 - arrived / SENT:.9g}", str(arrived), str(SENT)), strict=True)
            fixed |= dict(counted)
        row_values = zip(columns, shares[repeat], counts[repeat], strict=True)
        yield (
            ",".join(
                fixed.get(column.name) or _random_value(column, share, count) for column, share, count in row_values
            )
            + "\n"
        )


def _random_value(column: Column, share: float, count: int) -> str:
    if column.type is int:
        return str(count)
    if column.unit == "bool":
        return "true" if share < 0.9 else "false"
    return "" if column.unit in {"text", "hash"} else f"{share:.9g}"


def _condition(number: int) -> dict[str, str]:
    """Return the fixed columns of a trial."""
    metres, combination = 5 * (1 + number % 10), number // 10
    return {
        "schema_version": str(SCHEMA_VERSION),
        "trial": f"20261121T{number:06d}.000000Z_los_{metres}m_master",
        "procedure": ("los", "nlos")[combination % 2],
        "scenario": ("los", "nlos")[combination % 2],
        "topology": ("master", "masterless")[combination // 2 % 2],
        "backend": ("emulated", "field")[combination // 4 % 2],
        "distance": f"{metres}m",
        "distance_m": str(metres),
        "attempt": "1",
        "profiles_sha256": "cce8ff61c3569b21",
        "procedure_sha256": "3cec6b0777e75633",
        "code_sha256": "06048b801fca5269",
    }


def run(argv: Sequence[str], out: Path) -> Run:
    """Run a program until it exits, with its output in a file.

    Raises:
        RuntimeError: The program failed.
    """
    started = time.perf_counter()
    with out.open("wb") as file:
        pid = os.posix_spawn(argv[0], list(argv), os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, file.fileno(), 1)])
        _, status, usage = os.wait4(pid, 0)
    if status:
        raise RuntimeError(f"{' '.join(argv)}: exit code {os.waitstatus_to_exitcode(status)}")
    return Run(time.perf_counter() - started, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3)


def run_fieldkit(folder: Path, out: Path) -> Run:
    """Run the command on all trials in a folder."""
    return run([sys.executable, "-m", "fieldkit", "aggregate", str(folder), "--format", "json"], out)


def run_pandas(folder: Path, out: Path) -> Run:
    """Run the peer on all trials in a folder."""
    return run([sys.executable, "-m", "benchmarks.pandas_peer", str(folder)], out)


def check(fieldkit_output: Path, peer_output: Path) -> None:
    """Compare counts, means, medians and percentiles.

    Raises:
        RuntimeError: The figures of fieldkit and of the peer differ.
    """
    our_figures: Figures = {
        (tuple(map(str, cell["key"].values())), name): tuple(
            estimate[part] for part in ("n", "mean", "median", "p95")
        )
        for cell in json.loads(fieldkit_output.read_bytes())["cells"]
        for name, estimate in cell["estimates"].items()
    }
    peer_figures: Figures = {
        (tuple(key), name): tuple(values[:4]) for key, name, *values in json.loads(peer_output.read_bytes())
    }
    are_close = our_figures.keys() == peer_figures.keys() and all(
        math.isclose(our_value, peer_value, rel_tol=1e-6)
        for key in our_figures
        for our_value, peer_value in zip(our_figures[key], peer_figures[key], strict=True)
    )
    if not are_close:
        raise RuntimeError("fieldkit and pandas computed different figures")


def run_rounds(base: Path, counts: Sequence[int], rounds: int, rows: int) -> dict[str, list[Run]]:
    """Return the runs of all rounds, by program and number of tables.

    Args:
        base: Folder with the tables.
        counts: Numbers of tables.
        rounds: Number of rounds.
        rows: Rows of the single table; 0 to omit it.
    """
    runs: dict[str, list[Run]] = {}
    for _ in range(rounds):
        for count in counts:
            result = run_fieldkit(base / str(count), base / f"{count}.json")
            runs.setdefault(f"fieldkit, {count:,} tables", []).append(result)
        fewest = min(counts)
        result = run_pandas(base / str(fewest), base / "pandas.json")
        runs.setdefault(f"pandas and scipy, {fewest:,} tables", []).append(result)
        check(base / f"{fewest}.json", base / "pandas.json")
        if rows:
            result = run_fieldkit(base / TABLE, base / "table.json")
            runs.setdefault(f"fieldkit, one table of {rows:,} rows", []).append(result)
    return runs


def show(runs_by_name: Mapping[str, Sequence[Run]]) -> None:
    """Print a table."""
    print("| | wall time (s), median (lowest to highest) | processor time (s) | repeats/s | peak memory (MB) |")
    print("| --- | --- | --- | --- | --- |")
    for name, runs in runs_by_name.items():
        walls = [run_result.wall_s for run_result in runs]
        wall = statistics.median(walls)
        number, unit = name.split()[-2:]
        repeats = int(number.replace(",", "")) * (1 if unit == "rows" else REPEATS)
        processor = statistics.median(run_result.processor_s for run_result in runs)
        spread = f"{wall:.2f} ({min(walls):.2f} to {max(walls):.2f})"
        peak_mb = max(run_result.peak_mb for run_result in runs)
        print(f"| {name} | {spread} | {processor:.2f} | {repeats / wall:,.0f} | {peak_mb:.0f} |")


def main() -> None:
    """Make the tables, run the rounds, print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tables", type=int, nargs="+", default=[1_000, 3_000, 10_000], help="numbers of tables")
    parser.add_argument("--rows", type=int, default=0, metavar="N", help="rows of one more table")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory(prefix="fieldkit-bench-") as name:
        for count in arguments.tables:
            write_tables(Path(name) / str(count), count)
        if arguments.rows:
            write_table(Path(name) / TABLE, arguments.rows)
        load = os.getloadavg()[0]
        runs_by_name = run_rounds(Path(name), arguments.tables, arguments.rounds, arguments.rows)
    if arguments.json:
        print(
            json.dumps(
                {
                    "load": load,
                    "runs": {name: [vars(result) for result in runs] for name, runs in runs_by_name.items()},
                }
            )
        )
        return
    print(f"load average before: {load:.2f} on {os.cpu_count()} cores\n")
    show(runs_by_name)


if __name__ == "__main__":
    main()
