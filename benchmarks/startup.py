"""Start-up time of commands: `python -m benchmarks.startup`; needs no root.

Each command of fieldkit runs alternately with its references: Python that does nothing, `git --version`, and Python
that only imports the libraries of the command. The benchmark measures wall time, processor time and the peak memory
of the process, which is at least the 16 MB of the benchmark. The main figure is the command's processor time minus
the time to import its libraries. `--peer PYTHON` also runs fieldkit of another checkout with that Python, except for
the completion.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

_ROOT: Final = Path(__file__).resolve().parents[1]
_TABLE: Final = _ROOT / "tests" / "data" / "fieldkit" / "1" / "trial.csv"
# Bytecode is written, so that only the first run compiles the modules of a checkout.
_ENVIRONMENT: Final = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
_LINE: Final = "fieldkit tr"
_TAB: Final = {
    "_ARGCOMPLETE": "1",
    "_ARGCOMPLETE_STDOUT_FILENAME": os.devnull,
    "COMP_LINE": _LINE,
    "COMP_POINT": str(len(_LINE)),
}
"""Variables with which a shell requests the completion of `_LINE` from argcomplete."""
# By default OpenBLAS starts a thread per core that spins. fieldkit disables this, so the reference must, too.
_ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1"}
_DISPLAY_LIBRARIES: Final = "rich.console, rich.live, rich.table, rich.text"
# pydantic imports the modules of its names at first access.
_VALIDATION_LIBRARIES: Final = (
    "yaml, pydantic; from pydantic import BaseModel, Field, PlainSerializer, StrictInt, TypeAdapter"
)


@dataclass(frozen=True)
class Command:
    """A command of fieldkit.

    Attributes:
        words: Its arguments.
        libraries: Libraries that it needs, as operands of an import statement.
        environment: Variables that the shell sets for it.
    """

    words: Sequence[str]
    libraries: str
    environment: Mapping[str, str] = field(default_factory=dict)


COMMANDS: Final = {
    "--version": Command(["--version"], "argparse"),
    "--help": Command(["--help"], "argparse"),
    "trial --help": Command(["trial", "--help"], "argparse"),
    "fieldkit tr<TAB>": Command([], "argparse, argcomplete", _TAB),
    "columns": Command(["columns"], f"argparse, numpy, {_DISPLAY_LIBRARIES}, {_VALIDATION_LIBRARIES}"),
    # pydantic imports importlib.metadata for its first model.
    "trial --dry-run": Command(
        ["trial", "los", "30ft", "--backend", "emulated", "--dry-run"],
        f"argparse, numpy, importlib.metadata, {_DISPLAY_LIBRARIES}, {_VALIDATION_LIBRARIES}",
    ),
    "aggregate": Command(
        ["aggregate", str(_TABLE)], f"argparse, numpy, pyarrow.csv, {_DISPLAY_LIBRARIES}, {_VALIDATION_LIBRARIES}"
    ),
}


@dataclass(frozen=True)
class Cost:
    """Cost of one run.

    Attributes:
        wall_s: Wall time.
        processor_s: Processor time, children included.
        peak_mb: Peak memory.
    """

    wall_s: float
    processor_s: float
    peak_mb: float


def measure(argv: Sequence[str], environment: Mapping[str, str]) -> Cost:
    """Run a command in an empty folder until it exits, and return its cost.

    Raises:
        RuntimeError: The command failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        started_s = time.perf_counter()
        process = subprocess.Popen(
            argv,
            cwd=folder,
            env={**_ENVIRONMENT, **environment},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - started_s
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(argv)}: exit code {process.returncode}")
    return Cost(wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1000)


def runs(peer: str | None) -> dict[str, tuple[Sequence[str], Mapping[str, str]]]:
    """Return the argument lists and environments to run in each round, by name."""
    commands: dict[str, tuple[Sequence[str], Mapping[str, str]]] = {
        "python -c pass": ([sys.executable, "-c", "pass"], {}),
        "git --version": (["git", "--version"], {}),
    }
    for name, command in COMMANDS.items():
        commands[name] = ([sys.executable, "-m", "fieldkit", *command.words], command.environment)
        commands[f"{name}: libraries"] = ([sys.executable, "-c", f"import {command.libraries}"], _ONE_THREAD)
        if peer is not None and not command.environment:
            commands[f"{name}: peer"] = ([peer, "-m", "fieldkit", *command.words], {})
    return commands


def table(costs: Mapping[str, Sequence[Cost]]) -> str:
    """Return the medians as a Markdown table."""

    def median(name: str, attribute: str) -> float:
        return statistics.median(float(getattr(cost, attribute)) for cost in costs[name])

    lines = [
        "| | wall (ms) | processor (ms) | peak (MB) | without libraries (ms) |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in costs:
        wall, processor = (round(1000 * median(name, attribute)) for attribute in ("wall_s", "processor_s"))
        reference = f"{name}: libraries"
        without_libraries = (
            f"{processor - round(1000 * median(reference, 'processor_s'))}" if reference in costs else ""
        )
        lines.append(f"| {name} | {wall} | {processor} | {median(name, 'peak_mb'):.0f} | {without_libraries} |")
    return "\n".join(lines)


def main() -> None:
    """Run the rounds and print the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=10, help="default 10")
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    parser.add_argument("--peer", metavar="PYTHON", help="Python of another checkout's environment")
    arguments = parser.parse_args()
    commands = runs(arguments.peer)
    costs: dict[str, list[Cost]] = {name: [] for name in commands}
    for number in range(arguments.rounds + 1):
        for name, (argv, environment) in commands.items():
            cost = measure(argv, environment)
            if number:  # the first round fills the file cache
                costs[name].append(cost)
    if arguments.json:
        print(json.dumps({name: [asdict(cost) for cost in command_costs] for name, command_costs in costs.items()}))
    else:
        print(table(costs))


if __name__ == "__main__":
    main()
