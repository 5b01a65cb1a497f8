"""One processor for this thread and a child process that compute in turns.

If two processes on two processors exchange messages and never compute at the same time, each message resumes a
process on an idle processor with cold caches. On one processor the same messages take less than half of the time.
"""

import os
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final

_STAT: Final = Path("/proc/thread-self/stat")
_PROCESSOR_FIELD: Final = 36
"""Index of the processor in the fields of `/proc/PID/stat` after the name in parentheses; field 39 in proc(5)."""
_PERIOD_S: Final = 0.1
"""Time for which both processes stay on the same processor."""


class ProcessorSharing:
    """Context of an exchange: while this thread waits, it stays on the processor of the child.

    Ten times per second, one exchange is unrestricted: the kernel may then choose another processor because of other
    load. The processor that this thread has after that exchange is used for the next ones. Between exchanges this
    thread is unrestricted, so that threads and processes that it starts are unrestricted, too.

    Args:
        pid: The child. It has one thread.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._allowed_processors = os.sched_getaffinity(0)
        self._processor: int | None = None
        self._change_at_s = 0.0

    def __enter__(self) -> None:
        if self._processor is not None:
            os.sched_setaffinity(0, (self._processor,))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._processor is not None:
            os.sched_setaffinity(0, self._allowed_processors)
        now_s = time.monotonic()
        if now_s < self._change_at_s or len(self._allowed_processors) < 2:
            return
        with suppress(ProcessLookupError):  # the child has exited; the exchange reports this
            if self._processor is not None:
                # The next exchange is unrestricted.
                self._processor = None
                os.sched_setaffinity(self._pid, self._allowed_processors)
                return
            processor = current_processor()
            os.sched_setaffinity(self._pid, (processor,))
            self._processor = processor
            self._change_at_s = now_s + _PERIOD_S


def current_processor() -> int:
    """Return the number of the processor that runs this thread."""
    return int(_STAT.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[_PROCESSOR_FIELD])
