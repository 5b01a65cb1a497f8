"""Sandboxed reading of untrusted files, in a process with limits for memory, CPU time and disk.

An untrusted file can make a library decompress any amount of data, run queries that the file's database schema
defines, or follow references without end. A check of the file in advance cannot detect all of this. The reader is a
process, because a process can be killed, unlike a thread. The first query starts it, which takes 0.1 s; the process
also answers later queries. It exits if it is idle for some time, if this process exits, and if it runs out of memory.
"""

import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Any, Final

MEMORY_BYTES: Final = 256 << 20
DISK_BYTES: Final = 16 << 20
CPU_S: Final = 10
"""Base limits for reading a file of any size. The limit of the disk applies to each file that the reader writes."""
MEMORY_PER_BYTE: Final = 16
DISK_PER_BYTE: Final = 1
BYTES_PER_CPU_S: Final = 1 << 20
"""Additional limits: memory and disk per byte of the file, and one second of CPU time per this number of bytes. For
example, an index entry of 12 bytes in a bag becomes an object of 170 bytes in memory."""
ANSWER_BYTES: Final = 16 << 20
ANSWER_PER_BYTE: Final = 4
"""Limit of an answer's length: a base, and an addition per byte of the file."""
MEMORY_SHARE: Final = 0.5
MAX_CPU_S: Final = 3600
"""Upper limits for a file of any size: share of this machine's memory (but at least `MEMORY_BYTES`), and CPU time."""

# A reader that waits without using CPU time, for example for a named pipe, needs a limit of wall-clock time. This
# limit is larger than the CPU time, because other processes may use the CPU.
_WALL_PER_CPU_S: Final = 6
_EXIT_WAIT_S: Final = 5.0
"""Time within which a process that has closed its output must exit; otherwise it is killed."""
ERROR_KEY: Final = "unanswered"
"""Key of the error message in the answer to a query that failed."""
_TIMED_OUT: Final = -signal.SIGXCPU
"""Exit code of a process that exceeded a time limit: the kernel sends SIGXCPU at the limit of CPU time."""
# Exit codes that the file did not cause: 0 after the idle time; signals of the kernel's out-of-memory killer, a
# service manager or a person.
_EXTERNAL_EXIT_CODES: Final = {0, -signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT}

Json = dict[str, Any]
"""A query or an answer. Each reader module defines its keys."""


class ReaderError(Exception):
    """The reader returned no answer; the message is the reason."""


class SandboxedReader:
    """A sandboxed process that answers queries about files.

    Args:
        module: Name of a module that calls `sandbox_process.serve` when it is run.
    """

    def __init__(self, module: str) -> None:
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._owner_pid = 0
        self._query_lock = Lock()

    def query(self, question: Json, size_bytes: int) -> Json:
        """Return the answer to a query about a file.

        Args:
            question: Argument of the function that the module passed to `sandbox_process.serve`.
            size_bytes: Size of the file; the limits grow with it.

        Raises:
            ReaderError: The reader failed, or exceeded the limits of memory, disk or time.
        """
        with self._query_lock:
            for _ in range(2):  # the second time only if the process was stopped from outside
                with _temporary_folder() as folder:
                    answer, code = self._exchange([question, _limits(size_bytes), folder], size_bytes)
                if answer or code not in _EXTERNAL_EXIT_CODES:
                    break
        if not answer:
            raise ReaderError(_exit_reason(code, size_bytes))
        if ERROR_KEY in answer:
            raise ReaderError(answer[ERROR_KEY])
        return answer

    def stop(self) -> None:
        """Stop the process, which otherwise exits after an idle time."""
        with self._query_lock:
            if self._process is not None and self._owner_pid == os.getpid():
                self._kill(self._process)

    def _exchange(self, question: Sequence[object], size_bytes: int) -> tuple[Json, int]:
        """Return the answer and 0, or an empty answer and the exit code if the process exited or was killed.

        If the answer is too long, the process is killed, and an answer with `ERROR_KEY` is returned.
        """
        if self._owner_pid != os.getpid():  # after a fork, two processes could receive each other's answers
            self._process, self._owner_pid = None, os.getpid()
        process = self._process = self._process or _start(self._module)
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(question).encode() + b"\n")
            max_bytes = ANSWER_BYTES + ANSWER_PER_BYTE * size_bytes
            line = _read_line(process.stdout.fileno(), max_bytes, _WALL_PER_CPU_S * _cpu_s(size_bytes))
        except TimeoutError:
            self._kill(process)
            return {}, _TIMED_OUT
        except BaseException:  # for example KeyboardInterrupt
            # Otherwise the next query would read the answer to this query.
            self._kill(process)
            raise
        if len(line) > max_bytes:
            self._kill(process)
            return {ERROR_KEY: "its contents exceed the limit for a file of this size"}, 0
        if line.endswith(b"\n"):
            return json.loads(line), 0
        return {}, self._kill(process, _EXIT_WAIT_S)

    def _kill(self, process: subprocess.Popen[bytes], wait_s: float = 0.0) -> int:
        """Kill the process unless it exits within `wait_s`, and return its exit code."""
        self._process = None
        with suppress(subprocess.TimeoutExpired):
            process.wait(wait_s)
        process.kill()
        with process:  # closes the pipes of the process
            return process.wait()


