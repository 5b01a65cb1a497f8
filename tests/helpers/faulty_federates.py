"""Federates that have a fault after 200 ms of simulated time.

`python -m tests.helpers.faulty_federates ROLE FAULT` serves one over its standard input and output. Without arguments
it reads lines `ROLE FAULT ADDRESS RUNS DELAY`, serves each federate in a forked process, and prints the process id.
Because of the fork, the imports are executed only once.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from sim_backends.federates import answering
from sim_backends.federates.serving import serve
from sim_backends.network.disc import Disc
from tests.helpers.federate_examples import carts

FAULT_NS: Final = 200_000_000
DELAY_S: Final = 2.5
"""Delay of an answer: longer than the deadline of the tests."""
FAULTS: Final = ("killed", "suspended", "delayed", "garbage", "raises")


class _Net(Disc):
    def __init__(self, hello: object) -> None:
        super().__init__(1e5, 1_000_000)


def _send_garbage(run: answering._Run, frame: bytes) -> None:
    run.channel.send(b"garbage" * 9, None)


def _fail(fault: str) -> None:
    if fault == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "suspended":
        os.kill(os.getpid(), signal.SIGSTOP)
    if fault == "delayed":
        time.sleep(DELAY_S)
    if fault == "garbage":
        answering._Run._send = _send_garbage  # type: ignore[method-assign, assignment]
    if fault == "raises":
        raise ValueError("no wheels")


def make_faulty_class(role: str, fault: str) -> Any:  # noqa: ANN401 (a class that is defined here)
    """Return the class of a federate with a fault."""

    class Faulty(carts() if role == "physics" else _Net):  # type: ignore[misc]
        def advance(self, to_ns: int, *arguments: object) -> object:
            if to_ns > FAULT_NS:
                _fail(fault)
            return super().advance(to_ns, *arguments)

    if fault == "delayed":  # like a program that computes for a long time and has no thread for heartbeats
        answering._Heartbeat.begin = lambda *_: None  # type: ignore[method-assign]
    return Faulty


class Federates:
    """Starts federates as forks of a process that has done all imports."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process

    def start(self, role: str, fault: str, address: str, *, runs: int = 1, delay_s: float = 0.0) -> int:
        """Start a federate after a delay; return its process id.

        Args:
            role: `physics` or `network`.
            fault: Its fault, or `none`.
            address: Its address.
            runs: Number of runs that it serves.
            delay_s: The delay.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{role} {fault} {address} {runs} {delay_s}\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())


@contextmanager
def forked_federates() -> Iterator[Federates]:
    """Yield an object that starts federates; all of them are killed at the end."""
    process = subprocess.Popen(
        (sys.executable, "-m", "tests.helpers.faulty_federates"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        yield Federates(process)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def main() -> None:
    """Serve one federate, or fork one for each line of the input."""
    if len(sys.argv) > 1:
        serve(make_faulty_class(*sys.argv[1:]), name="faulty")
        return
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel removes children that have exited
    for line in sys.stdin:
        role, fault, address, runs, delay_s = line.split()
        pid = os.fork()
        if pid == 0:
            time.sleep(float(delay_s))
            serve(make_faulty_class(role, fault), name="faulty", address=address, runs=int(runs))
            os._exit(0)
        print(pid, flush=True)  # noqa: T201 (read by the test)


if __name__ == "__main__":
    main()
