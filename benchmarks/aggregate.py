"""From thousands of trial.csv to a table with intervals, beside pandas and scipy: `python -m benchmarks.aggregate`.

Tables of 40 repeats each, every column filled, drawn by a fixed seed, over 160 conditions. `fieldkit aggregate` is
started as its users start it, once per number of tables in every round, so that one sees whether cost grows linearly.
The peer reads the fewest tables in the same round: pandas puts them together and groups them, scipy makes a bootstrap
interval per cell and quantity. Both find the same means and medians, or the benchmark stops.

`--rows N` adds one table of N repeats: the CSV that `fieldkit export` makes of a whole campaign.
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
_COUNTED: Final = tuple(quantity for quantity in quantities(trial_columns()) if quantity.sent and quantity.arrived)
START_NS: Final = 1_700_000_000 * 10**9
TABLE: Final = "table.csv"
ROOT: Final = Path(__file__).resolve().parents[1]

Figures = dict[tuple[tuple[str, ...], str], tuple[float, ...]]


@dataclass(frozen=True)
class Run:
    """A finished process.

    Attributes:
        wall_s: From its start to its end.
        processor_s: What it took of the processor.
        peak_mb: Its peak memory.
    """

    wall_s: float
    processor_s: float
    peak_mb: float


def write_tables(folder: Path, count: int) -> None:
    """Write `count` trials into a folder."""
    draw = np.random.default_rng(1)
    for number in range(count):
        path = folder / _condition(number)["trial"] / "trial.csv"
        path.parent.mkdir(parents=True)
        path.write_text("".join((_header(), *_lines(draw, number))), encoding="utf-8")


def write_table(path: Path, rows: int) -> None:
    """Write one table of `rows` repeats."""
    draw = np.random.default_rng(1)
    with path.open("w", encoding="utf-8") as file:
        file.write(_header())
        for number in range(rows // REPEATS):
            file.writelines(_lines(draw, number))


def _header() -> str:
    return ",".join(column.name for column in trial_columns()) + "\n"


def _lines(draw: np.random.Generator, number: int) -> Iterator[str]:
    """Yield the lines of a trial."""
    columns = trial_columns()
    fixed = _condition(number)
    shares = draw.random((REPEATS, len(columns))).tolist()
    counts = draw.binomial(SENT, 0.9, (REPEATS, len(columns))).tolist()
    for repeat in range(REPEATS):
        fixed |= {"protocol": ("tcp", "udp")[repeat % 2], "repeat": str(1 + repeat // 2)}
        fixed["status"] = "void" if shares[repeat][0] < 0.03 else "valid"
        fixed["started_utc_ns"] = str(START_NS + (number * REPEATS + repeat) * 10**10)
        for quantity, arrived in zip(_COUNTED, counts[repeat], strict=False):
            own = zip(quantity.columns, (f"{1 - arrived / SENT:.9g}", str(arrived), str(SENT)), strict=True)
            fixed |= dict(own)
        drawn = zip(columns, shares[repeat], counts[repeat], strict=True)
        yield ",".join(fixed.get(column.name) or _drawn(column, *two) for column, *two in drawn) + "\n"


def _drawn(column: Column, share: float, whole: int) -> str:
    if column.type is int:
        return str(whole)
    if column.unit == "bool":
        return "true" if share < 0.9 else "false"
    return "" if column.unit in {"text", "hash"} else f"{share:.9g}"


def _condition(number: int) -> dict[str, str]:
    """Return the cells of a trial that are not drawn."""
    metres, rest = 5 * (1 + number % 10), number // 10
    return {
        "schema_version": str(SCHEMA_VERSION),
        "trial": f"20261121T{number:06d}.000000Z_los_{metres}m_master",
        "procedure": ("los", "nlos")[rest % 2],
        "scenario": ("los", "nlos")[rest % 2],
        "topology": ("master", "masterless")[rest // 2 % 2],
        "backend": ("emulated", "field")[rest // 4 % 2],
        "distance": f"{metres}m",
        "distance_m": str(metres),
        "attempt": "1",
        "profiles_sha256": "cce8ff61c3569b21",
        "procedure_sha256": "3cec6b0777e75633",
        "code_sha256": "06048b801fca5269",
    }


def run(argv: Sequence[str], out: Path) -> Run:
    """Run a program to its end, its output into a file.

    Raises:
        RuntimeError: It failed.
    """
    begun = time.perf_counter()
    with out.open("wb") as file:
        pid = os.posix_spawn(argv[0], list(argv), os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, file.fileno(), 1)])
        _, status, usage = os.wait4(pid, 0)
    if status:
        raise RuntimeError(f"{' '.join(argv)}: exit code {os.waitstatus_to_exitcode(status)}")
    return Run(time.perf_counter() - begun, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3)


def by_fieldkit(folder: Path, out: Path) -> Run:
    """Run the command on all trials in a folder."""
    return run([sys.executable, "-m", "fieldkit", "aggregate", str(folder), "--format", "json"], out)


def by_pandas(folder: Path, out: Path) -> Run:
    """Run the peer on all trials in a folder."""
    return run([sys.executable, "-m", "benchmarks.pandas_peer", str(folder)], out)


def check(ours: Path, theirs: Path) -> None:
    """Compare counts, means, medians and percentiles.

    Raises:
        RuntimeError: They differ.
    """
    own: Figures = {
        (tuple(map(str, cell["key"].values())), name): tuple(one[part] for part in ("n", "mean", "median", "p95"))
        for cell in json.loads(ours.read_bytes())["cells"]
        for name, one in cell["estimates"].items()
    }
    other: Figures = {(tuple(key), name): tuple(rest[:4]) for key, name, *rest in json.loads(theirs.read_bytes())}
    close = own.keys() == other.keys() and all(
        math.isclose(one, two, rel_tol=1e-6) for key in own for one, two in zip(own[key], other[key], strict=True)
    )
    if not close:
        raise RuntimeError("fieldkit and pandas found different figures")


def rounds(base: Path, counts: Sequence[int], number: int, rows: int) -> dict[str, list[Run]]:
    """Return the runs of each round, by program and number of tables; `rows` as `--rows`."""
    found: dict[str, list[Run]] = {}
    for _ in range(number):
        for count in counts:
            done = by_fieldkit(base / str(count), base / f"{count}.json")
            found.setdefault(f"fieldkit, {count:,} tables", []).append(done)
        fewest = min(counts)
        done = by_pandas(base / str(fewest), base / "pandas.json")
        found.setdefault(f"pandas and scipy, {fewest:,} tables", []).append(done)
        check(base / f"{fewest}.json", base / "pandas.json")
        if rows:
            done = by_fieldkit(base / TABLE, base / "table.json")
            found.setdefault(f"fieldkit, one table of {rows:,} rows", []).append(done)
    return found


def show(found: Mapping[str, Sequence[Run]]) -> None:
    """Print a table."""
    print("| | s, median (lowest to highest) | of the processor (s) | repeats/s | peak memory (MB) |")
    print("| --- | --- | --- | --- | --- |")
    for name, runs in found.items():
        walls = [one.wall_s for one in runs]
        wall = statistics.median(walls)
        number, unit = name.split()[-2:]
        repeats = int(number.replace(",", "")) * (1 if unit == "rows" else REPEATS)
        processor = statistics.median(one.processor_s for one in runs)
        spread = f"{wall:.2f} ({min(walls):.2f} to {max(walls):.2f})"
        peak_mb = max(one.peak_mb for one in runs)
        print(f"| {name} | {spread} | {processor:.2f} | {repeats / wall:,.0f} | {peak_mb:.0f} |")


def main() -> None:
    """Make the tables, run the rounds, print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tables", type=int, nargs="+", default=[1_000, 3_000, 10_000])
    parser.add_argument("--rows", type=int, default=0, metavar="N")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory(prefix="fieldkit-bench-") as name:
        for count in arguments.tables:
            write_tables(Path(name) / str(count), count)
        if arguments.rows:
            write_table(Path(name) / TABLE, arguments.rows)
        load = os.getloadavg()[0]
        found = rounds(Path(name), arguments.tables, arguments.rounds, arguments.rows)
    if arguments.json:
        print(json.dumps({"load": load, "runs": {name: [vars(one) for one in runs] for name, runs in found.items()}}))
        return
    print(f"load average before: {load:.2f} on {os.cpu_count()} cores\n")
    show(found)


if __name__ == "__main__":
    main()
