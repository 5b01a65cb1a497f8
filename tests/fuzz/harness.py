"""Give mutated outputs to readers in a process that may crash, and keep each input that breaks a reader."""

import contextlib
import hashlib
import json
import math
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from fieldkit.core.errors import FieldkitError
from tests.fuzz.mutate import mutate
from tests.helpers.paths import ROOT

CPU_S: Final = 30.0
MEMORY_BYTES: Final = 512 << 20
"""Limits of processor time and memory for an input of at most 1 MiB."""
MAX_WAIT_S: Final = 200.0
"""Maximum real time, for readers that wait without computing; a longer time is also a defect."""

_INPUTS_PER_WORKER: Final = 5_000
"""Inputs per process, so that slow memory leaks of the process are not attributed to an input."""


@dataclass(frozen=True)
class Target:
    """A reader of data that a robot or another person sends.

    Attributes:
        name: Name of the target.
        seeds: Stored real outputs.
        read: Reads one output in an empty folder; may raise only fieldkit's errors.
        weight: Relative frequency; lower for slow readers.
        cpu_s: Maximum processor time, in seconds.
    """

    name: str
    seeds: Sequence[bytes]
    read: Callable[[bytes, Path], object]
    weight: float = 1.0
    cpu_s: float = CPU_S


@dataclass(frozen=True)
class Defect:
    """An input that broke its reader.

    Attributes:
        target: Name of the target.
        failure: The exception and its location, or the signal or exit code of the process.
        input: The file with the input.
    """

    target: str
    failure: str
    input: Path


def work(targets: Sequence[Target], seed: int, inputs: range, folder: Path) -> None:
    """Try the inputs with these numbers; stop at the first input that breaks its reader.

    An input depends only on `seed` and its number. A line of JSON is printed before each input, so that the parent
    process can identify the input that terminated this process.
    """
    weights = [target.weight for target in targets]
    for number in inputs:
        rng = random.Random(f"{seed} {number}")
        target = rng.choices(targets, weights)[0]
        data = mutate(rng.choice(target.seeds), target.seeds, rng)
        (folder / "input").write_bytes(data)
        _print_json({"number": number, "target": target.name})
        if failure := try_input(target, data, folder / "place"):
            _print_json({"number": number, "target": target.name, "broke": failure})
            return


def try_input(target: Target, data: bytes, place: Path) -> str | None:
    """Read an input with a reader; return a description of its exception, or None for no exception or fieldkit's
    errors.

    If a time limit is exceeded, a signal terminates this process.

    Args:
        target: The reader.
        data: The input.
        place: Folder that is created empty and is the working folder of the reader.
    """
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    used_bytes = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    _, hard_limit = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + MEMORY_BYTES, hard_limit))
    signal.setitimer(signal.ITIMER_PROF, target.cpu_s)
    signal.setitimer(signal.ITIMER_REAL, MAX_WAIT_S)
    try:
        with contextlib.chdir(place):
            target.read(data, place)
    except FieldkitError as error:
        return None if str(error) else "an error without text"
    except BaseException as error:  # noqa: BLE001 (any exception is a defect)
        return _describe(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (hard_limit, hard_limit))
    return None


def search(targets: str, seed: int, inputs: int, folder: Path, end_s: float = math.inf) -> Iterator[Defect | int]:
    """Yield each defect that mutated inputs reveal, and then the number of tried inputs.

    Args:
        targets: Names of targets, separated by commas; empty for all.
        seed: Seed of the inputs.
        inputs: Number of inputs.
        folder: Folder for the inputs that break a reader, one file each.
        end_s: Time on the monotonic clock at which to stop early.
    """
    start = 0
    while start < inputs and time.monotonic() < end_s:
        with tempfile.TemporaryDirectory() as place:
            stop = min(inputs, start + _INPUTS_PER_WORKER)
            current, failure = _run_worker(("work", targets, str(seed), str(start), str(stop), place), end_s)
            if failure:
                data = Path(place, "input").read_bytes()
                input_file = folder / f"{current['target']}.{hashlib.sha256(data).hexdigest()[:12]}"
                input_file.write_bytes(data)
                yield Defect(current["target"], failure, input_file)
        start = current["number"] + 1
    yield start


def _run_worker(arguments: Sequence[str], end_s: float) -> tuple[dict[str, Any], str | None]:
    """Run a worker; return the last input that it started, and the defect or None."""
    command = (sys.executable, "-m", "tests.fuzz", *arguments)
    current: dict[str, Any] = {"number": -1, "target": ""}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        for line in worker.stdout:
            current = json.loads(line)
            if "broke" in current:
                return current, current["broke"]
            if time.monotonic() > end_s:
                worker.kill()
                return current, None
    if worker.returncode == 0:
        return current, None
    if not current["target"]:
        raise RuntimeError(f"the worker does not start: {command}")
    return current, f"ended by {_exit_reason(worker.returncode)}"


def _exit_reason(code: int) -> str:
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"


def _print_json(value: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def _describe(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own_frames = [
        frame for frame in frames if "/fieldkit/" in frame.filename and "/tests/" not in frame.filename
    ] or frames
    return (
        f"{type(error).__name__} at {Path(own_frames[-1].filename).name}:{own_frames[-1].lineno}: {str(error)[:150]}"
    )


def replay(inputs: Sequence[Path]) -> list[str | None]:
    """Try inputs in a separate process, or in several if inputs terminate it; return the defects, or None."""
    failures: list[str | None] = []
    while len(failures) < len(inputs):
        with tempfile.TemporaryDirectory() as place:
            paths = [str(path.absolute()) for path in inputs[len(failures) :]]
            command = (sys.executable, "-m", "tests.fuzz", "again", place, *paths)
            process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        failures += map(json.loads, process.stdout.splitlines())
        if len(failures) < len(inputs):
            failures.append(f"ended by {_exit_reason(process.returncode)}")
    return failures
