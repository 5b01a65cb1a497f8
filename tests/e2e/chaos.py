"""Trials with random faults: links are cut, sshd is killed, robots reboot, and fieldkit is killed and resumed.

`python -m tests.e2e.chaos --faults 200` is the soak test of `make soak`; tests/e2e/test_chaos.py runs short trials.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Fault, FaultKind, Protocol, Role, Status
from fieldkit.remote import jobs
from fieldkit.trial import journal
from fieldkit.trial.plan import PLAN_FILE
from sim_backends.emulated.backend import DEFAULT_SITE
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.labs import write_procedure
from tests.helpers.runs import LIMIT_S, Run, fieldkit, only_trial, rows, start
from tests.helpers.texts import procedure

MAX_STARTS: Final = 60
RECOVERY_NS: Final = 5 * 10**9
"""Time for which a fault may have effects after its end; for example, a killed server takes time to restart."""

VOIDS_PER_FAULT: Final = 2
"""A fault makes at most two attempts void: the attempt during the fault, and one that starts before its end."""

POLL_S: Final = 5.0

PROCEDURE: Final = procedure(
    "chaos",
    """\
- record: {robot: sender, topics: [/scan], duration: 1s}
- capture:
    during:
      - transfer: {from: sender, to: receiver, file: scan.bag, into: recv.bag, limit: 10s, idle: 1s}
