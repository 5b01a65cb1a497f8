"""Overhead of fieldkit per repeat, compared with a script: `python -m benchmarks.trial_overhead [--json]`, as root.

Both run the same steps on the same emulated robots, in alternating repeats: create a folder and log the host's state
on both robots, record, capture at both ends, send the bag, wait until the captures are complete, ping, log the state
again, fetch all files and check their hashes. The overhead is the wall time of a repeat minus the time of the tools:
the recorder's process, the time from the start of the sending nc to the end of the listening one, and the process of
ping. These times are from kernel events (`benchmarks.lifetimes`) for both peers. Each repeat checks that both run the
same command lines.

Both peers are measured over control links without delay, and over control links with a round trip of 100 ms, as on
bad Wi-Fi. Over the slow links, sequential round trips are counted too.

The script is `trial_overhead.sh`, over persistent OpenSSH connections. It does less than fieldkit: it does not
inspect bag and captures, computes no loss, and writes no journal, intervals or manifest.
"""

import argparse
import json
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Final

from benchmarks.bash_peer import BashPeer, connected
from benchmarks.lifetimes import Lifetime, Watch
from benchmarks.overhead import TOOLS, Repeat, command_lines, overhead_ms
from benchmarks.slow_links import SlowLinks, slow_control
from fieldkit.config import schema
from fieldkit.config.site import Site
from fieldkit.core.events import Event, PhaseStarted, RepeatEnded
from fieldkit.core.model import Protocol, Role, Status
from fieldkit.core.prompts import Unattended
from fieldkit.core.units import parse_distance, parse_duration_s
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running.runner import run_trial
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.testbed import EmulatedTestbed

SITE: Final = """\
backend: emulated
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  turtlebot-2: {profile: turtlebot3_burger}
roles:
  masterless: {sender: turtlebot-1, receiver: turtlebot-2}
emulated:
  ros: builtin
  radio: {loss: 0%, delay: 1ms, rate: 50Mbit/s}
"""
# The steps of procedures/los.yaml, with shorter waits.
PROCEDURE: Final = """\
name: overhead
summary: the paper's steps with shorter waits
scenario: los
topology: masterless
protocols: [tcp, udp]
repeats: 20
attempts: 1
steps:
  - record: {robot: sender, topics: [/scan], duration: 1s, name: scan}
  - capture:
      robots: [sender, receiver]
      during:
        - transfer: {from: sender, to: receiver, idle: 1s}
  - ping: {from: sender, to: receiver, count: 3, interval: 20ms}
"""
IDLE_S, PINGS, PING_INTERVAL_S = "1", "3", "0.02"  # as in PROCEDURE

PEERS: Final = ("fieldkit", "script")
ROLES: Final = (Role.SENDER, Role.RECEIVER)
SCRIPT_LIMIT_S: Final = 120.0


@dataclass
class AlternatingPeers:
    """Alternates fieldkit and the script. As the sink of a trial it runs the script after each repeat.

    Attributes:
        watch: Watches the tools on the robots.
        script: The other peer.
        repeats: The results, without the first repeat of each peer and protocol, which is a warm-up.
        untimed: Number of repeats without times, because a tool exited before the watcher identified it.
        slow: The slow control links, if any.
    """

    watch: Watch
    script: BashPeer
    slow: SlowLinks | None = None
    repeats: list[Repeat] = field(default_factory=list)
    untimed: int = 0
    _start_ns: int = 0
    _start_trips: int = 0
    _phases: dict[str, int] = field(default_factory=dict)

    def __call__(self, event: Event) -> None:
        """Process an event of the trial."""
        now_ns = time.monotonic_ns()
        match event:
            case PhaseStarted(name=name, repeat=repeat) if repeat:
                self._phases[name] = now_ns
                self._start_ns = self._start_ns or now_ns
            case RepeatEnded(repeat=repeat, status=status, reason=reason):
                if status is not Status.VALID:
                    raise RuntimeError(f"{repeat} is {status}: {reason}")
                protocol, number = repeat.split("-")
                tools = self._store("fieldkit", protocol, int(number), now_ns)
                self._run_script(protocol, int(number), tools)
                self._restart_timing()
            case _:
                pass

    def _run_script(self, protocol: str, number: int, expected: Sequence[Lifetime]) -> None:
        self._restart_timing()
        for phase in self.script.repeat(protocol, number, SCRIPT_LIMIT_S):
            self._phases[phase] = time.monotonic_ns()
        tools = self._store("script", protocol, number, time.monotonic_ns())
        fieldkit_lines, script_lines = command_lines(expected), command_lines(tools)
        if fieldkit_lines and script_lines and fieldkit_lines != script_lines:
            only_fieldkit, only_script = fieldkit_lines - script_lines, script_lines - fieldkit_lines
            raise RuntimeError(f"the peers differ: fieldkit ran {only_fieldkit}, the script {only_script}")

    def _restart_timing(self) -> None:
        self._phases = {}
        self._start_trips = self._trips()
        self._start_ns = time.monotonic_ns()

    def _trips(self) -> int:
        return 0 if self.slow is None else self.slow.trips

    def _store(self, peer: str, protocol: str, number: int, end_ns: int) -> tuple[Lifetime, ...]:
        """Store the result of a repeat unless it is a warm-up; return its tools, none if one was not identified."""
        trips = self._trips() - self._start_trips
        try:
            tools = self.watch.read(sum(TOOLS.values()), self._start_ns)
        except TimeoutError:
            self.untimed += 1
            return ()
        if number > 1:
            own_ms = overhead_ms(self._start_ns, self._phases, end_ns, tools)
            self.repeats.append(Repeat(peer, protocol, own_ms, trips))
        return tools


