"""Every sync policy on every pair of simulators: `python -m benchmarks.studies.combinations run FILE.csv`.

The program runs one scenario with each physics simulator, network simulator, sync policy and seed, and appends a row
per run to a CSV file. A pair of simulators that is already in the file is not run again. `table FILE.csv --page
docs/studies/simulators.md` writes the tables of the documentation. For `gazebo`, a Gazebo must be running.
"""

import argparse
import csv
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fieldkit.core.executors import Workers
from fieldkit.core.text import print_text
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.comparison import compare_runs, lost_share
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.cosim.scenario.build import Simulation
from sim_backends.cosim.scenario.federate_choice import BUILT_IN
from sim_backends.cosim.studies.intervals import mean
from sim_backends.cosim.studies.shootout import Outcomes, RunOutcome, mean_delay_s, mean_separation_m, run_outcomes

REFERENCE: Final = "event_driven"
NETWORK_OPTIONS: Final = {"ns3": {"topics": "udp"}}
"""Best-effort topics are UDP datagrams with the headers of RTPS."""
MS_PER_S: Final = 1e3
BEGIN: Final = "<!-- written by benchmarks.studies.combinations: from here -->"
END: Final = "<!-- written by benchmarks.studies.combinations: to here -->"


class StudyRow(NamedTuple):
    """The result of one run; nan if a value is unknown.

    Attributes:
        physics: Name of the physics simulator.
        network: Name of the network simulator.
        policy: Name of the sync policy.
        seed: Seed of all random draws.
        loss: Share of lost packets.
        delay_s: Mean delay of packets that arrived.
        separation_m: Mean distance between agents over time.
        time_error_s: Mean difference of delivery times from the exact reference of this pair of simulators.
        path_error_m: Mean distance of agents from their positions in the reference.
        other_fate: Share of packets with another fate than in the reference.
        exchanges_per_s: Exchanges per simulated second.
        wall_s: Wall time per simulated second.
        failure: The reason why the policy could not be run; empty if it could.
    """

    physics: str
    network: str
    policy: str
    seed: int
    loss: float = math.nan
    delay_s: float = math.nan
    separation_m: float = math.nan
    time_error_s: float = math.nan
    path_error_m: float = math.nan
    other_fate: float = math.nan
    exchanges_per_s: float = math.nan
    wall_s: float = math.nan
    failure: str = ""

    @property
    def pair(self) -> tuple[str, str]:
        """Names of its physics and network simulator."""
        return self.physics, self.network


_TEXTS: Final = {"physics", "network", "policy", "failure"}


def make(scenario: str, changes: Mapping[str, object], policy: str, seed: int) -> Simulation:
    """Return a simulation that is ready to start."""
    return build(load_scenario(scenario, changes), policy=policy, seed=seed)


def study_rows(physics: str, network: str, results: Outcomes) -> Iterator[StudyRow]:
    """Yield a row for each policy and seed of a pair of simulators."""
    for policy, runs in results.runs.items():
        for seed in results.seeds:
            row = StudyRow(physics, network, policy, seed)
            if seed in runs:
                yield _row(row, results.reference[seed], runs[seed])
            else:
                yield row._replace(failure=str(results.failures[policy]))


def _row(run: StudyRow, reference: RunOutcome, outcome: RunOutcome) -> StudyRow:
    differences = compare_runs(reference.run, outcome.run, outcome.tracks.distances_m(reference.tracks))
    return run._replace(
        loss=lost_share(outcome.run),
        delay_s=mean_delay_s(outcome),
        separation_m=mean_separation_m(outcome),
        time_error_s=differences.delivery_error_s.mean,
        path_error_m=differences.path_error_m.mean,
        other_fate=differences.fate_disagreement,
        exchanges_per_s=differences.exchanges_per_s,
        wall_s=1 / differences.real_time_factor,
    )


