"""How a robot's services start: a program of its own, or a fork of the first process, which has all it needs."""

import os
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

_LOG_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_APPEND
_LOG_MODE: Final = 0o600


def program(argv: tuple[str, ...], environment: Mapping[str, str], log: Path) -> int:
    """Start a program in a session of its own, its output in `log`; return its process id.

    Raises:
        OSError: The program is missing.
    """
    return os.posix_spawn(
        argv[0],
        argv,
        environment,
        file_actions=[
            (os.POSIX_SPAWN_OPEN, 0, "/dev/null", os.O_RDONLY, 0),
            (os.POSIX_SPAWN_OPEN, 1, str(log), _LOG_FLAGS, _LOG_MODE),
            (os.POSIX_SPAWN_DUP2, 1, 2),
        ],
        setsid=True,
        setsigmask=[],
        setsigdef=[signal.SIGPIPE, signal.SIGXFSZ],  # which Python ignores
    )


def fork(name: str, work: Callable[[], None], log: Path) -> int:
    """Do `work` in a process of this name and a session of its own, its output in `log`; return its process id.

    It shares the memory of this process, and no descriptor. Call it from a process of one thread.
    """
    pid = os.fork()
    if pid == 0:
        os._exit(_run(name, work, log))
    return pid


def call_me(name: str) -> None:
    """Give this process a name that people find: an interpreter's says nothing."""
    Path("/proc/self/comm").write_text(name, encoding="ascii")


def _run(name: str, work: Callable[[], None], log: Path) -> int:
    try:
        call_me(name)
        _part(log)
        work()
    except BaseException:  # noqa: BLE001 (whatever it is ends this process, not the one that it was forked from)
        sys.excepthook(*sys.exc_info())
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def _part(log: Path) -> None:
    """Leave the session, the descriptors and the signal handling of the process that this one was forked from."""
    os.setsid()
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(os.open(log, _LOG_FLAGS, _LOG_MODE), 1)
    os.dup2(1, 2)
    os.closerange(3, os.sysconf("SC_OPEN_MAX"))
