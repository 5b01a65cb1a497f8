"""Time of an exchange with an external federate: `python -m benchmarks.cosim_exchange [--json]`.

An exchange with a physics is a request without commands and an answer with the states of all agents; an exchange with
a network is a request with these states and an answer without packets. The federate does nothing else. The time is
that of the coordinator's call, in wall time: the median of several rounds, in which the transports alternate. The
floor is a plain socket between two Python programs, which sends and receives as many bytes and does nothing with
them. `pipe to C` is `docs/examples/federates/carts.c` (physics only).

Both processes share the machine's processors, so other load changes the result.
"""

import argparse
import json
import math
import shlex
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final

from sim_backends.federates.agent_states import STATE
from sim_backends.federates.frames import HEADER_BYTES, NETWORK, PHYSICS
from sim_backends.federates.handshake import AgentStart, Hello
from sim_backends.federates.remote import open_network, open_physics
from sim_backends.federates.serving import serve
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.world.motion import State

COUNTS: Final = (3, 10, 50, 200)
ROUNDS: Final = 7
EXCHANGES: Final = 2000
STEP_NS: Final = 1_000_000
CARTS: Final = Path(__file__).parents[1] / "docs" / "examples" / "federates" / "carts.c"
_PHYSICS_REQUEST_BYTES: Final = HEADER_BYTES + 8 + 8 + 4
_PHYSICS_ANSWER_BYTES: Final = HEADER_BYTES + 8 + 4 + 4

Exchange = Callable[[int], object]
"""Makes an exchange; its argument is the simulated time in nanoseconds."""


class Still:
    """A physics whose robots do not move.

    Args:
        hello: The agents.
    """

    def __init__(self, hello: Hello) -> None:
        self.step_ns = STEP_NS
        self.limits_m_s2 = {agent.name: math.inf for agent in hello.agents}
        self._states = {agent.name: agent.start for agent in hello.agents}

    def advance(self, to_ns: int, commands: Mapping[str, object]) -> Mapping[str, State]:
        """Return the starts."""
        del to_ns, commands
        return self._states


class Silent:
    """A network without packets."""

    def __init__(self, hello: Hello) -> None:
        del hello

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Return nothing."""
        del to_ns, packets, states
        return [], []


def make_hello(role: int, count: int) -> Hello:
    """Return the beginning of a run with some agents."""
    agents = [AgentStart(f"r{number}", "husky", State((float(number), 0.0, 1.0))) for number in range(count)]
    return Hello(role, agents)


def echo(request_bytes: int, answer_bytes: int, port: int) -> None:
    """Answer requests over a plain socket, until it is closed."""
    answer = bytes(answer_bytes)
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while True:
            left = request_bytes
            while left:
                received = len(connection.recv(left))
                if not received:
                    return
                left -= received
            connection.sendall(answer)


@contextmanager
def floor(request_bytes: int, answer_bytes: int) -> Iterator[Exchange]:
    """Yield an exchange over a plain socket."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        sizes = (str(request_bytes), str(answer_bytes), str(server.getsockname()[1]))
        process = subprocess.Popen((sys.executable, "-m", "benchmarks.cosim_exchange", "--echo", *sizes))
        connection, _ = server.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    request = bytes(request_bytes)

    def exchange(_: int) -> None:
        connection.sendall(request)
        left = answer_bytes
        while left:
            left -= len(connection.recv(left))

    yield exchange
    connection.close()
    process.wait()


@contextmanager
def physics(where: str, count: int) -> Iterator[Exchange]:
    """Yield an exchange with an external physics."""
    with closing(open_physics(where, make_hello(PHYSICS, count), 60.0)) as remote:
        yield lambda to_ns: remote.advance(to_ns, {})


@contextmanager
def network(where: str, count: int) -> Iterator[Exchange]:
    """Yield an exchange with an external network."""
    states = {agent.name: agent.start for agent in make_hello(NETWORK, count).agents}
    with closing(open_network(where, make_hello(NETWORK, count), 60.0)) as remote:
        yield lambda to_ns: remote.advance(to_ns, (), states)


def served(role: str, address: str = "") -> str:
    """Return the command of a federate of this benchmark."""
    return shlex.join(
        word for word in (sys.executable, "-m", "benchmarks.cosim_exchange", "--serve", role, address) if word
    )


@contextmanager
def listening(role: str) -> Iterator[str]:
    """Yield the address of a federate that listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    process = subprocess.Popen(shlex.split(served(role, f"tcp-listen:127.0.0.1:{port}")))
    yield f"tcp:127.0.0.1:{port}"
    process.terminate()
    process.wait()


def measure(exchanges: Mapping[str, Exchange]) -> dict[str, float]:
    """Return the time of each exchange in microseconds."""
    times_us: dict[str, list[float]] = {name: [] for name in exchanges}
    to_ns = 0
    for _ in range(ROUNDS):
        for name, exchange in exchanges.items():
            started_s = time.perf_counter()
            for _ in range(EXCHANGES):
                to_ns += STEP_NS
                exchange(to_ns)
            times_us[name].append((time.perf_counter() - started_s) / EXCHANGES * 1e6)
    return {name: statistics.median(values) for name, values in times_us.items()}


def results(count: int, program: Path | None) -> dict[str, float]:
    """Return the times with a number of agents, by role and transport."""
    states_bytes = count * STATE.size
    inproc = Still(make_hello(PHYSICS, count))
    with (
        floor(_PHYSICS_REQUEST_BYTES, _PHYSICS_ANSWER_BYTES + states_bytes) as plain,
        physics(served("physics"), count) as pipe,
        network(served("network"), count) as network_pipe,
        listening("physics") as address,
        physics(address, count) as tcp,
        listening("network") as network_address,
        network(network_address, count) as network_tcp,
    ):
        exchanges: dict[str, Exchange] = {
            "physics inproc": lambda to_ns: inproc.advance(to_ns, {}),
            "plain socket": plain,
            "physics pipe": pipe,
            "physics tcp": tcp,
            "network pipe": network_pipe,
            "network tcp": network_tcp,
        }
        if program is None:
            return measure(exchanges)
        with physics(str(program), count) as pipe_to_c:
            return measure(exchanges | {"physics pipe to C": pipe_to_c})


def compiled(folder: Path) -> Path | None:
    """Return the federate in C, or None without a compiler."""
    if shutil.which("cc") is None:
        return None
    program = folder / "carts"
    subprocess.run(("cc", "-std=c99", "-O2", "-o", str(program), str(CARTS), "-lm"), check=True)
    return program


def main() -> None:
    """Print the times, or be the other side of an exchange."""
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
        serve(Still if role == "physics" else Silent, address=address[0] if address else None)
        return
    with tempfile.TemporaryDirectory() as folder:
        program = compiled(Path(folder))
        by_count = {count: results(count, program) for count in COUNTS}
    if arguments.json:
        print(json.dumps(by_count, indent=2))
        return
    print(f"{'microseconds per exchange':26}" + "".join(f"{count:>8}" for count in COUNTS) + "  agents")
    for name in next(iter(by_count.values())):
        print(f"{name:26}" + "".join(f"{times_us[name]:8.1f}" for times_us in by_count.values()))


if __name__ == "__main__":
    main()
