"""Overhead of the ledger in trials of many repeats: `python -m benchmarks.ledger`; needs no root.

The ledger stores finished attempts. The trials have one ping per repeat, with generated evidence instead of robots.
The benchmark prints the wall time, including disk access, of these operations: storing an attempt (files, journal,
row, table, manifest), as the mean over all attempts and over the last hundred; opening the trial again as `fieldkit
resume` does, which reads all evidence; reading the number of finished repeats; and storing the next ten attempts.
`--keep FOLDER` keeps the trials in that folder, and `--open FOLDER` measures existing trials, also with fieldkit of
another checkout (`PYTHONPATH`).
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import load_profile
from fieldkit.config.schema import parse, validate
from fieldkit.core.model import RepeatId, Role, Status
from fieldkit.core.units import parse_distance
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates, journal, store
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.stored import plans

REPEATS: Final = (1_000, 5_000, 10_000)
LAST: Final = 100
"""Number of attempts at the end of a trial whose mean time is printed."""
NEXT: Final = 10
"""Number of attempts after reopening."""
SPARE: Final = 100
"""Repeats that are planned in addition, to be run after reopening."""

_PROCEDURE: Final = """\
name: small
summary: one ping
scenario: los
topology: masterless
protocols: [tcp]
repeats: 1
steps: [ping: {from: sender, to: receiver, count: 10}]
"""
_REPLY: Final = "[17000000{0:02}.000000] 510 bytes from 10.0.0.2: icmp_seq={0} ttl=64 time={0}.125 ms\n"
_PING: Final = (
    "PING 10.0.0.2 (10.0.0.2) 502(530) bytes of data.\n"
    + "".join(_REPLY.format(number) for number in range(1, 11))
    + "10 packets transmitted, 10 received, 0% packet loss, time 1800ms\n"
)


def trial_plan(repeats: int) -> Plan:
    """Return the plan of a trial."""
    profile = load_profile("turtlebot3_burger")
    cast = {role: Robot(name=role, address="10.0.0.1", profile=profile) for role in (Role.SENDER, Role.RECEIVER)}
    request = TrialRequest(
        validate(parse(_PROCEDURE, source="small"), Procedure), parse_distance("30ft"), repeats=repeats + SPARE
    )
    return make_plan(request, backend="field", cast=cast, now=datetime.now(UTC))


def store_attempt(ledger: Ledger, plan: Plan, folder: Path, repeat: RepeatId) -> float:
    """Make one attempt and return the time of fieldkit's part, in s."""
    started_s = time.perf_counter()
    attempt = ledger.begin(repeat)
    attempt_folder = store.open_attempt(folder, repeat)
    (attempt_folder / "ping.txt").write_text(_PING, encoding="ascii")
    ledger.record_measured(attempt)
    verdict = gates.judge(plan, repeat, AttemptEvidence(attempt_folder))
    ledger.commit(attempt_folder, replace(attempt, status=Status.VALID), verdict.measured)
    return time.perf_counter() - started_s


def run(out: Path, repeats: int) -> Path:
    """Run a trial with the given number of repeats, print the times, and return its folder."""
    plan = trial_plan(repeats)
    folder = store.create(out, plan)
    (folder / journal.JOURNAL_FILE).touch()
    ledger = Ledger(plan, folder, Stop())
    times_s = [store_attempt(ledger, plan, folder, repeat) for repeat in list(plan.repeats_in_order())[:repeats]]
    started_s = time.perf_counter()
    ledger.summarize()
    print(
        f"{repeats:>7} repeats: {sum(times_s):8.1f} s in all, {1e3 * statistics.fmean(times_s):7.2f} ms each, "
        f"{1e3 * statistics.fmean(times_s[-LAST:]):7.2f} ms each of the last {LAST}, "
        f"{time.perf_counter() - started_s:6.2f} s for the summary",
        flush=True,
    )
    return folder


def reopen(folder: Path) -> None:
    """Open a trial again, and continue it."""
    plan = plans.read_plan(folder)
    started_s = time.perf_counter()
    ledger = Ledger(plan, folder, Stop())
    opened_s = time.perf_counter()
    done = ledger.finished_count
    counted_s = time.perf_counter()
    remaining = [repeat for repeat in plan.repeats_in_order() if not ledger.is_finished(repeat)]
    times_s = [store_attempt(ledger, plan, folder, repeat) for repeat in remaining[:NEXT]]
    print(
        f"{done:>7} repeats: opened in {opened_s - started_s:7.2f} s, counted in {1e3 * (counted_s - opened_s):9.2f} "
        f"ms, {1e3 * statistics.median(times_s):8.2f} ms each of the next {NEXT} (median)",
        flush=True,
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, nargs="+", default=REPEATS)
    parser.add_argument("--keep", type=Path, help="folder in which the trials are kept")
    parser.add_argument("--open", type=Path, help="folder with trials to continue; no trial is made")
    options = parser.parse_args()
    if options.open is not None:
        for folder in sorted(options.open.iterdir()):
            reopen(folder)
        return
    with tempfile.TemporaryDirectory() as scratch:
        for repeats in options.repeats:
            reopen(run(options.keep or Path(scratch), repeats))


if __name__ == "__main__":
    main()
