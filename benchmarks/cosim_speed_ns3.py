"""Cost of the coupling with ns-3: `python -m benchmarks.cosim_speed_ns3 [--json]`.

Driving robots, 10 m apart, send packets of 1,000 bytes to the next robot by UDP in 802.11g, under `sliding_window`
with windows of 10 ms. *Alone* is the same program of ns-3 with the same packets and positions, read from a file and
simulated in one `Run()`. *Minimal* passes the same requests through a pipe, one per window, and ignores the answers;
unlike the co-simulation, it does not keep both processes on one processor (`ProcessorSharing`). *Coupled* is the
co-simulation: processor time of both processes, without the time of physics simulator and programs. The built-in
physics simulator usually computes states when they are read; in this benchmark it computes them in its method
`advance`, so that their time is excluded too. All three write the parts of every delay to a file. *Built-in* is the
co-simulation with the built-in network. Figures are medians of several rounds; in each round the variants alternate.
An error is raised if the delays differ.

`taskset -c 0 python -m benchmarks.cosim_speed_ns3` shows the costs on one processor.
"""

import argparse
import hashlib
import json
import os
import resource
import shlex
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar
from unittest.mock import patch

from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.federates.frames import HEADER_BYTES, NETWORK, MessageKind, ProtocolFrame, encode, read_header
from sim_backends.federates.remote import RemoteNetwork
from sim_backends.ns3.federate import command
from sim_backends.world.motion import State
from sim_backends.world.world import load_world

COUNTS: Final = (3, 10, 30)
"""Numbers of robots."""
SPACING_M: Final = 10.0
WINDOW: Final = "10ms"
LONGEST_S: Final = 600.0
"""Time limit of ns-3 alone."""
PARTS: Final = "parts.csv"
"""File with the parts of the delays."""

Figures = dict[str, float]
Spent = TypeVar("Spent")


