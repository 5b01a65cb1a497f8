"""What the step `topics` adds to a message: `python -m benchmarks.topics [--json] [--rounds N]`; it needs rosmaster.

The agent that the step starts on robots (`agent publish`, `agent subscribe`) beside plain pairs of CycloneDDS, Zenoh
and rospy on loopback, one middleware after the other. In each round all programs begin anew, since where and beside
what a program runs makes more of a difference than the next thousand messages. The pairs of a middleware then send at
the same time, 1,000 bytes at nearly 200 Hz: rates are a little apart, so that in the course of seconds each meets the
others, and whatever else the machine does, at every moment of its period; they change places from round to round.
Medians are taken over the time in which all sent; a ratio is the geometric mean over rounds. In every third round
each pair then sends for a second as fast as it goes, one after the other.

A delay runs from before a sample is made until a subscriber's Python has it.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Final

from benchmarks.bridge import HOST, SIZE, TYPE, Running, Way, free_port, spread
from fieldkit.analysis import statistics
from fieldkit.core.threads import together
from fieldkit.measure.transfers import topic_log
from fieldkit.ros import topics
from fieldkit.ros.qos import PROFILES
from fieldkit.ros.types import shipped

PLAIN: Final = {"dds": ("plain",), "zenoh": ("plain", "attached"), "ros1": ("plain",)}
"""Pairs beside the agent's, of each middleware."""
RATES_HZ: Final = (200.0, 197.0, 203.0)
LASTS_S: Final = 4.0
BURST_S: Final = 1.0
BURST_EVERY: Final = 3
FASTEST_HZ: Final = 1e9
"""No sample is early then."""
_DOMAIN: Final = 62

Times = Sequence[tuple[int, int]]
"""When each message arrived, and how late, in nanoseconds."""


class AgentPair:
    """The two ends that a step `topics` has on two robots, for one stream after the other.

    Args:
        over: The middleware.
        master_port: Of the ROS master.
        folder: For logs.
    """

    def __init__(self, over: str, master_port: int, folder: Path) -> None:
        self._over, self._master_port, self._folder = over, master_port, folder

    @contextmanager
    def stream(self, lasts_s: float, rate_hz: float) -> Iterator["subprocess.Popen[str]"]:
        """Stream while the body runs, and until it is over; yield the publisher, which is up."""
        port = free_port()
        with self._end("subscribe", port, lasts_s, rate_hz) as subscriber:
            with self._end("publish", port, lasts_s, rate_hz) as publisher:
                yield publisher
                if publisher.wait() != 0:
                    raise RuntimeError(f"the publisher over {self._over} ended with {publisher.returncode}")
            subscriber.terminate()

    def arrived(self) -> Times:
        """Return what arrived of the last stream."""
        samples = topic_log.read(self._log("subscribe")).samples
        return list(zip(samples.at_ns.tolist(), (samples.at_ns - samples.sent_ns).tolist(), strict=True))

    @contextmanager
    def _end(self, verb: str, port: int, lasts_s: float, rate_hz: float) -> Iterator["subprocess.Popen[str]"]:
        told = json.dumps({"network": self._network(verb, port), "topic": self._topic(verb), "stream": {
            "over": self._over, "size_bytes": SIZE, "rate_hz": rate_hz, "duration_s": lasts_s, "patience_s": 20.0,
        }})  # fmt: skip
        command = (sys.executable, "-m", "fieldkit.agent", verb, told, str(self._log(verb)))
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            if not (said := process.stderr.readline()).startswith("up,"):
                raise RuntimeError(said + process.stderr.read())
            yield process

    def _network(self, verb: str, port: int) -> dict[str, Any]:
        shared: dict[str, Any] = {"address": HOST, "domain": _DOMAIN, "node": f"harness_{verb}"}
        if self._over == "ros1":
            settings = {"tcp_nodelay": "1"}  # as the plain pair has it
            return shared | {"discovery": "master", "server": HOST, "port": self._master_port, "settings": settings}
        settings = {}
        if self._over == "zenoh":
            # One end listens and the other connects, as those of the plain pair do.
            there = json.dumps([f"tcp/{HOST}:{port}"])
            hears = verb == "subscribe"
            settings = {"listen/endpoints": there if hears else "[]", "connect/endpoints": "[]" if hears else there}
        return shared | {"discovery": "peers", "peers": [HOST], "settings": settings}

    def _topic(self, verb: str) -> dict[str, Any]:
        return topics.describe(
            shipped(), "/harness", TYPE, PROFILES["default"], domain=_DOMAIN, node=f"harness_{verb}"
        )

    def _log(self, verb: str) -> Path:
        return self._folder / f"{self._over}-{verb}.bin"


