"""Reading what may be made to harm in a process of its own, whose memory, time and disk are bounded.

A library that takes a file at its word decompresses what it is given as a whole, asks a database whatever its schema
makes of a question, and follows every reference. No look at a file beforehand foresees all of it, and a thread cannot
be ended; a process can, by the kernel. It is started with the first question and asked the next ones too, as to start
one takes 0.1 s. It ends when nobody asks, and when it has run out of memory.
"""

import json
import math
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from typing import Any, Final

MEMORY_BYTES: Final = 256 << 20
DISK_BYTES: Final = 16 << 20
CPU_S: Final = 10
"""What reading a file may take, whatever its size."""
MEMORY_PER_BYTE: Final = 16
DISK_PER_BYTE: Final = 1
ANSWER_BYTES: Final = 16 << 20
ANSWER_PER_BYTE: Final = 4
BYTES_PER_CPU_S: Final = 1 << 20
"""What it may take beside that by its size; an index entry of 12 bytes in a bag becomes an object of 170."""
MEMORY_SHARE: Final = 0.5
MOST_CPU_S: Final = 3600
"""What no file may take more of, whatever its size: of this machine's memory, and of time."""

# Others compute too on a busy machine; what waits, as for a named pipe, does not compute.
_WALL_PER_CPU_S: Final = 6
_IDLE_MS: Final = 60_000
"""Longer than a repeat, so that one process does for a trial; it ends with who asks, too, for its input ends then."""
_END_S: Final = 5.0
_UNANSWERED: Final = "unanswered"
_TOO_LONG: Final = -signal.SIGXCPU
# Nobody asked for a while, or somebody ended it: the kernel where memory is short, a person, a service manager.
_NOT_BY_THE_FILE: Final = {0, -signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT}

Json = dict[str, Any]
"""A question or an answer, whose keys only those two know who put and read it."""


class ConfinedAnswerError(Exception):
    """No answer came; says why."""


class Confined:
    """Someone to ask in a process of their own.

    Args:
        module: A module that calls `serve` when it is run.
    """

    def __init__(self, module: str) -> None:
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._asker = 0
        self._one_at_a_time = Lock()

    def ask(self, question: Json, size_bytes: int) -> Json:
        """Return the answer to a question about a file.

        Args:
            question: What `serve` hands on.
            size_bytes: Size of the file, by which the bounds grow.

        Raises:
            ConfinedAnswerError: It takes more memory, disk or time than a file of this size may, or cannot be told.
        """
        with self._one_at_a_time:
            for _ in range(2):
                with _place() as place:
                    answer, code = self._asked([question, _bounds(size_bytes), place], size_bytes)
                if answer or code not in _NOT_BY_THE_FILE:
                    break
        if not answer:
            raise ConfinedAnswerError(_why(code, size_bytes))
        if _UNANSWERED in answer:
            raise ConfinedAnswerError(answer[_UNANSWERED])
        return answer

    def end(self) -> None:
        """End the process, which otherwise does so when nobody has asked for a while."""
        with self._one_at_a_time:
            if self._process is not None and self._asker == os.getpid():
                self._end(self._process)

    def _asked(self, question: Sequence[object], size_bytes: int) -> tuple[Json, int]:
        """Return the answer; an empty one and the exit code where the process ended without, or had to be ended."""
        if self._asker != os.getpid():  # a process that was forked has one of its own: two would mix up its answers
            self._process, self._asker = None, os.getpid()
        process = self._process = self._process or _started(self._module)
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(question).encode() + b"\n")
            most_bytes = ANSWER_BYTES + ANSWER_PER_BYTE * size_bytes
            line = _line(process.stdout.fileno(), most_bytes, _WALL_PER_CPU_S * _cpu_s(size_bytes))
        except TimeoutError:
            self._end(process)
            return {}, _TOO_LONG
        except BaseException:  # a person interrupts: the answer would be taken for that to the next question
            self._end(process)
            raise
        if len(line) > most_bytes:
            self._end(process)
            return {_UNANSWERED: "it says more than a file of its size may"}, 0
        if line.endswith(b"\n"):
            return json.loads(line), 0
        return {}, self._end(process, _END_S)

    def _end(self, process: subprocess.Popen[bytes], patience_s: float = 0.0) -> int:
        """End the process unless it does so itself, and return its exit code."""
        self._process = None
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
        process.kill()
        with process:  # closes its pipes
            return process.wait()