@contextmanager
def _temporary_folder() -> Iterator[str | None]:
    """Create a folder for unpacked files, and remove it even if the reader is killed.

    The folder is None if it cannot be created, for example on a full disk. This is not an error, because few files
    need the folder.
    """
    folder = None
    with suppress(OSError):
        folder = tempfile.mkdtemp(prefix="fieldkit-")
    try:
        yield folder
    finally:
        remove_folder(folder)


def remove_folder(folder: str | None) -> None:
    """Remove a folder of unpacked files; does nothing if `folder` is None."""
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


def _limits(size_bytes: int) -> tuple[int, int, int]:
    """Return the limits of memory and of written files in bytes, and of CPU time in s, for a file of this size."""
    machine_bytes = os.sysconf("SC_PHYS_PAGES") * resource.getpagesize()
    max_bytes = max(MEMORY_BYTES, int(MEMORY_SHARE * machine_bytes))
    memory_bytes = min(MEMORY_BYTES + MEMORY_PER_BYTE * size_bytes, max_bytes)
    return memory_bytes, DISK_BYTES + DISK_PER_BYTE * size_bytes, _cpu_s(size_bytes)


def _exit_reason(code: int, size_bytes: int) -> str:
    if code == _TIMED_OUT:
        return f"reading it takes longer than {_cpu_s(size_bytes)} s, the limit for a file of this size"
    if code in _EXTERNAL_EXIT_CODES:
        return "another process or the kernel stopped its reader twice; check that this machine has free memory"
    return f"its reader exited with code {code}"


def _cpu_s(size_bytes: int) -> int:
    return min(CPU_S + size_bytes // BYTES_PER_CPU_S, MAX_CPU_S)


def _start(module: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        (sys.executable, "-P", "-m", module),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        bufsize=0,
        start_new_session=True,  # Ctrl-C must not reach it, because the current repeat is still completed
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # numpy reserves memory for a thread per core
    )


def _read_line(descriptor: int, max_bytes: int, timeout_s: float) -> bytes:
    """Return the bytes up to the end of a line or of the file; reading stops after more than `max_bytes`.

    Raises:
        TimeoutError: No end was reached within `timeout_s`.
    """
    deadline_s = time.monotonic() + timeout_s
    line = bytearray()
    pipe = select.poll()
    pipe.register(descriptor, select.POLLIN)
    while not line.endswith(b"\n") and len(line) <= max_bytes:
        if not pipe.poll(max(0.0, 1e3 * (deadline_s - time.monotonic()))):
            raise TimeoutError
        piece = os.read(descriptor, 1 << 16)
        if not piece:
            break
        line += piece
    return bytes(line)
