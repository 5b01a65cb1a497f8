"""What the step `topics` adds to a message: `python -m benchmarks.topics [--json] [--rounds N]`; it needs rosmaster.

The agent that the step starts on robots (`agent publish`, `agent subscribe`) beside plain pairs of CycloneDDS, Zenoh
and rospy, all on loopback. In each round all pairs send at the same time, 1,000 bytes at 50 Hz, so that whatever else
the machine does meets all alike, and medians are taken over the time in which all sent; then each sends for a second
as fast as it goes, one after the other. A delay runs from before a sample is made until a subscriber's Python has it.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Final

from benchmarks.bridge import HOST, SIZE, TYPE, Running, Way, free_port, spread
from fieldkit.measure.transfers import topic_log
from fieldkit.ros import topics
from fieldkit.ros.qos import PROFILES
from fieldkit.ros.types import shipped

PAIRS: Final = ("dds", "zenoh", "ros1")
RATE_HZ: Final = 50.0
LASTS_S: Final = 6.0
BURST_S: Final = 1.0
FASTEST_HZ: Final = 100_000.0
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
            return shared | {"discovery": "master", "server": HOST, "port": self._master_port}
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


def at_once(plain: Sequence[Running], harnesses: Sequence[AgentPair]) -> tuple[list[Times], list[Times]]:
    """Let all pairs send at the same time; return what arrived over each while all sent."""
    came: list[Times] = [()] * len(plain)

    def run(number: int) -> None:
        came[number] = plain[number].run(LASTS_S, RATE_HZ)[1]

    with ExitStack() as stack:
        for one in harnesses:
            stack.enter_context(one.stream(LASTS_S, RATE_HZ))
        threads = [threading.Thread(target=run, args=(number,)) for number in range(len(plain))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    streams = [*came, *(one.arrived() for one in harnesses)]
    begun_ns = max(times[0][0] for times in streams)
    ended_ns = min(times[-1][0] for times in streams)
    inside: list[Times] = [[one for one in times if begun_ns <= one[0] <= ended_ns] for times in streams]
    return inside[: len(plain)], inside[len(plain) :]


def measure(rounds: int) -> list[dict[str, Any]]:
    """Return what was measured in each round of each pair."""
    found: list[dict[str, Any]] = []
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
        plain = [Running(stack, Way(f"{one} plain", f"{one} plain", f"{one} plain"), environment) for one in PAIRS]
        harnesses = [AgentPair(one, port, folder) for one in PAIRS]
        for number in range(rounds):
            theirs, ours = at_once(plain, harnesses)
            for over, yardstick, harness, peer, own in zip(PAIRS, plain, harnesses, theirs, ours, strict=True):
                burst = yardstick.run(BURST_S, 0)[1]
                with harness.stream(BURST_S, FASTEST_HZ):
                    pass
                found.append(
                    {
                        "round": number,
                        "over": over,
                        "plain_ms": median(delay_ns for _, delay_ns in peer) / 1e6,
                        "harness_ms": median(delay_ns for _, delay_ns in own) / 1e6,
                        "plain_per_s": _per_s(burst),
                        "harness_per_s": _per_s(harness.arrived()),
                    }
                )
    return found


def _per_s(came: Times) -> float:
    return (len(came) - 1) / ((came[-1][0] - came[0][0]) / 1e9)


def main() -> int:
    """Print a line per middleware."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="single values")
    parser.add_argument("--rounds", type=int, default=7, help="how often each pair is measured")
    options = parser.parse_args()
    found = measure(options.rounds)
    if options.json:
        print(json.dumps(found))
        return 0
    names = ("plain, ms", "agent, ms", "agent / plain", "plain, messages/s", "agent, messages/s")
    print(f"{'over':6}" + "".join(f"{name:>26}" for name in names))
    for over in PAIRS:
        rows = [one for one in found if one["over"] == over]
        columns = (
            [one["plain_ms"] for one in rows],
            [one["harness_ms"] for one in rows],
            [one["harness_ms"] / one["plain_ms"] for one in rows],
            [one["plain_per_s"] for one in rows],
            [one["harness_per_s"] for one in rows],
        )
        print(f"{over:6}" + "".join(f"{spread(values):>26}" for values in columns))
    return 0


if __name__ == "__main__":
    sys.exit(main())