def serve(answer: Callable[[Json], Json]) -> None:
    """Answer questions from standard input until nobody asks, or the memory did not suffice for one."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError):  # where memory is short the kernel is to end this process, and not the one that asks
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    questions = select.poll()
    questions.register(sys.stdin.fileno(), select.POLLIN)
    sane = True
    while sane and questions.poll(_IDLE_MS) and (line := sys.stdin.readline()):
        question, bounds, tempfile.tempdir = json.loads(line)
        _confine(*bounds)
        try:
            said = answer(question)
        except Exception as error:  # noqa: BLE001 (whatever it is, the file made it)
            sane = not isinstance(error, MemoryError)
            said = {_UNANSWERED: _told(error)}
        _remove(tempfile.tempdir)  # who asked may have been killed
        sys.stdout.write(json.dumps(said) + "\n")
        sys.stdout.flush()


@contextmanager
def _place() -> Iterator[str | None]:
    """Make a folder for what has to be unpacked, and remove it also where who unpacks is ended in the midst of it.

    None where no disk has room for one: few files need it.
    """
    place = None
    with suppress(OSError):
        place = tempfile.mkdtemp(prefix="fieldkit-")
    try:
        yield place
    finally:
        _remove(place)


def _remove(place: str | None) -> None:
    if place is not None:
        shutil.rmtree(place, ignore_errors=True)


def _bounds(size_bytes: int) -> tuple[int, int, int]:
    """Return how much memory and disk, in bytes, and how many seconds of computing a file of this size may take."""
    machine_bytes = os.sysconf("SC_PHYS_PAGES") * resource.getpagesize()
    most_bytes = max(MEMORY_BYTES, int(MEMORY_SHARE * machine_bytes))
    memory_bytes = min(MEMORY_BYTES + MEMORY_PER_BYTE * size_bytes, most_bytes)
    return memory_bytes, DISK_BYTES + DISK_PER_BYTE * size_bytes, _cpu_s(size_bytes)


def _confine(memory_bytes: int, disk_bytes: int, cpu_s: int) -> None:
    """Bound what this process may take from now on, beside what it has taken."""
    held_bytes = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    used = resource.getrusage(resource.RUSAGE_SELF)
    bounds = {
        resource.RLIMIT_AS: held_bytes + memory_bytes,
        resource.RLIMIT_FSIZE: disk_bytes,
        resource.RLIMIT_CPU: math.ceil(used.ru_utime + used.ru_stime) + cpu_s,
    }
    for which, bound in bounds.items():
        _, most = resource.getrlimit(which)
        resource.setrlimit(which, (bound if most == resource.RLIM_INFINITY else min(bound, most), most))


def _told(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "it takes more memory than a file of its size may"
    return f"{type(error).__name__}: {' '.join(str(error)[:1000].split())}"[:300]


def _why(code: int, size_bytes: int) -> str:
    if code == _TOO_LONG:
        return f"it takes longer than the {_cpu_s(size_bytes)} s that a file of its size may"
    if code in _NOT_BY_THE_FILE:
        return "its reader was ended twice by something else; is the memory of this machine full?"
    return f"its reader ended with exit code {code}"


def _cpu_s(size_bytes: int) -> int:
    return min(CPU_S + size_bytes // BYTES_PER_CPU_S, MOST_CPU_S)


def _started(module: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        (sys.executable, "-P", "-m", module),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        bufsize=0,
        start_new_session=True,  # the first Ctrl-C lets a repeat finish
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # numpy reserves memory for a thread per core
    )


def _line(descriptor: int, most_bytes: int, within_s: float) -> bytes:
    """Return what can be read until the end of a line or of the file, or until it is more than so many bytes.

    Raises:
        TimeoutError: Neither came in time.
    """
    until_s = time.monotonic() + within_s
    found = bytearray()
    pipe = select.poll()
    pipe.register(descriptor, select.POLLIN)
    while not found.endswith(b"\n") and len(found) <= most_bytes:
        if not pipe.poll(max(0.0, 1e3 * (until_s - time.monotonic()))):
            raise TimeoutError
        piece = os.read(descriptor, 1 << 16)
        if not piece:
            break
        found += piece
    return bytes(found)
