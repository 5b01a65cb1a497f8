"""Time of an exchange with an external federate: `python -m benchmarks.cosim_exchange [--json]`.

A federate is a simulator that the coordinator of the co-simulation advances; an external one is another process. An
exchange with a physics simulator is a request without commands and an answer with the states of all agents; an
exchange with a network simulator is a request with these states and an answer without packets. The federate does
nothing else. The duration of the coordinator's call is measured; the rounds of all transports alternate. The lower
bound is a plain socket between two Python programs, over which the same number of bytes is sent and received without
further processing. Rows with `to C` use the federate `docs/examples/federates/carts.c`. The peers, HELICS and mosaik,
exchange the same amount of data in each step (`cosim_peers`).

Both processes share the machine's processors, so other load changes the wall time: its minimum over the rounds is the
time on an idle machine, if one round was not disturbed. The processor time is that of both processes.
"""

import argparse
import json
import math
import os
import shlex
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Final

from benchmarks import cosim_peers
from benchmarks.cosim_peers import PEERS, child_pids, processor_s
from sim_backends.federates.agent_states import STATE
from sim_backends.federates.frames import HEADER_BYTES, NETWORK, PHYSICS
from sim_backends.federates.handshake import AgentStart, Hello
from sim_backends.federates.remote import open_network, open_physics
from sim_backends.federates.serving import serve
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.world.motion import State

COUNTS: Final = (3, 10, 50, 200)
"""Numbers of agents."""
ROUNDS: Final = 15
EXCHANGES: Final = 300
"""Exchanges per round."""
PEER_ROUNDS: Final = 3  # of HELICS and mosaik
STEPS: Final = 1000
"""Steps per round of a peer."""
STEP_NS: Final = 1_000_000
CARTS: Final = Path(__file__).parents[1] / "docs" / "examples" / "federates" / "carts.c"
_PHYSICS_REQUEST_BYTES: Final = HEADER_BYTES + 8 + 8 + 4
_PHYSICS_ANSWER_BYTES: Final = HEADER_BYTES + 8 + 4 + 4
"""Lengths of a request without commands, and of an answer without states."""

Exchange = Callable[[int], object]
"""Makes an exchange; its argument is the simulated time in nanoseconds."""


class StationaryPhysics:
    """A physics simulator whose robots do not move.

    Args:
        hello: First message of the run, which contains the agents.
    """

    def __init__(self, hello: Hello) -> None:
        self.step_ns = STEP_NS
        self.limits_m_s2 = {agent.name: math.inf for agent in hello.agents}
        self._states = {agent.name: agent.start for agent in hello.agents}

    def advance(self, to_ns: int, commands: Mapping[str, object]) -> Mapping[str, State]:
        """Return the start states."""
        del to_ns, commands
        return self._states


class IdleNetwork:
    """A network simulator without packets."""

    def __init__(self, hello: Hello) -> None:
        del hello

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Return nothing."""
        del to_ns, packets, states
        return [], []


def make_hello(role: int, count: int) -> Hello:
    """Return the hello of a run with `count` agents."""
    agents = [AgentStart(f"r{number}", "husky", State((float(number), 0.0, 1.0))) for number in range(count)]
    return Hello(role, agents)


def echo(request_bytes: int, answer_bytes: int, port: int) -> None:
    """Answer requests over a plain socket, until it is closed."""
    answer = bytes(answer_bytes)
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while True:
            remaining = request_bytes
            while remaining:
                received = len(connection.recv(remaining))
                if not received:
                    return
                remaining -= received
            connection.sendall(answer)


@dataclass(frozen=True)
class ExchangePeer:
    """An exchange, and the process of its other side.

    Attributes:
        exchange: Makes an exchange.
        pids: Processes of the other side, whose processor time is measured too; empty if there are none.
    """

    exchange: Exchange
    pids: Sequence[int] = ()


@contextmanager
def plain_socket(request_bytes: int, answer_bytes: int) -> Iterator[ExchangePeer]:
    """Yield an exchange over a plain socket."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        sizes = (str(request_bytes), str(answer_bytes), str(server.getsockname()[1]))
        process = subprocess.Popen((sys.executable, "-m", "benchmarks.cosim_exchange", "--echo", *sizes))
        connection, _ = server.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    request = bytes(request_bytes)

    def exchange(_: int) -> None:
        connection.sendall(request)
        remaining = answer_bytes
        while remaining:
            remaining -= len(connection.recv(remaining))

    try:
        yield ExchangePeer(exchange, [process.pid])
    finally:
        connection.close()
        process.wait()


