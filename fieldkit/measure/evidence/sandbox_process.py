"""The process of a sandboxed reader: it limits its resources and answers the queries of `SandboxedReader`."""

import json
import math
import resource
import select
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from fieldkit.measure.evidence.sandbox import ERROR_KEY, Json, remove_folder

_IDLE_MS: Final = 60_000
"""Idle time in ms after which the process exits. It is longer than most repeats, so that one process usually serves a
whole trial. The process also exits with its parent process, because its input is then closed."""


def serve(answer: Callable[[Json], Json]) -> None:
    """Answer queries from standard input until the process is idle, the input ends, or memory is exhausted.

    Args:
        answer: Function that returns the answer to a query.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError):  # if memory is short, the kernel should kill this process instead of its parent
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    questions = select.poll()
    questions.register(sys.stdin.fileno(), select.POLLIN)
    has_memory = True
    while has_memory and questions.poll(_IDLE_MS) and (line := sys.stdin.readline()):
        question, limits, tempfile.tempdir = json.loads(line)  # libraries unpack files into this folder
        _apply_limits(*limits)
        try:
            reply = answer(question)
        except Exception as error:  # noqa: BLE001 (the file may cause any exception)
            has_memory = not isinstance(error, MemoryError)
            reply = {ERROR_KEY: _error_text(error)}
        remove_folder(tempfile.tempdir)  # done here, because the parent process may have been killed
        sys.stdout.write(json.dumps(reply) + "\n")
        sys.stdout.flush()


def _apply_limits(memory_bytes: int, disk_bytes: int, cpu_s: int) -> None:
    """Limit the memory and CPU time that this process may use in addition to its current use, and its files.

    `disk_bytes` is the maximum size of each file that it writes.
    """
    used_bytes = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    used = resource.getrusage(resource.RUSAGE_SELF)
    limits = {
        resource.RLIMIT_AS: used_bytes + memory_bytes,
        resource.RLIMIT_FSIZE: disk_bytes,
        resource.RLIMIT_CPU: math.ceil(used.ru_utime + used.ru_stime) + cpu_s,
    }
    for kind, limit in limits.items():
        _, hard_limit = resource.getrlimit(kind)
        soft_limit = limit if hard_limit == resource.RLIM_INFINITY else min(limit, hard_limit)
        resource.setrlimit(kind, (soft_limit, hard_limit))


def _error_text(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "reading it needs more memory than the limit for a file of this size"
    return f"{type(error).__name__}: {' '.join(str(error)[:1000].split())}"[:300]
