"""Feed mutated outputs to readers, in a process that may break, and keep each input that broke it."""

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
from tests.fuzz.mutate import mutated
from tests.helpers.paths import ROOT

CPU_S: Final = 30.0
MEMORY_BYTES: Final = 512 << 20
"""An input of at most 1 MiB may take so much computing and memory."""
WAITS_S: Final = 200.0
"""A reader that waits for what never comes computes nothing; after this time it is a defect too."""

_TOGETHER: Final = 5_000
"""Inputs that one process tries: what memory it may lose by itself is none of theirs."""


@dataclass(frozen=True)
class Target:
    """A reader of something that a robot or a colleague sends.

    Attributes:
        name: What it reads.
        seeds: Kept real outputs.
        read: Reads one, given an empty folder to write it into; may raise fieldkit's errors alone.
        weight: How often it is tried, compared with others; slow ones less.
        cpu_s: How long it may compute, in seconds.
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
        target: Name of the reader.
        what: What was raised and where, or how the process ended.
        input: The file that holds it.
    """

    target: str
    what: str
    input: Path


def work(targets: Sequence[Target], seed: int, inputs: range, folder: Path) -> None:
    """Try the inputs of these numbers, each made from `seed` and its number alone; end with the first that breaks.

    Prints a line of JSON per input begun, so that whoever started this process knows what broke it.
    """
    weights = [target.weight for target in targets]
    for number in inputs:
        rng = random.Random(f"{seed} {number}")
        target = rng.choices(targets, weights)[0]
        data = mutated(rng.choice(target.seeds), target.seeds, rng)
        (folder / "input").write_bytes(data)
        _say({"number": number, "target": target.name})
        if what := tried(target, data, folder / "place"):
            _say({"number": number, "target": target.name, "broke": what})
            return


def tried(target: Target, data: bytes, place: Path) -> str | None:
    """Let a reader read an input; return what it raised, but for fieldkit's errors.

    Where it takes longer than it may, this process ends by a signal, whatever it is in the midst of.

    Args:
        target: The reader.
        data: The input.
        place: An empty folder is made of it, the current one meanwhile.
    """
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    held_bytes = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (held_bytes + MEMORY_BYTES, most))
    signal.setitimer(signal.ITIMER_PROF, target.cpu_s)
    signal.setitimer(signal.ITIMER_REAL, WAITS_S)
    try:
        with contextlib.chdir(place):
            target.read(data, place)
    except FieldkitError as error:
        return None if str(error) else "an error that says nothing"
    except BaseException as error:  # noqa: BLE001 (that is what is looked for)
        return _where(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    return None


def hunted(targets: str, seed: int, inputs: int, folder: Path, ends_s: float = math.inf) -> Iterator[Defect | int]:
    """Yield each defect that mutated inputs show, and at last how many inputs were tried.

    Args:
        targets: Names of targets, separated by commas; empty for all.
        seed: Makes the inputs: the same seed, the same inputs.
        inputs: How many of them.
        folder: Gets the inputs that broke something, a file each.
        ends_s: When to end on the monotonic clock, however many were tried.
    """
    at = 0
    while at < inputs and time.monotonic() < ends_s:
        with tempfile.TemporaryDirectory() as place:
            stop = min(inputs, at + _TOGETHER)
            last, what = _watched(("work", targets, str(seed), str(at), str(stop), place), ends_s)
            if what:
                data = Path(place, "input").read_bytes()
                kept = folder / f"{last['target']}.{hashlib.sha256(data).hexdigest()[:12]}"
                kept.write_bytes(data)
                yield Defect(last["target"], what, kept)
        at = last["number"] + 1
    yield at


def _watched(what: Sequence[str], ends_s: float) -> tuple[dict[str, Any], str | None]:
    """Run a worker; return the last input that it began, and what broke it."""
    command = (sys.executable, "-m", "tests.fuzz", *what)
    last: dict[str, Any] = {"number": -1, "target": ""}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        for line in worker.stdout:
            last = json.loads(line)
            if "broke" in last:
                return last, last["broke"]
            if time.monotonic() > ends_s:
                worker.kill()
                return last, None
    if worker.returncode == 0:
        return last, None
    if not last["target"]:
        raise RuntimeError(f"the worker does not start: {command}")
    ended = signal.Signals(-worker.returncode).name if worker.returncode < 0 else f"exit code {worker.returncode}"
    return last, f"ended by {ended}"


def _say(what: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/fieldkit/" in frame.filename and "/tests/" not in frame.filename] or frames
    return f"{type(error).__name__} at {Path(ours[-1].filename).name}:{ours[-1].lineno}: {str(error)[:150]}"


def replayed(kept: Path) -> str | None:
    """Try an input that a hunt has kept, in a process of its own; return what broke."""
    with tempfile.TemporaryDirectory() as place:
        command = (sys.executable, "-m", "tests.fuzz", "again", str(kept.absolute()), place)
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode < 0:
        return f"ended by {signal.Signals(-done.returncode).name}"
    return done.stdout.strip() or None
