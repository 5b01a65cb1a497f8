"""Aggregate an archive of 10,000 trials, compared with pandas and DuckDB: `python -m benchmarks.archive`.

Each round runs `fieldkit aggregate ARCHIVE --where ...` three times: with `--no-index`, then without an existing
index (this run writes one), then with this index. The other tools read the same tables in the same round, select the
same rows, and compute count, mean and median of one quantity per condition without intervals: pandas concatenates all
tables, DuckDB reads them in one query (`read_csv` with `union_by_name`), and DuckDB reads a Parquet file that was
written before. The benchmark stops if their figures differ from the figures of fieldkit.
"""

import argparse
import json
import math
import os
import statistics
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from benchmarks.aggregate import ROOT, Run, run
from benchmarks.archive_peers import BY, QUANTITY
from benchmarks.archive_trials import write_archive

WHERE: Final = 'distance_m < 20 and topology == "master"'
AGE_S: Final = 3.0
"""Minimum age of the tables at the first run; fieldkit writes no index entry for a table that changed in the last 2 s
(`table_index.SETTLED_S`)."""


def _fieldkit(archive: Path, out: Path, *options: str) -> Run:
    words = ("aggregate", str(archive), "--where", WHERE, "--by", ",".join(BY), "--quantity", QUANTITY)
    return run([sys.executable, "-m", "fieldkit", *words, "--format", "json", *options], out)


def _peer(name: str, archive: Path, out: Path) -> Run:
    return run([sys.executable, "-m", "benchmarks.archive_peers", name, str(archive)], out)


def figures(output: Path) -> dict[tuple[str, ...], tuple[float, ...]]:
    """Return count, mean and median by condition from the JSON of fieldkit or of a peer."""
    content = json.loads(output.read_bytes())
    if isinstance(content, list):
        return {tuple(map(str, row[:-3])): tuple(row[-3:]) for row in content}
    return {
        tuple(str(value) for value in cell["key"].values()): tuple(
            cell["estimates"][QUANTITY][part] for part in ("n", "mean", "median")
        )
        for cell in content["cells"]
        if QUANTITY in cell["estimates"]
    }


def check(fieldkit_output: Path, peer_output: Path) -> None:
    """Compare the figures of two outputs.

    Raises:
        RuntimeError: The figures differ, or there are none.
    """
    our_figures, peer_figures = figures(fieldkit_output), figures(peer_output)
    is_equal = our_figures.keys() == peer_figures.keys() and all(
        math.isclose(a, b, rel_tol=1e-6)
        for key in our_figures
        for a, b in zip(our_figures[key], peer_figures[key], strict=True)
    )
    if not is_equal or not our_figures:
        raise RuntimeError(f"{fieldkit_output.name} and {peer_output.name} differ: {our_figures} {peer_figures}")


def run_round(archive: Path, work: Path) -> dict[str, Run]:
    """Run all programs once, and compare their outputs; return the runs by name.

    Raises:
        RuntimeError: The figures of two programs differ, or the outputs of fieldkit are not equal.
    """
    cache = work / "cache"
    for file in cache.rglob("*.index"):
        file.unlink()
    os.environ["XDG_CACHE_HOME"] = str(cache)
    programs: Mapping[str, Callable[[Path], Run]] = {
        "fieldkit, no index": lambda out: _fieldkit(archive, out, "--no-index"),
        "fieldkit, first run": lambda out: _fieldkit(archive, out),
        "fieldkit, with index": lambda out: _fieldkit(archive, out),
        "pandas": lambda out: _peer("pandas", archive, out),
        "DuckDB": lambda out: _peer("duckdb", archive, out),
        "DuckDB, Parquet": lambda out: _peer("parquet", archive, out),
    }
    runs = {}
    outputs = {name: work / f"{name.replace(', ', '-').replace(' ', '-')}.json" for name in programs}
    for name, program in programs.items():
        runs[name] = program(outputs[name])
        load = os.getloadavg()[0]
        print(f"{name}: {runs[name].wall_s:.1f} s, load average {load:.1f}", file=sys.stderr, flush=True)
    first, *others = outputs.values()
    for output in others:
        check(first, output)
    if len({outputs[name].read_bytes() for name in programs if name.startswith("fieldkit")}) != 1:
        raise RuntimeError("the outputs with and without the index differ")
    return runs


def show(rounds: Sequence[Mapping[str, Run]]) -> None:
    """Print a table. Ratios are computed in each round, and the median of a ratio over all rounds is printed."""
    names = list(rounds[0])
    print(
        "| | wall time (s), median (lowest to highest) | processor time (s) | peak memory (MB) "
        "| wall time / pandas | wall time / DuckDB |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for name in names:
        runs = [result[name] for result in rounds]
        walls = [result.wall_s for result in runs]
        ratios = [
            statistics.median(result[name].wall_s / result[peer].wall_s for result in rounds)
            for peer in ("pandas", "DuckDB")
        ]
        print(
            f"| {name} | {statistics.median(walls):.2f} ({min(walls):.2f} to {max(walls):.2f}) "
            f"| {statistics.median(result.processor_s for result in runs):.2f} "
            f"| {max(result.peak_mb for result in runs):.0f} | {ratios[0]:.2f} | {ratios[1]:.2f} |"
        )


def main() -> None:
    """Make the archive, run the rounds, print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=20, help="rows per trial")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory(prefix="fieldkit-bench-") as name:
        archive, work = Path(name) / "archive", Path(name)
        write_archive(archive, arguments.trials, arguments.repeats)
        # Wait until all tables have the minimum age.
        run([sys.executable, "-c", f"import time; time.sleep({AGE_S})"], work / "slept")
        run([sys.executable, "-m", "benchmarks.archive_peers", "write", str(archive)], work / "written")
        load = os.getloadavg()[0]
        rounds = [run_round(archive, work) for _ in range(arguments.rounds)]
    if arguments.json:
        values = [{label: vars(result) for label, result in runs.items()} for runs in rounds]
        print(json.dumps({"load": load, "rounds": values}))
        return
    print(f"load average before: {load:.2f} on {os.cpu_count()} cores\n")
    show(rounds)


if __name__ == "__main__":
    main()
