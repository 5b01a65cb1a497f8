"""The data exchange of the benchmark `cosim_exchange`, done by HELICS or mosaik for comparison.

The command is `python -m benchmarks.cosim_peers PEER AGENTS STEPS`.

In each step of one time unit, one federate publishes the states of all agents, and the other one a small message;
each receives the data of the other one. With HELICS both publish bytes. With mosaik the states are numbers, because
its interface is JSON. `PEER` is one of `PEERS`. The program prints the microseconds of wall time and of processor
time per step, without the start-up.
"""

import asyncio
import json
import os
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from sim_backends.federates.agent_states import STATE

MESSAGE: Final = bytes(36)
"""A message with the size of a request to a physics simulator."""
PEERS: Final = ("helics inproc", "helics zmq_ss", "mosaik inproc", "mosaik subprocess")
"""The peers. The core `ipc` of HELICS is omitted: its broker has one name for the whole machine, so two runs would
disturb each other."""
_STATE_NUMBERS: Final = STATE.size // 8
_LIMIT_S: Final = 300.0


def measure(peer: str, count: int, steps: int) -> tuple[float, float]:
    """Return the microseconds of wall time and of processor time per step, measured in a separate process.

    Raises:
        RuntimeError: The peer failed; the message has the end of its standard error.
    """
    command = (sys.executable, "-m", "benchmarks.cosim_peers", peer, str(count), str(steps))
    completed = subprocess.run(command, capture_output=True, text=True, timeout=_LIMIT_S, check=False)
    if completed.returncode != 0:
        raise RuntimeError(f"{peer}: {completed.stderr[-2000:]}")
    wall_us, cpu_us = json.loads(completed.stdout.splitlines()[-1])
    return float(wall_us), float(cpu_us)


class HelicsFederate:
    """A value federate with one publication and one subscription.

    Args:
        core: Type of its core.
        name: Its name, which is also the name of its publication.
        other: Name of the other federate.
        options: Options of its core.
    """

    def __init__(self, core: str, name: str, other: str, options: str) -> None:
        import helics  # noqa: PLC0415 (takes long, and few benchmarks need it)

        self._helics = helics
        info = helics.helicsCreateFederateInfo()
        helics.helicsFederateInfoSetCoreTypeFromString(info, core)
        helics.helicsFederateInfoSetCoreName(info, f"core_{name}")
        helics.helicsFederateInfoSetCoreInitString(info, f"--federates=1 {options}")
        helics.helicsFederateInfoSetTimeProperty(info, helics.HELICS_PROPERTY_TIME_PERIOD, 1.0)
        self._federate = helics.helicsCreateValueFederate(name, info)
        self._publication = helics.helicsFederateRegisterGlobalPublication(
            self._federate, name, helics.HELICS_DATA_TYPE_RAW, ""
        )
        self._input = helics.helicsFederateRegisterSubscription(self._federate, other, "")

    def run(self, data: bytes, expected: bytes, steps: int) -> tuple[float, float]:
        """Exchange data for some steps; return the seconds of wall time, and of processor time of this process.

        Raises:
            RuntimeError: In the last step the other federate's data did not arrive.
        """
        helics = self._helics
        helics.helicsFederateEnterExecutingMode(self._federate)
        publication, subscription, federate = self._publication, self._input, self._federate
        started_s, cpu_s = time.perf_counter(), time.process_time()
        for step in range(1, steps + 1):
            helics.helicsPublicationPublishBytes(publication, data)
            helics.helicsFederateRequestTime(federate, float(step))
            received = helics.helicsInputGetBytes(subscription)
        spent = time.perf_counter() - started_s, time.process_time() - cpu_s
        if received != expected:
            raise RuntimeError(f"{len(received)} bytes were received, not {len(expected)}")
        helics.helicsFederateDisconnect(self._federate)
        return spent


def run_helics(core: str, count: int, steps: int) -> tuple[float, float]:
    """Return the seconds of wall time and of processor time of a run with HELICS."""
    import helics  # noqa: PLC0415 (takes long, and few benchmarks need it)

    name = "benchmark"
    if core == "zmq_ss":
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = server.getsockname()[1]
        broker_options, options = f"--port={port}", f"--broker_address=tcp://127.0.0.1:{port}"
    else:
        broker_options, options = "", f"--broker={name}"
    broker = helics.helicsCreateBroker(core, name, f"-f 2 {broker_options}")
    states = bytes(count * STATE.size)
    if core == "inproc":
        with ThreadPoolExecutor(1) as pool:
            other = pool.submit(
                lambda: HelicsFederate(core, "states", "message", options).run(states, MESSAGE, steps)
            )
            wall_s, cpu_s = HelicsFederate(core, "message", "states", options).run(MESSAGE, states, steps)
            other.result()  # the processor time of this process includes that of the thread
    else:
        words = (sys.executable, "-m", "benchmarks.cosim_peers", f"other {core}", str(count), str(steps), options)
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        wall_s, cpu_s = HelicsFederate(core, "message", "states", options).run(MESSAGE, states, steps)
        cpu_s += float(process.communicate()[0].splitlines()[-1])
    helics.helicsBrokerWaitForDisconnect(broker, 2000)
    return wall_s, cpu_s


