"""TCP of the co-simulation compared with this machine's kernel: `python -m benchmarks.tcp_vs_kernel`, as root.

One station sends to another at the full rate of TCP, over links with the same rate, delay and loss in both
directions. The kernel runs iperf3 between two namespaces on the medium of the emulated backend; the co-simulation
uses the same link model. Each run has a different seed. A row has the mean goodputs, and the ratio of the
co-simulation to the kernel with its 95 % interval.
"""

import argparse
import math
import os
import platform
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Final, get_args

import numpy as np
from scipy.stats import t as student

from benchmarks.medium import iperf, listening_iperf, medium_path
from sim_backends.network.packets import Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.network.tcp.connection import Tcp
from sim_backends.network.tcp.tcp_options import Congestion, TcpOptions
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State

LOSSES: Final = ("0.1%", "1%", "5%")
DELAYS: Final = ("10ms", "50ms")
"""Delay of each link; a round trip takes twice that."""
RATE: Final = "100Mbit/s"
KERNEL: Final = "cubic"
MESSAGE_BYTES: Final = 10 * TcpOptions().segment_bytes
_MAX_GOODPUT_BIT_S: Final = 100_000_000  # as RATE


@dataclass(frozen=True)
class Link:
    """Loss and delay of a link in both directions, as in a site file."""

    loss: str
    delay: str

    @property
    def options(self) -> RadioOptions:
        """The link as the option `radio` of a site file."""
        return RadioOptions.model_validate({"loss": self.loss, "delay": self.delay, "rate": RATE})


def cosim_bit_s(link: Link, congestion: Congestion, seconds: float, seed: int) -> float:
    """Return the goodput of the co-simulation's TCP in bit/s."""
    network = RadioNetwork(
        UniformLinks(seed, link.options),
        ("client", "server"),
        transports={"tcp": partial(Tcp, options=TcpOptions(congestion=congestion))},
    )
    count = math.ceil(_MAX_GOODPUT_BIT_S * seconds / (8 * MESSAGE_BYTES))
    stream = [
        Packet(number, "client", "server", MESSAGE_BYTES, ("s", number), 0, 0, "tcp") for number in range(count)
    ]
    states = {"client": State((0.0, 0.0, 0.0)), "server": State((9.0, 0.0, 0.0))}
    arrivals, _ = network.advance(round(seconds * 1e9), stream, states)
    return len(arrivals) * MESSAGE_BYTES * 8 / seconds


def kernel_bit_s(link: Link, control: str, seconds: float, seed: int) -> float:
    """Return the goodput of the kernel's TCP in bit/s."""
    with medium_path(link.options, seed=seed) as (client, server), listening_iperf(server):
        return iperf(client, seconds, "--congestion", control)["sum_received"]["bits_per_second"]


def ratio(cosim_runs: np.ndarray, kernel_array: np.ndarray) -> tuple[float, float]:
    """Return the ratio of two means of independent runs, and half of its 95 % interval (delta method, Welch's df)."""
    value = float(cosim_runs.mean() / kernel_array.mean())
    shares = [float(runs.var(ddof=1) / len(runs) / runs.mean() ** 2) for runs in (cosim_runs, kernel_array)]
    total = sum(shares)
    degrees_of_freedom = total**2 / sum(
        share**2 / (len(runs) - 1) for share, runs in zip(shares, (cosim_runs, kernel_array), strict=True)
    )
    return value, float(student.ppf(0.975, degrees_of_freedom)) * value * math.sqrt(total)


def row(link: Link, kernel_runs: Sequence[float], controls: Sequence[Congestion], seconds: float) -> Iterator[str]:
    """Yield the parts of a row of the table."""
    kernel_array = np.array(kernel_runs)
    yield f"{link.loss:>5} {link.delay:>5}  kernel {kernel_array.mean() / 1e6:6.3f} Mbit/s ({len(kernel_array)} runs)"
    for control in controls:
        cosim_runs = np.array([cosim_bit_s(link, control, seconds, seed) for seed in range(2 * len(kernel_array))])
        value, half = ratio(cosim_runs, kernel_array)
        yield f"{control} {cosim_runs.mean() / 1e6:6.3f} {value:.2f} [{value - half:.2f}, {value + half:.2f}]"


def main() -> None:
    """Measure and print a row per link."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--runs", type=int, default=12, help="runs of the kernel per link; the co-simulation has twice as many"
    )
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--together", type=int, default=4, help="runs of the kernel at the same time")
    parser.add_argument("--kernel", default=KERNEL, help="congestion control of the kernel")
    parser.add_argument("--loss", nargs="+", default=LOSSES)
    parser.add_argument("--delay", nargs="+", default=DELAYS)
    options = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"Linux {platform.release()}, {options.kernel}; {RATE}; runs of {options.seconds:g} s; load {load:.1f}")
    with ThreadPoolExecutor(options.together) as pool:
        for link in (Link(loss, delay) for loss in options.loss for delay in options.delay):
            run = partial(kernel_bit_s, link, options.kernel, options.seconds)
            kernel_runs = list(pool.map(run, range(options.runs)))
            print(" | ".join(row(link, kernel_runs, get_args(Congestion), options.seconds)), flush=True)


if __name__ == "__main__":
    main()
