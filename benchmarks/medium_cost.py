"""Processor time of the medium per packet, compared with another version: `python -m benchmarks.medium_cost FOLDER`.

The medium is the process that carries packets between emulated robots. FOLDER is a checkout of the other version, for
example by `git worktree add`; the program needs root. Only the process of the medium is of that version: the senders
are the same. Each round sends datagrams of 64 bytes at a fixed rate through both versions in sequence, over fixed
links and over the Wi-Fi of the default radio. Processor time does not include the time for which the process waited
for a processor, so other load has little effect on it.
"""

import argparse
import os
import statistics
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final
from unittest import mock

from benchmarks.medium import RADIO, packets_in, radio
from benchmarks.namespaces import Namespace
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.process import worker
from sim_backends.radio.radio_options import RadioOptions

_SEND: Final = """
import socket, sys, time
count, interval_s = int(sys.argv[1]), float(sys.argv[2])
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
    start_s = time.monotonic()
    for number in range(count):
        sender.sendto(bytes(64), ("10.9.0.2", 9000))
        time.sleep(max(0.0, start_s + (number + 1) * interval_s - time.monotonic()))
"""
RADIOS: Final = {"fixed links": (radio("0ms"), 4000), "Wi-Fi": (RadioOptions(), 1000)}
"""Radio options, and the number of packets per second."""


def processor_us(project: Path, options: RadioOptions, rate: int, seconds: float) -> float:
    """Return the processor time of a medium in us per packet that it delivered.

    Args:
        project: Checkout of the medium's version.
        options: Options of its radio.
        rate: Number of packets per second.
        seconds: Duration.

    Raises:
        RuntimeError: No packet was delivered.
    """
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(worker, "PROJECT", project))
        client, server = stack.enter_context(Namespace()), stack.enter_context(Namespace())
        medium = stack.enter_context(MediumClient(options, seed=1))
        for name, namespace, address in (("client", client, "10.9.0.1/24"), ("server", server, "10.9.0.2/24")):
            fd = namespace.tun("wlan0", address)
            medium.attach(name, address, RADIO, fd)
            os.close(fd)
        medium.place({"client": (0.0, 0.0, 0.0), "server": (9.0, 0.0, 0.0)})
        client.run("ping", "-c", "3", "10.9.0.2")
        carried, spent_ns = packets_in(server), _processor_ns(medium.pid)
        client.run(sys.executable, "-c", _SEND, str(round(rate * seconds)), str(1 / rate), timeout_s=seconds + 60)
        time.sleep(0.1)
        spent_ns = _processor_ns(medium.pid) - spent_ns
        carried = packets_in(server) - carried
    if not carried:
        raise RuntimeError(f"the medium of {project} delivered no packet")
    return spent_ns / 1e3 / carried


def _processor_ns(pid: int) -> int:
    """Return the processor time of a process in ns (proc(5), /proc/PID/schedstat)."""
    return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[0])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="checkout of the other version")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="duration of each measurement")
    arguments = parser.parse_args()
    print(f"{arguments.rounds} rounds, median (lowest to highest), processor time of the medium in us per packet")
    print(f"{'':14}{'this version':>26}{'other version':>26}{'ratio':>24}")
    for name, (options, rate) in RADIOS.items():
        here_us: list[float] = []
        other_us: list[float] = []
        for number in range(arguments.rounds):
            turns = [(worker.PROJECT, here_us), (arguments.other.resolve(), other_us)]
            for project, spent_us in turns if number % 2 == 0 else reversed(turns):
                spent_us.append(processor_us(project, options, rate, arguments.seconds))
        ratios = [here / other for here, other in zip(here_us, other_us, strict=True)]
        print(f"{name:14}{_spread(here_us, 1):>26}{_spread(other_us, 1):>26}{_spread(ratios, 3):>24}")


def _spread(values: list[float], digits: int) -> str:
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


if __name__ == "__main__":
    main()