def scenario_of(count: int, seconds: float, rate_hz: float, folder: Path) -> CosimScenario:
    """Return the scenario of a number of robots whose network is ns-3.

    Args:
        count: Number of robots.
        seconds: Simulated time.
        rate_hz: Packets per second of all robots together, so that the load is the same for all numbers.
        folder: Folder for its file.
    """
    names, side = [f"r{number}" for number in range(count)], round(count**0.5)
    agents = {
        name: {
            "robot": "husky",
            "at_m": [SPACING_M * (number % side), SPACING_M * (number // side)],
            "radio": {"standard": "802.11g"},
            "motion": {"kind": "velocity-profile", "legs": [{"duration": f"{seconds}s", "speed": "0.5m/s"}]},
        }
        for number, name in enumerate(names)
    }
    traffic = [
        {"kind": "stream", "from": name, "to": other, "rate": f"{rate_hz / count:.6g}Hz", "size_bytes": 1000}
        for name, other in zip(names, [*names[1:], names[0]], strict=True)
    ]
    scenario: dict[str, Any] = {
        "name": "fleet",
        "summary": "driving robots",
        "world": "open",
        "duration": f"{seconds}s",
        "radio": {"mode": "g24"},
        "policy": {"name": "sliding_window", "window": WINDOW},
        "network": {"federate": "ns3", "options": {"delay_parts": str(folder / PARTS)}},
        "agents": agents,
        "traffic": traffic,
    }
    path = folder / "fleet.yaml"
    path.write_text(json.dumps(scenario), encoding="utf-8")
    return load_scenario(path)


def used_s(usage_of: int) -> float:
    """Return the processor time of this process, or of its ended children, in seconds."""
    usage = resource.getrusage(usage_of)
    return usage.ru_utime + usage.ru_stime


def run_coupled(scenario: CosimScenario, requests: Path | None = None) -> Figures:
    """Return the figures of the co-simulation, and write the requests to its network to a file if one is given."""
    with build(scenario) as simulation:
        if requests is not None:
            world = load_world(scenario.world)
            hello = make_hello(scenario, world, make_bodies(scenario, world), simulation.seed, NETWORK)
            requests.write_bytes(encode(MessageKind.HELLO, 1, 0, hello.encode()))
            assert isinstance(simulation.network, RemoteNetwork)
            simulation.network.session.observer = _recorder(requests)
        # `build` has compiled ns-3's program or read its version, in other processes.
        children_s, started_s = used_s(resource.RUSAGE_CHILDREN), time.process_time()
        physics, advance = simulation.agents.physics, simulation.agents.physics.advance

        def advance_now(to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
            return dict(advance(to_ns, commands))

        # The parts of a run are usually measured in wall time; here processor time is needed.
        with patch.object(time, "perf_counter", time.process_time), patch.object(physics, "advance", advance_now):
            run = simulation.run()
        own_s = time.process_time() - started_s - run.wall_s["agents"]
    child_s = used_s(resource.RUSAGE_CHILDREN) - children_s
    return {
        "spent_s": own_s + child_s,
        "child_s": child_s,
        "arrivals": sum(fate.arrived_ns is not None for fate in run.fates.values()),
        "windows": len(run.windows_ns),
    }


def _recorder(path: Path) -> Callable[[bytes, ProtocolFrame | None], None]:
    def record(request: bytes, answer: ProtocolFrame | None) -> None:
        if answer is None:
            with path.open("ab") as file:
                file.write(request)

    return record


def run_alone(requests: Path) -> float:
    """Return the processor time of ns-3 without a coordinator, in seconds."""
    words = [*command().split(), "alone", str(requests)]
    before_s = used_s(resource.RUSAGE_CHILDREN)  # after `command`, which starts compiler and pkg-config
    subprocess.run(words, check=True, timeout=LONGEST_S, capture_output=True)
    return used_s(resource.RUSAGE_CHILDREN) - before_s


def run_minimal(requests: Path) -> float:
    """Return the processor time of both processes in seconds, if the answer to each request is read and ignored."""
    frames, data = [], requests.read_bytes()
    while data:
        end = HEADER_BYTES + read_header(data).size
        frames.append(data[:end])
        data = data[end:]
    words, before_s = shlex.split(command()), used_s(resource.RUSAGE_CHILDREN)
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        started_s = time.process_time()
        for frame in frames:
            process.stdin.write(frame)
            process.stdin.flush()
            kind = MessageKind.BUSY
            while kind is MessageKind.BUSY:
                size, kind, *_ = read_header(process.stdout.read(HEADER_BYTES))
                process.stdout.read(size)
        own_s = time.process_time() - started_s
    return own_s + used_s(resource.RUSAGE_CHILDREN) - before_s


def measure(scenario: CosimScenario, requests: Path) -> Figures:
    """Return the figures of a round.

    Raises:
        RuntimeError: The delays differ.
    """
    parts = requests.with_name(PARTS)
    hashes = set()

    def checked(spent: Spent) -> Spent:
        hashes.add(hashlib.sha256(parts.read_bytes()).digest())
        return spent

    before_s = checked(run_alone(requests))
    minimal_s, coupled = checked(run_minimal(requests)), checked(run_coupled(scenario))
    alone_s = (before_s + checked(run_alone(requests))) / 2
    if len(hashes) > 1:
        raise RuntimeError("ns-3 alone, with minimal exchanges and coupled, has different delays")
    packets = coupled["arrivals"]
    network = scenario.network.model_copy(update={"federate": None, "options": None})
    builtin = run_coupled(scenario.model_copy(update={"network": network}))
    return {
        "alone_s": alone_s,
        "minimal_s": minimal_s,
        "coupled_s": coupled["spent_s"],
        "coupled_ns3_s": coupled["child_s"],
        "minimal_adds_percent": 100 * (minimal_s / alone_s - 1),
        "coupling_adds_percent": 100 * (coupled["spent_s"] / alone_s - 1),
        "coordinator_us_per_packet": (coupled["spent_s"] - minimal_s) / packets * 1e6,
        "builtin_s": builtin["spent_s"],
        "packets": packets,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0, help="simulated time per round")
    parser.add_argument("--rate", type=float, default=600.0, help="packets per second of all robots")
    parser.add_argument("--robots", type=int, nargs="*", default=COUNTS)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    command()  # compile the program before measuring
    load_before, results = os.getloadavg()[0], {}
    for count in options.robots:
        with tempfile.TemporaryDirectory() as name:
            scenario, requests = (
                scenario_of(count, options.seconds, options.rate, Path(name)),
                Path(name) / "requests",
            )
            run_coupled(scenario, requests)
            rounds = [measure(scenario, requests) for _ in range(options.rounds)]
        results[f"{count} robots"] = {key: statistics.median(row[key] for row in rounds) for key in rounds[0]}
    if options.json:
        print(json.dumps({"load_before": load_before, "figures": results}, indent=2))
        return
    print(f"{options.rounds} rounds, medians; load before: {load_before:.2f}, after: {os.getloadavg()[0]:.2f}")
    for name, values in results.items():
        print(f"{name:12}" + "  ".join(f"{key} {value:.4g}" for key, value in values.items()))


if __name__ == "__main__":
    main()
