"""Scenarios with external federates: their results equal those of built-in ones, and no process remains."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.cosim.scenario.external import without_federates
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.federates.protocols import FederateError
from tests.helpers.federate_examples import EXAMPLES
from tests.helpers.federate_pairs import children, now_s
from tests.helpers.runs import cosim, finish, start, wait_during
from tests.helpers.sshd import free_port

SERVE_COMMAND = shlex.join((sys.executable, "-m", "sim_backends.cosim.scenario.served"))
DURATION = {"duration": "400ms"}


@pytest.fixture(scope="module")
def served_addresses() -> Iterator[dict[str, str]]:
    """Return the addresses, by role, of processes that serve the built-in federates to one run after another."""
    processes, addresses = [], {}
    for role in ("physics", "network"):
        port = free_port()
        command = [*shlex.split(SERVE_COMMAND), role, f"tcp-listen:127.0.0.1:{port}"]
        processes.append(subprocess.Popen(command, stderr=subprocess.DEVNULL))
        addresses[role] = f"tcp:127.0.0.1:{port}"
    yield addresses
    for process in processes:
        process.terminate()
        process.wait()


def digest(scenario: CosimScenario, policy: str) -> str:
    with build(scenario, policy=policy) as simulation:
        return simulation.run().digest


@pytest.mark.parametrize("policy", sorted(BUILTIN))
def test_the_built_in_federates_give_the_same_events_as_processes(
    policy: str, served_addresses: dict[str, str]
) -> None:
    external = load_scenario(
        "convoy", {f"{role}.federate": address for role, address in served_addresses.items()} | DURATION
    )
    assert external.physics.federate
    assert digest(external, policy) == digest(without_federates(external), policy)


def test_pipes_give_the_same_events() -> None:
    changes = {f"{role}.federate": f"{SERVE_COMMAND} {role}" for role in ("physics", "network")}
    external = load_scenario("convoy", changes | DURATION)
    start_s = now_s()
    assert digest(external, "sliding_window") == digest(without_federates(external), "sliding_window")
    assert children(start_s) == set()


def test_a_simulation_with_external_federates_can_be_copied(served_addresses: dict[str, str]) -> None:
    external = load_scenario(
        "convoy", {f"{role}.federate": address for role, address in served_addresses.items()} | DURATION
    )
    digests = set()
    for scenario in (external, without_federates(external)):
        with build(scenario) as simulation:
            simulation.run(150_000_000)
            fork = simulation.coordinator.fork()
            digests |= {simulation.run().digest, fork.advance(scenario.duration_ns).digest}
    assert len(digests) == 1


def test_a_federate_that_listens_serves_one_seed_after_another(
    served_addresses: dict[str, str], tmp_path: Path
) -> None:
    options = ("--seeds", "2", "--duration", "200ms", "--format", "json")
    federates = [word for role, address in served_addresses.items() for word in (f"--{role}", address)]
    external, built_in = (cosim(tmp_path, "run", "convoy", *words, *options) for words in (federates, ()))
    assert (external.code, built_in.code) == (0, 0), external.err
    assert json.loads(external.out) == json.loads(built_in.out)


def test_a_network_that_does_not_report_its_next_event_runs_only_with_policies_with_windows(tmp_path: Path) -> None:
    program = tmp_path / "net.py"
    program.write_text(
        "from sim_backends.federates.serving import serve\n"
        "from sim_backends.network.packets import Arrival\n"
        "class Net:\n"
        "    def __init__(self, hello):\n"
        "        pass\n"
        "    def advance(self, to_ns, packets, states):\n"
        "        return [Arrival(p.packet_id, p.destination, p.enters_ns) for p in packets], []\n"
        "serve(Net)\n",
        encoding="utf-8",
    )
    scenario = load_scenario("convoy", {"network.federate": shlex.join((sys.executable, str(program)))} | DURATION)
    assert digest(scenario, "sliding_window")
    with pytest.raises(FederateError, match="does not report the time of its next event"):
        digest(scenario, "event_driven")


def processes_of(program: Path) -> list[int]:
    """Return the process ids of the processes that run a program."""
    pids = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            if os.fsencode(program) in path.read_bytes().split(b"\0")[:3]:
                pids.append(int(path.parent.name))
    return pids


@pytest.mark.parametrize(("signal_number", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_no_federate_remains_if_the_run_is_interrupted_or_killed(
    signal_number: signal.Signals, code: int, tmp_path: Path
) -> None:
    program = tmp_path / "carts.py"
    program.write_bytes((EXAMPLES / "carts.py").read_bytes())
    command = shlex.join((sys.executable, str(program)))
    words = ("cosim", "run", "convoy", "--physics", command, "--duration", "10000s", "--out", "run")
    process = start(tmp_path, *words)
    wait_during(process, lambda: any((tmp_path / "run").rglob("*.parquet")))
    assert processes_of(program)
    process.send_signal(signal_number)
    assert finish(process).code == code
    deadline_s = time.monotonic() + 300
    while processes_of(program):
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