def read_rows(path: Path) -> list[StudyRow]:
    """Return the rows of a file; none if it does not exist."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [StudyRow._make(_value(name, text) for name, text in row.items()) for row in csv.DictReader(file)]


def _value(name: str, text: str) -> str | int | float:
    return int(text) if name == "seed" else text if name in _TEXTS else float(text)


def append_rows(path: Path, rows: Sequence[StudyRow]) -> None:
    """Append rows to a file."""
    is_new = not path.exists()
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        if is_new:
            writer.writerow(StudyRow._fields)
        writer.writerows(rows)


def run(arguments: argparse.Namespace) -> None:
    """Run the pairs of simulators that the file lacks, append their rows to the file, and print its tables."""
    done = {row.pair for row in read_rows(arguments.file)}
    for pair in itertools.product(arguments.physics, arguments.network):
        if pair in done:
            continue
        start_s = time.monotonic()
        physics, network = pair
        changes = {
            "duration": arguments.duration,
            "policy.window": arguments.window,
            "physics.federate": physics,
            "network.federate": network,
            "network.options": NETWORK_OPTIONS.get(network),
        }
        results = run_outcomes(
            partial(make, arguments.scenario, changes),
            arguments.policy,
            range(1, arguments.seeds + 1),
            workers=Workers(1),
        )
        append_rows(arguments.file, [*study_rows(physics, network, results)])
        print_text(f"{physics} and {network}: {time.monotonic() - start_s:.0f} s", flush=True)
    print_tables(arguments)


def estimate_text(values: Sequence[float], scale: float, digits: int) -> str:
    """Return the mean of the finite values with its 95 % interval if there is one; empty without finite values."""
    finite = np.array([value for value in values if math.isfinite(value)]) * scale
    estimate = mean(finite)
    if math.isnan(estimate.low):
        return "" if math.isnan(estimate.value) else f"{estimate.value:z.{digits}f}"
    return f"{estimate.value:z.{digits}f} [{estimate.low:z.{digits}f}, {estimate.high:z.{digits}f}]"


def simulator_table(rows: Sequence[StudyRow]) -> Iterator[str]:
    """Yield a table of the exact reference on each pair of simulators, with the differences from the built-in pair.

    Runs with the same seed are compared.
    """
    by_pair = by_pair_and_policy(rows)
    bases = {run.seed: run for run in by_pair.get(((BUILT_IN, BUILT_IN), REFERENCE), [])}
    yield (
        "| physics | network | loss (%) | mean delay (ms) | difference (ms) | mean distance of robots (m) "
        "| difference (mm) |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for (pair, policy), runs in by_pair.items():
        if policy == REFERENCE:
            with_base = [(run, bases[run.seed]) for run in runs if run.seed in bases]
            delays_s = [run.delay_s - base.delay_s for run, base in with_base]
            distances_m = [run.separation_m - base.separation_m for run, base in with_base]
            cells = (
                *pair,
                estimate_text([run.loss for run in runs], 100, 1),
                estimate_text([run.delay_s for run in runs], MS_PER_S, 2),
                estimate_text(delays_s, MS_PER_S, 2),
                estimate_text([run.separation_m for run in runs], 1, 3),
                estimate_text(distances_m, MS_PER_S, 1),
            )
            yield f"| {' | '.join(cells)} |"


def policy_tables(rows: Sequence[StudyRow]) -> Iterator[str]:
    """Yield a table of each measure, with a row for each policy and a column for each pair of simulators."""
    by_pair = by_pair_and_policy(rows)
    pairs = [*dict.fromkeys(pair for pair, _ in by_pair)]
    policies = [*dict.fromkeys(policy for _, policy in by_pair)]
    for title, cell in MEASURES.items():
        yield ""
        yield f"{title}:"
        yield ""
        yield f"| policy | {' | '.join(', '.join(pair) for pair in pairs)} |"
        yield f"| --- |{' --- |' * len(pairs)}"
        for policy in policies:
            cells = [_cell(cell, by_pair.get((pair, policy), []), by_pair[pair, REFERENCE]) for pair in pairs]
            yield f"| `{policy}` | {' | '.join(cells)} |"


Cell = Callable[[Sequence[StudyRow], Sequence[StudyRow]], str]
"""Returns the text of a cell for the runs of a policy and those of the exact reference, by seed."""


def _cell(cell: Cell, runs: Sequence[StudyRow], reference: Sequence[StudyRow]) -> str:
    failure = next((run.failure for run in runs if run.failure), "")
    return failure or cell(runs, reference)


def added_text(runs: Sequence[StudyRow], reference: Sequence[StudyRow]) -> str:
    """Return the mean delay that the policy adds to the delay of the exact reference with the same seed."""
    return estimate_text(
        [run.delay_s - exact.delay_s for run, exact in zip(runs, reference, strict=True)], MS_PER_S, 1
    )


def path_text(runs: Sequence[StudyRow], _: Sequence[StudyRow]) -> str:
    """Return the mean distance of agents from their positions in the exact reference."""
    return estimate_text([run.path_error_m for run in runs], MS_PER_S, 1)


def cost_text(runs: Sequence[StudyRow], _: Sequence[StudyRow]) -> str:
    """Return the mean number of exchanges and the median wall time, both per simulated second."""
    exchanges = np.mean([run.exchanges_per_s for run in runs])
    return f"{exchanges:.0f}; {np.median([run.wall_s for run in runs]):.2f}"


MEASURES: Final[Mapping[str, Cell]] = {
    "Mean delay that the policy adds (ms)": added_text,
    "Distance of robots from their positions with the exact policy (mm)": path_text,
    "Exchanges and wall time (s), per simulated second": cost_text,
}


def by_pair_and_policy(rows: Sequence[StudyRow]) -> dict[tuple[tuple[str, str], str], list[StudyRow]]:
    """Return the runs of each pair of simulators and policy, in order of seeds."""
    grouped: dict[tuple[tuple[str, str], str], list[StudyRow]] = {}
    for row in sorted(rows, key=lambda row: row.seed):
        grouped.setdefault((row.pair, row.policy), []).append(row)
    return dict(sorted(grouped.items(), key=lambda item: (item[0][0], list(BUILTIN).index(item[0][1]))))


def print_tables(arguments: argparse.Namespace) -> None:
    """Print the tables of a file, or write them into a page."""
    rows = read_rows(arguments.file)
    text = "\n".join((*simulator_table(rows), *policy_tables(rows)))
    if arguments.page is None:
        print_text(text)
        return
    before, _, rest = arguments.page.read_text(encoding="utf-8").partition(f"{BEGIN}\n")
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"{arguments.page} lacks the line {BEGIN} or {END}")
    arguments.page.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")


def main(words: Sequence[str] | None = None) -> None:
    """Run the study, or print its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    runs = commands.add_parser("run")
    runs.add_argument("file", type=Path)
    runs.add_argument("--scenario", default="convoy")
    runs.add_argument("--physics", nargs="+", default=[BUILT_IN, "mujoco", "gazebo"])
    runs.add_argument("--network", nargs="+", default=[BUILT_IN, "ns3"])
    runs.add_argument("--policy", nargs="+", default=[*BUILTIN], choices=BUILTIN)
    runs.add_argument("--seeds", type=int, default=6)
    runs.add_argument("--duration", default="10s")
    runs.add_argument("--window", default="10ms")
    runs.set_defaults(run=run, page=None)
    tables = commands.add_parser("table")
    tables.add_argument("file", type=Path)
    tables.add_argument("--page", type=Path, help="write the tables into this page instead")
    tables.set_defaults(run=print_tables)
    arguments = parser.parse_args(words)
    arguments.run(arguments)


if __name__ == "__main__":
    main()