def at_once(plain: Sequence[Running], own: AgentPair, rates_hz: Sequence[float]) -> list[Times]:
    """Let all pairs of a middleware send at the same time; return what arrived over each while all sent.

    Args:
        plain: The plain pairs.
        own: The agent's.
        rates_hz: Of each, the agent's last.
    """
    with own.stream(LASTS_S, rates_hz[-1]):
        came = together(lambda one: one[0].run(LASTS_S, one[1])[1], list(zip(plain, rates_hz, strict=False)))
    streams = [*came, own.arrived()]
    begun_ns = max(times[0][0] for times in streams)
    ended_ns = min(times[-1][0] for times in streams)
    return [[one for one in times if begun_ns <= one[0] <= ended_ns] for times in streams]


def one_round(over: str, number: int, own: AgentPair, environment: dict[str, str]) -> dict[str, Any]:
    """Return what was measured of a middleware in a round: by pair the median delay, and how many went."""
    pairs = (*PLAIN[over], "agent")
    rates_hz = [RATES_HZ[(place + number) % len(pairs)] for place in range(len(pairs))]
    with ExitStack() as stack:
        ways = [f"{over} {pair}" for pair in PLAIN[over]]
        plain = [Running(stack, Way(way, way, way), environment) for way in ways]
        delays = at_once(plain, own, rates_hz)
        bursts: list[Times] = []
        if number % BURST_EVERY == 0:
            bursts = [one.run(BURST_S, 0)[1] for one in plain]
            with own.stream(BURST_S, FASTEST_HZ):
                pass
            bursts.append(own.arrived())
    return {
        "round": number,
        "over": over,
        "delay_ms": dict(zip(pairs, (median(late for _, late in times) / 1e6 for times in delays), strict=True)),
        "per_s": dict(zip(pairs, map(_per_s, bursts), strict=False)),
    }


def measure(rounds: int) -> list[dict[str, Any]]:
    """Return what was measured in each round of each middleware."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        port = free_port()
        environment = os.environ | {
            "ROS_MASTER_URI": f"http://{HOST}:{port}",
            "ROS_IP": HOST,
            "ROS_HOME": str(folder),
        }
        log = stack.enter_context(Path(folder, "master").open("wb"))
        command = ("rosmaster", "--core", "-p", str(port))
        master = stack.enter_context(subprocess.Popen(command, stdout=log, stderr=log, env=environment))
        stack.callback(master.terminate)
        agents = {over: AgentPair(over, port, folder) for over in PLAIN}
        return [one_round(over, number, own, environment) for number in range(rounds) for over, own in agents.items()]


def _per_s(came: Times) -> float:
    return (len(came) - 1) / ((came[-1][0] - came[0][0]) / 1e9)


def ratio(rows: Sequence[dict[str, Any]], pair: str, beside: str) -> str:
    """Return how long a pair's delay is beside another's in the same round, with its interval at 95 %."""
    logs = [math.log(one["delay_ms"][pair] / one["delay_ms"][beside]) for one in rows]
    found = statistics.means([logs])
    value, low, high = (math.exp(one[0]) for one in (found.value, found.low, found.high))
    return f"{value:.3f} [{low:.3f}, {high:.3f}]"


def main() -> int:
    """Print a line per pair."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="single values")
    parser.add_argument("--rounds", type=int, default=8, help="how often each pair is measured")
    options = parser.parse_args()
    found = measure(options.rounds)
    if options.json:
        print(json.dumps(found))
        return 0
    print(f"{'over':6}{'pair':10}{'delay, ms':>26}{'beside plain':>24}{'beside attached':>24}{'messages/s':>26}")
    for over, plain in PLAIN.items():
        rows = [one for one in found if one["over"] == over]
        for pair in (*plain, "agent"):
            delays = spread([one["delay_ms"][pair] for one in rows])
            ratios = [
                ratio(rows, pair, other) if other in plain and other != pair else "" for other in PLAIN["zenoh"]
            ]
            bursts = spread([one["per_s"][pair] for one in rows if one["per_s"]])
            print(f"{over:6}{pair:10}{delays:>26}" + "".join(f"{one:>24}" for one in ratios) + f"{bursts:>26}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
