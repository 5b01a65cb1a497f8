"""What a trial of many repeats takes on the laptop beside the repeats: `python -m benchmarks.ledger`; needs no root.

Trials of one ping each, whose evidence is written here and not by robots: wall time of keeping an attempt (its files,
the journal, the row, the table, the manifest; all on disk, so the disk counts), as the mean over all attempts of the
trial and over the last hundred; of opening the trial again as `fieldkit resume` does, which reads all evidence; of
asking how many repeats are over; and of keeping the next ten attempts. `--keep FOLDER` leaves the trials there, and
`--open FOLDER` measures those that are there, by another checkout's fieldkit too (`PYTHONPATH`).
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

REPEATS: Final = (1_000, 5_000, 10_000)
LAST: Final = 100
NEXT: Final = 10
SPARE: Final = 100
"""Repeats that are planned beyond those that are run, to go on with."""

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


def planned(repeats: int) -> Plan:
    """Return the plan of a trial."""
    profile = load_profile("turtlebot3_burger")
    cast = {role: Robot(name=role, address="10.0.0.1", profile=profile) for role in (Role.SENDER, Role.RECEIVER)}
    request = TrialRequest(
        validate(parse(_PROCEDURE, source="small"), Procedure), parse_distance("30ft"), repeats=repeats + SPARE
    )
    return make_plan(request, backend="field", cast=cast, now=datetime.now(UTC))


def keep(ledger: Ledger, plan: Plan, folder: Path, repeat: RepeatId) -> float:
    """Make one attempt and return how long fieldkit's own part took, in s."""
    began_s = time.perf_counter()
    begun = ledger.begin(repeat)
    partial = store.open_attempt(folder, repeat)
    (partial / "ping.txt").write_text(_PING, encoding="ascii")
    ledger.measured(begun)
    judged = gates.judge(plan, repeat, AttemptEvidence(partial))
    ledger.keep(partial, replace(begun, status=Status.VALID), judged.measured)
    return time.perf_counter() - began_s


def run(out: Path, repeats: int) -> Path:
    """Run a trial of so many repeats, print what they took, and return its folder."""
    plan = planned(repeats)
    folder = store.create(out, plan)
    (folder / journal.JOURNAL_FILE).touch()
    ledger = Ledger(plan, folder, Stop())
    took_s = [keep(ledger, plan, folder, repeat) for repeat in list(plan.order())[:repeats]]
    began_s = time.perf_counter()
    ledger.summarize()
    print(
        f"{repeats:>7} repeats: {sum(took_s):8.1f} s in all, {1e3 * statistics.fmean(took_s):7.2f} ms each, "
        f"{1e3 * statistics.fmean(took_s[-LAST:]):7.2f} ms each of the last {LAST}, "
        f"{time.perf_counter() - began_s:6.2f} s for the summary",
        flush=True,
    )
    return folder


def reopen(folder: Path) -> None:
    """Open a trial again, and go on with it."""
    plan = store.read_plan(folder)
    began_s = time.perf_counter()
    ledger = Ledger(plan, folder, Stop())
    opened_s = time.perf_counter()
    done = ledger.done
    asked_s = time.perf_counter()
    left = [repeat for repeat in plan.order() if not ledger.is_over(repeat)]
    took_s = [keep(ledger, plan, folder, repeat) for repeat in left[:NEXT]]
    print(
        f"{done:>7} repeats: opened in {opened_s - began_s:7.2f} s, asked in {1e3 * (asked_s - opened_s):9.2f} ms, "
        f"{1e3 * statistics.median(took_s):8.2f} ms each of the next {NEXT} (median)",
        flush=True,
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, nargs="+", default=REPEATS)
    parser.add_argument("--keep", type=Path, help="folder that the trials are left in")
    parser.add_argument("--open", type=Path, help="folder with trials to go on with; none is made")
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