@contextmanager
def open_peers(
    testbed: EmulatedTestbed, out: Path, record_s: float, slow: SlowLinks | None
) -> Iterator[AlternatingPeers]:
    """Yield both peers, connected to the robots of `testbed`; the script writes its evidence to `out`."""
    addresses = [testbed.robots[role].spec.ip for role in ROLES]
    with ExitStack() as stack:
        connections = stack.enter_context(connected(testbed, ROLES, slow))
        watch = stack.enter_context(Watch([testbed.robots[role].pid for role in ROLES], list(TOOLS)))
        words = [str(out), *addresses, f"{record_s:g}", IDLE_S, PINGS, PING_INTERVAL_S]
        yield AlternatingPeers(watch, stack.enter_context(BashPeer(connections, words)), slow)


def measure(rounds: int, record_s: float, round_trip_s: float) -> AlternatingPeers:
    """Return the results of `rounds` rounds: one repeat by fieldkit and one by the script per protocol."""
    document = schema.parse(SITE, source="site")
    backend = EmulatedBackend(schema.validate(document, Site), document)
    procedure = schema.validate(schema.parse(PROCEDURE, source="procedure"), Procedure)
    cast = backend.cast(procedure.topology)
    request = TrialRequest(procedure, parse_distance("5m"), repeats=rounds + 1, record_s=record_s)
    plan: Plan = make_plan(request, backend="emulated", cast=cast, now=datetime.now(UTC))
    with (
        slow_control(round_trip_s) if round_trip_s else nullcontext() as slow,
        tempfile.TemporaryDirectory(prefix="fieldkit-bench-") as folder,
        backend.open(cast, seed=1, sink=lambda _: None, operator=Unattended()) as testbed,
    ):
        assert isinstance(testbed, EmulatedTestbed)
        with open_peers(testbed, Path(folder), record_s, slow) as peers:
            run_trial(plan, testbed, Path(folder), peers)
            return peers


def show(repeats: Sequence[Repeat]) -> None:
    """Print the overhead per repeat and by phase."""
    print(f"{'overhead, ms':22}{'fieldkit':>22}{'script':>22}{'fieldkit/script':>17}")
    for protocol in Protocol:
        totals = {peer: [repeat.total_ms for repeat in chosen(repeats, peer, protocol)] for peer in PEERS}
        ratio = statistics.median(totals["fieldkit"]) / statistics.median(totals["script"])
        print(f"{protocol:22}{spread(totals['fieldkit']):>22}{spread(totals['script']):>22}{ratio:>17.2f}")
    for protocol in Protocol:
        trips = {peer: [repeat.trips for repeat in chosen(repeats, peer, protocol)] for peer in PEERS}
        if any(trips["fieldkit"]):
            name = f"{protocol}, round trips"
            print(f"{name:22}{spread(trips['fieldkit']):>22}{spread(trips['script']):>22}")
    print(
        f"\n{'median by phase, ms':22}"
        + "".join(f"{f'{peer} {protocol}':>15}" for peer in PEERS for protocol in Protocol)
    )
    for phase in repeats[0].own_ms:
        cells = (
            statistics.median(repeat.own_ms[phase] for repeat in chosen(repeats, peer, protocol))
            for peer in PEERS
            for protocol in Protocol
        )
        print(f"{phase:22}" + "".join(f"{cell:>15.1f}" for cell in cells))


def chosen(repeats: Sequence[Repeat], peer: str, protocol: Protocol) -> list[Repeat]:
    """Return the repeats of one peer with one protocol."""
    return [repeat for repeat in repeats if (repeat.peer, repeat.protocol) == (peer, protocol)]


def spread(values: Sequence[float]) -> str:
    """Return `median (lowest to highest)` of `values`."""
    return f"{statistics.median(values):.0f} ({min(values):.0f} to {max(values):.0f})"


def exit_with_cleanup(_number: int, _frame: FrameType | None) -> None:
    """Exit on SIGTERM with clean-up."""
    sys.exit(143)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="repeats per protocol and peer (default: 20)")
    parser.add_argument("--record", default="1s", help="length of every recording (default: 1s)")
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--round-trips",
        nargs="+",
        default=["0s", "100ms"],
        help="round-trip times of the control links (default: 0s 100ms)",
    )
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, exit_with_cleanup)
    rows = []
    for text in options.round_trips:
        load_before = os.getloadavg()[0]
        peers = measure(options.rounds, parse_duration_s(options.record), parse_duration_s(text))
        if options.json:
            repeats = [asdict(repeat) for repeat in peers.repeats]
            rows.append(
                {"round_trip": text, "load_before": load_before, "untimed": peers.untimed, "repeats": repeats}
            )
            continue
        print(f"control links with {text} of round trip")
        print(f"{options.rounds} rounds, median (lowest to highest); load before: {load_before:.2f}")
        print(f"repeats that could not be timed: {peers.untimed}\n")
        show(peers.repeats)
        print()
    if options.json:
        print(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