@contextmanager
def open_federate(role: str, address: str, count: int, pids: Sequence[int] = ()) -> Iterator[ExchangePeer]:
    """Yield an exchange with an external federate.

    Args:
        role: `physics` or `network`.
        address: Address or command of the federate.
        count: Number of agents.
        pids: Process of the federate if it is already running; otherwise the processes that opening it starts.
    """
    before = child_pids()
    if role == "physics":
        with closing(open_physics(address, make_hello(PHYSICS, count), 60.0)) as physics:
            yield ExchangePeer(lambda to_ns: physics.advance(to_ns, {}), pids or sorted(child_pids() - before))
        return
    states = {agent.name: agent.start for agent in make_hello(NETWORK, count).agents}
    with closing(open_network(address, make_hello(NETWORK, count), 60.0)) as network:
        yield ExchangePeer(lambda to_ns: network.advance(to_ns, (), states), pids or sorted(child_pids() - before))


def serve_command(role: str, address: str = "") -> str:
    """Return the command of a federate of this benchmark."""
    return shlex.join(
        word for word in (sys.executable, "-m", "benchmarks.cosim_exchange", "--serve", role, address) if word
    )


@contextmanager
def listening_federate(role: str, scheme: str, count: int) -> Iterator[ExchangePeer]:
    """Yield an exchange with a federate that listens."""
    listen_address = address = f"{scheme}:benchmark_{os.getpid()}"
    if scheme in {"tcp", "udp"}:
        port = free_port()
        listen_address, address = f"{scheme}-listen:127.0.0.1:{port}", f"{scheme}:127.0.0.1:{port}"
    process = subprocess.Popen(shlex.split(serve_command(role, listen_address)))
    try:
        with open_federate(role, address, count, [process.pid]) as peer:
            yield peer
    finally:
        process.terminate()
        process.wait()


@contextmanager
def program_over_tcp(program: Path, count: int) -> Iterator[ExchangePeer]:
    """Yield an exchange over TCP with a program that has the connection as its standard input and output."""
    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as pool:

        def start() -> "subprocess.Popen[bytes]":
            connection, _ = server.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with connection:
                return subprocess.Popen((program,), stdin=connection.fileno(), stdout=connection.fileno())

        started = pool.submit(start)
        with open_federate("physics", f"tcp:127.0.0.1:{server.getsockname()[1]}", count) as peer:
            yield ExchangePeer(peer.exchange, [started.result().pid])
        started.result().wait()


