"""Delay that the step `topics` adds to messages: `python -m benchmarks.topics [--json] [--rounds N]`, with rosmaster.

The agent that the step starts on robots (`agent publish`, `agent subscribe`) is compared with plain pairs of
CycloneDDS, Zenoh and rospy on loopback, one middleware after the other. Each round restarts all programs, because the
delays depend more on the processor cores on which the programs run than on the number of messages. The pairs of a
middleware then send 1,000 bytes at nearly 200 Hz, at the same time. Their rates differ slightly, so that the phases
between the pairs vary within seconds. The rates are exchanged between rounds. Medians are over the time in which all
pairs send; a ratio is the geometric mean over rounds. In every third round each pair then sends for a second at full
rate, in sequence.

A delay is the time from the creation of a sample until the subscriber's Python code has received it.
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

from benchmarks.bridge import HOST, SIZE, TYPE, MessagePath, RunningPath, free_port, spread
from fieldkit.analysis import statistics
from fieldkit.core.threads import run_parallel
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from fieldkit.ros.streams import topic_samples

PLAIN: Final = {"dds": ("plain",), "zenoh": ("plain", "attached"), "ros1": ("plain",)}
"""Pairs of each middleware that are compared with the agent's. `attached` adds the attachment of rmw_zenoh."""
RATES_HZ: Final = (200.0, 197.0, 203.0)
STREAM_S: Final = 4.0
BURST_S: Final = 1.0
BURST_EVERY: Final = 3
FASTEST_HZ: Final = 1e9
"""At this rate no sample waits for its send time."""
_DOMAIN: Final = 62

Times = Sequence[tuple[int, int]]
"""Arrival time and delay of each message, in nanoseconds."""


class AgentPair:
    """Publisher and subscriber of a step `topics`, for streams in sequence.

    Args:
        over: The middleware.
        master_port: Port of the ROS master.
        folder: Folder for logs.
    """

    def __init__(self, over: str, master_port: int, folder: Path) -> None:
        self._over, self._master_port, self._folder = over, master_port, folder

    @contextmanager
    def stream(self, duration_s: float, rate_hz: float) -> Iterator["subprocess.Popen[str]"]:
        """Stream while the body runs, until the stream ends; yield the running publisher."""
        port = free_port()
        with self._running_agent("subscribe", port, duration_s, rate_hz) as subscriber:
            with self._running_agent("publish", port, duration_s, rate_hz) as publisher:
                yield publisher
                if publisher.wait() != 0:
                    raise RuntimeError(f"the publisher over {self._over} exited with {publisher.returncode}")
            subscriber.terminate()

    def arrived(self) -> Times:
        """Return the arrivals of the last stream."""
        samples = topic_samples.read_log(self._log("subscribe")).samples
        return list(zip(samples.at_ns.tolist(), (samples.at_ns - samples.sent_ns).tolist(), strict=True))

    @contextmanager
    def _running_agent(
        self, verb: str, port: int, duration_s: float, rate_hz: float
    ) -> Iterator["subprocess.Popen[str]"]:
        request = json.dumps({"network": self._network(verb, port), "topic": self._topic(verb), "stream": {
            "over": self._over, "size_bytes": SIZE, "rate_hz": rate_hz, "duration_s": duration_s, "patience_s": 20.0,
        }})  # fmt: skip
        command = (sys.executable, "-m", "fieldkit.agent", verb, request, str(self._log(verb)))
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            if not (first_line := process.stderr.readline()).startswith("up,"):
                raise RuntimeError(first_line + process.stderr.read())
            yield process

    def _network(self, verb: str, port: int) -> dict[str, Any]:
        shared: dict[str, Any] = {"address": HOST, "domain": _DOMAIN, "node": f"harness_{verb}"}
        if self._over == "ros1":
            settings = {"tcp_nodelay": "1"}  # as in the plain pair
            return shared | {"discovery": "master", "server": HOST, "port": self._master_port, "settings": settings}
        settings = {}
        if self._over == "zenoh":
            # The subscriber listens and the publisher connects, as in the plain pair.
            locators = json.dumps([f"tcp/{HOST}:{port}"])
            is_subscriber = verb == "subscribe"
            settings = {
                "listen/endpoints": locators if is_subscriber else "[]",
                "connect/endpoints": "[]" if is_subscriber else locators,
            }
        return shared | {"discovery": "peers", "peers": [HOST], "settings": settings}

    def _topic(self, verb: str) -> dict[str, Any]:
        return topics.describe(
            standard_types(), "/harness", TYPE, PROFILES["default"], domain=_DOMAIN, node=f"harness_{verb}"
        )

    def _log(self, verb: str) -> Path:
        return self._folder / f"{self._over}-{verb}.bin"


