"""Lifetimes of watched programs in chosen network namespaces, from kernel events and without effect on the programs.

The kernel reports every exec and exit with its time on the monotonic clock (process events connector,
linux/cn_proc.h). The lifetime of a program is therefore defined independently of how it is started: from the exec of
the program to the exit of its process.
"""

import ctypes
import json
import os
import select
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from fieldkit.core.deadline import Deadline

# linux/netlink.h, linux/connector.h, linux/cn_proc.h; the headers are struct nlmsghdr, cn_msg and proc_event.
_NETLINK_CONNECTOR: Final = 11
_CN_IDX_PROC: Final = 1
_CN_VAL_PROC: Final = 1
_PROC_CN_MCAST_LISTEN: Final = 1
_NLMSG_DONE: Final = 3
# linux/socket.h.
_SO_RCVBUFFORCE: Final = 33
_SO_ATTACH_FILTER: Final = 26
_EXEC: Final = 0x00000002
_EXIT: Final = 0x80000000
_HEADERS: Final = struct.Struct("=IHHII IIIIHH")
_EVENT: Final = struct.Struct("=IIQ II")

_REALTIME_PRIORITY: Final = "10"
_REPORT_S: Final = 2.0
"""Time within which the watcher must report an exit."""
_INTERPRETERS: Final = (["sh"], ["bash"])
_ROOT: Final = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Lifetime:
    """One execution of a program.

    Attributes:
        program: Name of the program.
        argv: Its command line.
        start_ns: Time of its exec, on the monotonic clock.
        end_ns: Time of its exit.
    """

    program: str
    argv: tuple[str, ...]
    start_ns: int
    end_ns: int


class Lines:
    """Lines from a pipe, read with a deadline.

    Args:
        fd: The pipe, which the caller closes.
        source: Name of the writer, for messages.
    """

    def __init__(self, fd: int, source: str) -> None:
        self._fd = fd
        self._source = source
        self._pending = b""

    def next(self, deadline: Deadline) -> str:
        """Return the next line without its end.

        Raises:
            EOFError: The writer exited.
            TimeoutError: It wrote no line in time.
        """
        while b"\n" not in self._pending:
            readable, _, _ = select.select([self._fd], [], [], deadline.remaining_s)
            if not readable:
                raise TimeoutError(f"{self._source} wrote nothing in time")
            data = os.read(self._fd, 1 << 16)
            if not data:
                raise EOFError(f"{self._source} exited")
            self._pending += data
        line, self._pending = self._pending.split(b"\n", 1)
        return line.decode()


class Watch:
    """Records the lifetimes of programs while the context is open, in a separate process.

    It runs at real-time priority, because a short-lived program must be identified before it exits.

    Args:
        pids: Processes whose network namespaces are watched.
        programs: Names of the programs.
    """

    def __init__(self, pids: Sequence[int], programs: Sequence[str]) -> None:
        namespaces = ",".join(str(_namespace(pid)) for pid in pids)
        killed_with_parent = ("setpriv", "--pdeathsig", "KILL", "--", "chrt", "--fifo", _REALTIME_PRIORITY)
        self._process = subprocess.Popen(
            [*killed_with_parent, sys.executable, "-m", "benchmarks.lifetimes", namespaces, *programs],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,
            cwd=_ROOT,
        )
        assert self._process.stdout is not None
        self._lines = Lines(self._process.stdout.fileno(), "the watcher of programs")

    def __enter__(self) -> Self:
        try:
            self._lines.next(Deadline.after(10.0))
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, count: int, since_ns: int) -> tuple[Lifetime, ...]:
        """Return the lifetimes of `count` programs that started after `since_ns`, in the order of their exits.

        Raises:
            EOFError: The watcher exited.
            TimeoutError: There were fewer: a program exited before it was identified, or still runs.
        """
        deadline = Deadline.after(_REPORT_S)
        lifetimes: list[Lifetime] = []
        while len(lifetimes) < count:
            program, argv, start_ns, end_ns = json.loads(self._lines.next(deadline))
            if start_ns >= since_ns:
                lifetimes.append(Lifetime(program, tuple(argv), start_ns, end_ns))
        return tuple(lifetimes)

    def close(self) -> None:
        """Stop the watcher; a second call has no effect."""
        self._process.kill()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()


def _namespace(pid: int) -> int:
    return Path(f"/proc/{pid}/ns/net").stat().st_ino


def _events() -> Iterator[tuple[int, int, int]]:
    """Yield kind, time in ns and process id of every exec and exit of a process."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, _NETLINK_CONNECTOR) as channel:
        channel.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 4 << 20)
        _filter_events(channel, _EXEC, _EXIT)
        channel.bind((0, _CN_IDX_PROC))
        headers = (_HEADERS.size + 4, _NLMSG_DONE, 0, 0, 0, _CN_IDX_PROC, _CN_VAL_PROC, 0, 0, 4, 0)
        channel.send(_HEADERS.pack(*headers) + struct.pack("=I", _PROC_CN_MCAST_LISTEN))
        print("ready", flush=True)  # later events wait in the socket
        while True:
            data = channel.recv(1 << 12)
            if len(data) < _HEADERS.size + _EVENT.size:
                continue
            kind, _, t_ns, thread, process = _EVENT.unpack_from(data, _HEADERS.size)
            if kind == _EXEC or (kind == _EXIT and thread == process):
                yield kind, t_ns, process


def _filter_events(channel: socket.socket, *kinds: int) -> None:
    """Make the kernel drop events of other kinds, because unnecessary wake-ups delay the watcher."""
    # struct sock_filter, linux/filter.h: load the kind (in network byte order), compare, accept or drop.
    load = [(0x20, 0, 0, _HEADERS.size)]
    compare = [(0x15, len(kinds) - n, 0, socket.htonl(kind)) for n, kind in enumerate(kinds)]
    program = [*load, *compare, (0x06, 0, 0, 0), (0x06, 0, 0, 0xFFFFFFFF)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *instruction) for instruction in program))
    channel.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("HP", len(program), ctypes.addressof(code)))


def _identify(pid: int, namespaces: frozenset[int], programs: frozenset[str]) -> tuple[str, list[str]] | None:
    """Return name and command line of a process after its exec, or None if it is not watched."""
    with suppress(OSError):  # it has exited already
        with open(f"/proc/{pid}/cmdline", "rb", buffering=0) as file:  # noqa: PTH123 (pathlib is slower, and the process may exit)
            argv = file.read().decode(errors="replace").split("\0")[:-1]
        names = [word.rsplit("/", 1)[-1] for word in argv[:2]]
        # The name of a script is the second word of its command line.
        name = names[-1] if names[:1] in _INTERPRETERS else "".join(names[:1])
        if name in programs and _namespace(pid) in namespaces:
            return name, argv
    return None


def main() -> None:
    """Print each watched program at its exit as a JSON line: program, command line, start and end in ns."""
    namespaces, programs = frozenset(map(int, sys.argv[1].split(","))), frozenset(sys.argv[2:])
    running: dict[int, tuple[str, list[str], int]] = {}
    for kind, t_ns, pid in _events():
        if kind == _EXIT:
            if program_start := running.pop(pid, None):
                print(json.dumps([*program_start, t_ns]), flush=True)
        elif pid not in running and (identified := _identify(pid, namespaces, programs)):
            running[pid] = (*identified, t_ns)


if __name__ == "__main__":
    main()