def run_other_helics(core: str, count: int, steps: int, options: str) -> float:
    """Run the federate that publishes the states; return the seconds of processor time."""
    federate = HelicsFederate(core, "states", "message", options)
    return federate.run(bytes(count * STATE.size), MESSAGE, steps)[1]


def mosaik_simulator(value: Any) -> Any:  # noqa: ANN401 (a class of mosaik, which has no types)
    """Return the class of a simulator that returns a value in each step."""
    import mosaik_api_v3  # noqa: PLC0415 (takes long, and few benchmarks need it)

    class Constant(mosaik_api_v3.Simulator):  # type: ignore[misc]
        last_step: tuple[int, Callable[[], None]] = -1, lambda: None  # a step, and a function that is called in it

        def __init__(self) -> None:
            models = {"Part": {"public": True, "params": [], "attrs": ["output", "input"]}}
            super().__init__({"api_version": "3.0", "type": "time-based", "models": models})

        def create(self, num: int, model: str) -> list[dict[str, str]]:
            return [{"eid": "part", "type": model}] * num

        def step(self, step: int, inputs: Mapping[str, Any], max_advance: int) -> int:
            del inputs, max_advance
            if step == self.last_step[0]:
                self.last_step[1]()
            return step + 1

        def get_data(self, outputs: Mapping[str, Sequence[str]]) -> dict[str, dict[str, Any]]:
            return {entity: dict.fromkeys(names, value) for entity, names in outputs.items()}

    return Constant


def run_mosaik(kind: str, count: int, steps: int) -> tuple[float, float]:
    """Return the seconds of wall time and of processor time of a run with mosaik."""
    import mosaik  # noqa: PLC0415 (takes long, and few benchmarks need it)

    # mosaik imports a simulator by the names of its module and its class.
    globals()["StatesSimulator"] = mosaik_simulator([[0.5] * _STATE_NUMBERS] * count)
    globals()["MessageSimulator"] = mosaik_simulator(MESSAGE.decode())
    served = f"{shlex.quote(sys.executable)} -m benchmarks.cosim_peers states {count} %(addr)s"
    states = {"cmd": served, "posix": True} if kind == "subprocess" else {"python": f"{__name__}:StatesSimulator"}
    world = mosaik.World(
        {"States": states, "Message": {"python": f"{__name__}:MessageSimulator"}},
        skip_greetings=True,
        configure_logging=False,
    )
    parts = {name: world.start(name).Part() for name in ("States", "Message")}
    world.connect(parts["States"], parts["Message"], ("output", "input"))
    world.connect(
        parts["Message"], parts["States"], ("output", "input"), time_shifted=True, initial_data={"output": ""}
    )
    pids = sorted(child_pids())
    started_s, cpu_s = time.perf_counter(), processor_s(pids)
    # At the end of the run mosaik stops the other process, so its processor time is read before the last step.
    spent: list[tuple[float, float]] = []
    sys.modules[__name__].MessageSimulator.last_step = (
        steps - 1,
        lambda: spent.append((time.perf_counter() - started_s, processor_s(pids) - cpu_s)),
    )
    world.run(until=steps, print_progress=False)
    return spent[0]


def child_pids() -> set[int]:
    """Return the process ids of this process's children."""
    pids = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(path.read_text(encoding="utf-8").rpartition(")")[2].split()[1]) == os.getpid():
                pids.add(int(path.parent.name))
    return pids


def processor_s(pids: Sequence[int]) -> float:
    """Return the processor time of this process and of others, in seconds."""
    times_ns = [
        int(path.read_text(encoding="ascii").split()[0])
        for pid in pids
        for path in Path(f"/proc/{pid}/task").glob("*/schedstat")
    ]
    return time.process_time() + sum(times_ns) / 1e9


def main() -> None:
    """Measure one peer, or run the other side of an exchange."""
    if sys.argv[1] == "states":
        import mosaik_api_v3  # noqa: PLC0415 (takes long, and few benchmarks need it)

        host, _, port = sys.argv[3].rpartition(":")
        simulator = mosaik_simulator([[0.5] * _STATE_NUMBERS] * int(sys.argv[2]))
        asyncio.run(mosaik_api_v3.run_as_client(simulator(), host, int(port)))
        return
    peer, kind = sys.argv[1].split()
    count, steps = map(int, sys.argv[2:4])
    if peer == "other":
        print(run_other_helics(kind, count, steps, sys.argv[4]))
        return
    spent = (run_helics if peer == "helics" else run_mosaik)(kind, count, steps)
    print(json.dumps([seconds / steps * 1e6 for seconds in spent]))


if __name__ == "__main__":
    main()