def stream_together(plain: Sequence[RunningPath], agent_pair: AgentPair, rates_hz: Sequence[float]) -> list[Times]:
    """Send over all pairs of a middleware at the same time; return the arrivals of each while all pairs sent.

    Args:
        plain: The plain pairs.
        agent_pair: The agent's pair.
        rates_hz: Rates of the pairs, the agent's last.
    """
    with agent_pair.stream(STREAM_S, rates_hz[-1]):
        plain_arrivals = run_parallel(
            lambda pair: pair[0].run(STREAM_S, pair[1])[1], list(zip(plain, rates_hz, strict=False))
        )
    streams = [*plain_arrivals, agent_pair.arrived()]
    first_ns = max(times[0][0] for times in streams)
    last_ns = min(times[-1][0] for times in streams)
    return [[arrival for arrival in times if first_ns <= arrival[0] <= last_ns] for times in streams]


def measure_round(over: str, number: int, agent_pair: AgentPair, environment: dict[str, str]) -> dict[str, Any]:
    """Return the results of a middleware in a round, by pair: median delay, and rate of a burst if it had one."""
    pairs = (*PLAIN[over], "agent")
    rates_hz = [RATES_HZ[(place + number) % len(pairs)] for place in range(len(pairs))]
    with ExitStack() as stack:
        names = [f"{over} {pair}" for pair in PLAIN[over]]
        plain = [RunningPath(stack, MessagePath(name, name, name), environment) for name in names]
        arrivals = stream_together(plain, agent_pair, rates_hz)
        bursts: list[Times] = []
        if number % BURST_EVERY == 0:
            bursts = [pair.run(BURST_S, 0)[1] for pair in plain]
            with agent_pair.stream(BURST_S, FASTEST_HZ):
                pass
            bursts.append(agent_pair.arrived())
    return {
        "round": number,
        "over": over,
        "delay_ms": dict(zip(pairs, (median(delay for _, delay in times) / 1e6 for times in arrivals), strict=True)),
        "per_s": dict(zip(pairs, map(_per_s, bursts), strict=False)),
    }


def measure(rounds: int) -> list[dict[str, Any]]:
    """Return the results of each middleware in each round."""
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
        return [
            measure_round(over, number, pair, environment)
            for number in range(rounds)
            for over, pair in agents.items()
        ]


def _per_s(arrivals: Times) -> float:
    return (len(arrivals) - 1) / ((arrivals[-1][0] - arrivals[0][0]) / 1e9)


def ratio(rows: Sequence[dict[str, Any]], pair: str, reference: str) -> str:
    """Return the ratio of a pair's delay to that of another pair in the same round, with its 95 % interval."""
    logs = [math.log(row["delay_ms"][pair] / row["delay_ms"][reference]) for row in rows]
    mean = statistics.means([logs])
    value, low, high = (math.exp(column[0]) for column in (mean.value, mean.low, mean.high))
    return f"{value:.3f} [{low:.3f}, {high:.3f}]"


def main() -> int:
    """Measure; print a line per pair, or the results as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    parser.add_argument("--rounds", type=int, default=8, help="measurements of each pair")
    options = parser.parse_args()
    results = measure(options.rounds)
    if options.json:
        print(json.dumps(results))
        return 0
    header = f"{'over':6}{'pair':10}{'delay, ms':>26}{'ratio to plain':>24}{'ratio to attached':>24}"
    print(f"{header}{'messages/s':>26}")
    for over, plain in PLAIN.items():
        rows = [row for row in results if row["over"] == over]
        for pair in (*plain, "agent"):
            delays = spread([row["delay_ms"][pair] for row in rows])
            ratios = [
                ratio(rows, pair, other) if other in plain and other != pair else "" for other in PLAIN["zenoh"]
            ]
            bursts = spread([row["per_s"][pair] for row in rows if row["per_s"]])
            print(f"{over:6}{pair:10}{delays:>26}" + "".join(f"{text:>24}" for text in ratios) + f"{bursts:>26}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