def free_port() -> int:
    """Return a port that no program uses."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@contextmanager
def ros_master() -> Iterator[bool]:
    """Run a ROS master; yield False if it is not installed."""
    if shutil.which("rosmaster") is None:
        yield False
        return
    port = free_port()
    os.environ |= {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    process = subprocess.Popen(
        ("rosmaster", "--core", "-p", str(port)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield True
    finally:
        process.terminate()
        process.wait()


@dataclass(frozen=True)
class Times:
    """Times of an exchange in microseconds.

    Attributes:
        wall: Median of the wall times of the rounds.
        wall_min: Minimum of the wall times.
        cpu: Median of the processor times of both processes.
    """

    wall: float
    wall_min: float
    cpu: float

    @staticmethod
    def of(rounds: Sequence[tuple[float, float]]) -> "Times":
        """Return the times of rounds, each with wall time and processor time."""
        walls, cpus = zip(*rounds, strict=True)
        return Times(statistics.median(walls), min(walls), statistics.median(cpus))


def measure(peers: Mapping[str, ExchangePeer]) -> dict[str, Times]:
    """Return the times of each exchange."""
    rounds: dict[str, list[tuple[float, float]]] = {name: [] for name in peers}
    to_ns = 0
    for _ in range(ROUNDS):
        for name, peer in peers.items():
            cpu_s, started_s = processor_s(peer.pids), time.perf_counter()
            for _ in range(EXCHANGES):
                to_ns += STEP_NS
                peer.exchange(to_ns)
            wall_s = time.perf_counter() - started_s
            spent_s = wall_s, processor_s(peer.pids) - cpu_s
            rounds[name].append((spent_s[0] / EXCHANGES * 1e6, spent_s[1] / EXCHANGES * 1e6))
    return {name: Times.of(values) for name, values in rounds.items()}


def results(count: int, program: Path | None, *, has_ros: bool) -> dict[str, Times]:
    """Return the times for `count` agents, by role and transport, and the times of the peers."""
    inproc = StationaryPhysics(make_hello(PHYSICS, count))
    with ExitStack() as stack:
        peers = {"physics inproc": ExchangePeer(lambda to_ns: inproc.advance(to_ns, {}))}
        answer_bytes = _PHYSICS_ANSWER_BYTES + count * STATE.size
        peers["plain socket"] = stack.enter_context(plain_socket(_PHYSICS_REQUEST_BYTES, answer_bytes))
        if program is not None:
            peers["physics pipe to C"] = stack.enter_context(open_federate("physics", str(program), count))
            peers["physics tcp to C"] = stack.enter_context(program_over_tcp(program, count))
        peers["physics pipe"] = stack.enter_context(open_federate("physics", serve_command("physics"), count))
        for scheme in ("tcp", "udp", "dds", *(("ros1",) if has_ros else ())):
            peers[f"physics {scheme}"] = stack.enter_context(listening_federate("physics", scheme, count))
        peers["network pipe"] = stack.enter_context(open_federate("network", serve_command("network"), count))
        peers["network tcp"] = stack.enter_context(listening_federate("network", "tcp", count))
        times = measure(peers)
    rounds = {peer: [cosim_peers.measure(peer, count, STEPS) for _ in range(PEER_ROUNDS)] for peer in PEERS}
    return times | {peer: Times.of(values) for peer, values in rounds.items()}


def compile_carts(folder: Path) -> Path | None:
    """Return the compiled federate in C, or None without a compiler."""
    if shutil.which("cc") is None:
        return None
    program = folder / "carts"
    subprocess.run(("cc", "-std=c99", "-O2", "-o", str(program), str(CARTS), "-lm"), check=True)
    return program


def main() -> None:
    """Print the times, or run the other side of an exchange."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--serve", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--echo", nargs=3, type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.echo:
        echo(*arguments.echo)
        return
    if arguments.serve:
        role, *address = arguments.serve
        serve(StationaryPhysics if role == "physics" else IdleNetwork, address=address[0] if address else None)
        return
    with tempfile.TemporaryDirectory() as folder, ros_master() as has_ros:
        program = compile_carts(Path(folder))
        by_count = {count: results(count, program, has_ros=has_ros) for count in COUNTS}
    if arguments.json:
        by_name = {
            count: {name: asdict(times) for name, times in by_peer.items()} for count, by_peer in by_count.items()
        }
        print(json.dumps(by_name, indent=2))
        return
    for field in fields(Times):
        print(f"{field.name + ' (us)':26}" + "".join(f"{count:>9}" for count in COUNTS) + "  agents")
        for name in next(iter(by_count.values())):
            row = (getattr(times_by_name[name], field.name) for times_by_name in by_count.values())
            print(f"{name:26}" + "".join(f"{value_us:9.1f}" for value_us in row))


if __name__ == "__main__":
    main()