- ping: {from: sender, to: receiver, count: 5, interval: 200ms}
""",
    protocols="tcp, udp",
    repeats=10,
    attempts=99,
)


@dataclass(frozen=True)
class InjectedFault:
    """A fault injected into a trial.

    Attributes:
        kind: Kind of the fault.
        started_ns: Start time, in nanoseconds since 1970 UTC.
        ended_ns: End time.
    """

    kind: str
    started_ns: int
    ended_ns: int


@dataclass(frozen=True)
class VoidAttempt:
    """A void attempt.

    Attributes:
        name: Name of its folder.
        reason: Reason in the journal.
        started_ns: Start time, in nanoseconds since 1970 UTC.
        ended_ns: Time of its entry in the journal.
    """

    name: str
    reason: str
    started_ns: int
    ended_ns: int


def unexplained(voids: Sequence[VoidAttempt], faults: Sequence[InjectedFault]) -> list[VoidAttempt]:
    """Return the void attempts that no fault during the attempt explains.

    Args:
        voids: The void attempts.
        faults: The injected faults, which do not overlap.
    """
    remaining = sorted([*faults] * VOIDS_PER_FAULT, key=lambda fault: fault.started_ns)
    unexplained_voids = []
    # Faults do not overlap, so each attempt matches consecutive faults, and the first one is assigned to it.
    for void in sorted(voids, key=lambda void: void.ended_ns):
        matching_faults = (
            fault
            for fault in remaining
            if fault.started_ns <= void.ended_ns and void.started_ns <= fault.ended_ns + RECOVERY_NS
        )
        if cause := next(matching_faults, None):
            remaining.remove(cause)
        else:
            unexplained_voids.append(void)
    return unexplained_voids


@dataclass
class FaultTrialResult:
    """Results of a trial with faults.

    Attributes:
        planned: Number of planned repeats.
        valid: Number of repeats with exactly one valid attempt.
        voids: The void attempts.
        starts: Number of starts of fieldkit.
        faults: The injected faults.
        problems: Violations of the requirements.
        stops: Error output each time fieldkit stopped before the end.
    """

    planned: int
    valid: int = 0
    starts: int = 0
    voids: list[VoidAttempt] = field(default_factory=list)
    faults: list[InjectedFault] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    stops: list[str] = field(default_factory=list)

    @property
    def lost(self) -> int:
        """Number of planned repeats that are not valid."""
        return self.planned - self.valid

    def __str__(self) -> str:
        kinds = ", ".join(
            f"{count} {kind}" for kind, count in sorted(Counter(fault.kind for fault in self.faults).items())
        )
        return (
            f"{len(self.faults)} faults injected ({kinds}); {self.starts} starts of fieldkit; "
            f"{self.planned} repeats planned, {self.valid} valid, {len(self.voids)} attempts void and redone; "
            f"repeats lost: {self.lost}"
        )


class Chaos:
    """One trial with injected faults.

    Args:
        field_robots: The robots.
        seed: Seed of the faults, their times and robots.
        repeats: Repeats per protocol.
        faults: Maximum number of faults; the trial may end before the last.
    """

    def __init__(self, field_robots: FieldRobots, *, seed: int, repeats: int, faults: int) -> None:
        self._field_robots = field_robots
        self._random = random.Random(seed)
        self._budget = faults
        self._deck: list[str] = []
        self._repeats = repeats
        self.tally = FaultTrialResult(planned=repeats * len(Protocol))
        self._process: subprocess.Popen[str] | None = None

    def run(self) -> FaultTrialResult:
        lab = self._field_robots.folder
        name = write_procedure(lab, PROCEDURE)
        words: tuple[str, ...] = ("trial", name, "5m", "--repeats", str(self._repeats), "--yes", "--json")
        while (result := self._run_once(*words)).code != 0 and self.tally.starts < MAX_STARTS:
            if self._unexplained():
                break
            if result.code not in {3, -9}:
                self.tally.problems.append(f"exit code {result.code}: {result.err}")
            self.tally.stops.append(result.err.strip())
            if "locked it at" in result.err and not self._trial_exists():
                # fieldkit was killed after locking the robots and before creating its folder, so there is nothing to
                # resume.
                fieldkit(lab, "abort", "--yes")
            if self._trial_exists():
                words = ("resume", str(only_trial(lab)), "--yes", "--json")
        self._judge()
        return self.tally

    def _trial_exists(self) -> bool:
        """Return True if there is a trial to resume."""
        return any((self._field_robots.folder / "trials").glob(f"*/{PLAN_FILE}"))

    def _run_once(self, *words: str) -> Run:
        """Start fieldkit and inject faults until it ends."""
        self.tally.starts += 1
        self._process = start(self._field_robots.folder, *words)
        while self._process.poll() is None and self._budget > 0:
            try:
                self._process.wait(self._random.uniform(0.2, 4.0))
            except subprocess.TimeoutExpired:
                self._inject()
        return self._finish(self._process)

    def _finish(self, process: subprocess.Popen[str]) -> Run:
        """Wait until fieldkit exits; kill it if a fault does not explain a void attempt, to save time."""
        deadline = Deadline.after(LIMIT_S)
        while True:
            try:
                out, err = process.communicate(timeout=POLL_S)
                return Run(process.returncode, out, err)
            except subprocess.TimeoutExpired:
                if deadline.expired or self._unexplained():
                    process.kill()

    def _unexplained(self) -> list[VoidAttempt]:
        """Return the previous void attempts that no fault explains."""
        return (
            unexplained(_voids(only_trial(self._field_robots.folder)), self.tally.faults)
            if self._trial_exists()
            else []
        )

    def _inject(self) -> None:
        inject = self._field_robots.testbed.inject
        faults: dict[str, Callable[[Role], object]] = {
            "link cut": self._cut,
            "link reset": self._field_robots.links.drop,
            "radio down": lambda role: inject(Fault(FaultKind.LINK_DOWN, role, self._random.uniform(0.2, 3.0))),
            "sshd killed": lambda role: inject(Fault(FaultKind.KILL, role, process="sshd")),
            "robot rebooted": lambda role: inject(Fault(FaultKind.REBOOT, role)),
            "fieldkit killed": self._kill,
        }
        if not self._deck:  # each kind of fault is used once before a kind is repeated
            self._deck = self._random.sample(list(faults), k=len(faults))
        kind = self._deck.pop()
        role = self._random.choice((Role.SENDER, Role.RECEIVER))
        self._budget -= 1
        started_ns = time.time_ns()
        faults[kind](role)
        self.tally.faults.append(InjectedFault(kind, started_ns, time.time_ns()))

    def _cut(self, role: Role) -> None:
        self._field_robots.links.cut(role)
        duration_s = self._random.uniform(0.2, 12.0)
        assert self._process is not None
        try:
            self._process.wait(duration_s)
        except subprocess.TimeoutExpired:
            pass
        finally:
            self._field_robots.links.restore(role)

    def _kill(self, _role: Role) -> None:
        assert self._process is not None
        self._process.kill()

    def _judge(self) -> None:
        """Check the folder of the trial, and that no jobs remain on the robots."""
        lab, tally = self._field_robots.folder, self.tally
        trial = only_trial(lab)
        table = rows(trial)
        planned = {(str(protocol), str(number + 1)) for protocol in Protocol for number in range(self._repeats)}
        valid = Counter((row["protocol"], row["repeat"]) for row in table if row["status"] == "valid")
        tally.valid = sum(valid[repeat] == 1 for repeat in planned)
        tally.voids = _voids(trial)
        tally.problems += [f"void without a fault: {void}" for void in self._unexplained()]
        if any(count > 1 for count in valid.values()) or valid.keys() - planned:
            tally.problems.append(f"measured twice or unplanned: {valid}")
        if any(
            row["status"] not in {"valid", "void"} or (row["status"] == "void") != bool(row["reason"])
            for row in table
        ):
            tally.problems.append("a row is neither valid nor void with a reason")
        if (verified := fieldkit(lab, "verify", str(trial))).code != 0:
            tally.problems.append(verified.err)
        if "the same bytes" not in (rebuilt := fieldkit(lab, "rebuild", str(trial))).out:
            tally.problems.append(f"rebuild: {rebuilt.out} {rebuilt.err}")
        for role, shell in self._field_robots.testbed.shells.items():
            if remaining := jobs.list_running(shell, Deadline.after(20)):
                tally.problems.append(f"left on {role}: {remaining}")


def _voids(trial: Path) -> list[VoidAttempt]:
    """Return the void attempts of a trial."""
    entries = journal.read(trial)
    ended_ns_by_attempt = {(entry.repeat, entry.attempt): entry.utc_ns for entry in entries}
    return [
        VoidAttempt(
            attempt.folder,
            attempt.reason,
            attempt.started_utc_ns,
            ended_ns_by_attempt[attempt.repeat, attempt.number],
        )
        for attempt in journal.ended_attempts(entries)
        if attempt.status is Status.VOID
    ]


def chaos(folder: Path, *, seed: int, repeats: int, faults: int, debian: bool = True) -> FaultTrialResult:
    """Run one trial with `repeats` repeats per protocol and `faults` faults, in the empty folder `folder`.

    The robots have Debian's ROS if `debian` is True, and the built-in ROS otherwise.
    """
    with start_field_robots(folder, site=DEFAULT_SITE if debian else None) as field_robots:
        return Chaos(field_robots, seed=seed, repeats=repeats, faults=faults).run()


def main() -> int:
    """Run trials until the given number of faults was injected; print the results."""
    parser = argparse.ArgumentParser(description="soak test")
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=10, help="per protocol and trial")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--built-in-ros", action="store_true", help="robots without Debian's ROS")
    arguments = parser.parse_args()
    fault_count = lost_count = 0
    seed = arguments.seed
    problems = []
    while fault_count < arguments.faults:
        with tempfile.TemporaryDirectory(prefix="fieldkit-soak-") as folder:
            tally = chaos(
                Path(folder),
                seed=seed,
                repeats=arguments.repeats,
                faults=arguments.faults - fault_count,
                debian=not arguments.built_in_ros,
            )
        print(f"seed {seed}: {tally}", flush=True)
        fault_count += len(tally.faults)
        lost_count += tally.lost
        problems += tally.problems
        seed += 1
    for problem in problems:
        print(f"PROBLEM: {problem}")
    print(f"faults injected: {fault_count}, repeats lost: {lost_count}")
    return int(bool(lost_count or problems))


if __name__ == "__main__":
    sys.exit(main())
