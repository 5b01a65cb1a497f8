"""The alarm of a flight that ends without a landing: what is known of the drone, and what a person can do."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.text import JSON_ERRORS, brief
from fieldkit.remote import jobs
from fieldkit.steps.flight_rescue import MANUAL_ACTION, FlightRescue
from fieldkit.steps.piloting import Leash
from fieldkit.steps.scene import Announce, Planned


@contextmanager
def alarmed(
    leash: Leash, guard: Planned, rescue: FlightRescue, log: str, announce: Announce, *, lands_s: float
) -> Iterator[None]:
    """Where the body fails, wait for the landing; report in capitals where the drone may still be in the air.

    Only a failure of the robot is waited for: it does not delay Ctrl-C, and not a lost link.

    Args:
        leash: Of the pilot.
        guard: The job of the guard.
        rescue: Of the same flight; it lasts longer than this.
        log: The file of the drone's positions.
        announce: Told the alarm.
        lands_s: How long a landing takes at most.
    """
    try:
        yield
    except BaseException as error:
        if text := _alarm(leash, guard, rescue, log, lands_s if isinstance(error, RobotError) else 0.0):
            announce(text, None)
            if isinstance(error, FieldkitError):
                error.what, error.remedy = f"{error.what}. {text}", f"{MANUAL_ACTION}; then {error.remedy}"
        raise


def _alarm(leash: Leash, guard: Planned, rescue: FlightRescue, log: str, within_s: float) -> str:
    """Return the alarm; empty if the drone is not in the air, or lands in this time.

    If nothing lands a drone any more, that is reported without a wait: its pilot and its guard have both ended, and
    there is no rescue, or that has ended, too.
    """
    deadline = Deadline.after(within_s)
    names = (log, guard.job.log, rescue.job.log, jobs.exit_file(guard.job), jobs.exit_file(rescue.job))
    tails: list[list[str]] = [[]] * len(names)
    while leash.is_aloft:
        with suppress(FieldkitError):
            leash.refresh()
            tails = leash.tails(names)
        _, guard_lines, rescue_lines, guard_code, rescue_code = tails
        if any(line.endswith(" landed") for line in (*guard_lines, *rescue_lines)):
            return ""
        gave_up = any("ALARM:" in line for line in (*guard_lines, *rescue_lines, *leash.last_lines))
        ended = leash.code and guard_code and (rescue_code or not rescue.may_land)
        if deadline.expired or gave_up or ended:
            break
        leash.pause()
    if not leash.is_aloft:
        return ""
    places, guard_lines, rescue_lines, *_ = tails
    pilot_line = leash.last_lines[-1] if leash.last_lines else "none"
    guard_line, rescue_line = (
        brief(lines[-1].partition(" ")[2]) if lines else "none" for lines in (guard_lines, rescue_lines)
    )
    return (
        f"ALARM: {leash.robot} MAY STILL BE IN THE AIR. LAST KNOWN: {_state(places)}. {MANUAL_ACTION}. "
        f"Last line of its pilot: {pilot_line}; of its guard: {guard_line}; of its rescue: {rescue_line}"
    )


def _state(lines: Sequence[str]) -> str:
    """Return the last known state of a drone in words, by lines of the file of its positions, which are untrusted."""
    for line in reversed(lines):
        with suppress(*JSON_ERRORS):
            values = json.loads(line)
            ahead_m, left_m, up_m = (float(values[name]) for name in ("ahead_m", "left_m", "up_m"))
            mode = brief(str(values.get("mode", "unknown")))
            return f"{ahead_m:.1f} M AHEAD OF ITS ORIGIN, {left_m:.1f} M TO THE LEFT, {up_m:.1f} M UP, MODE {mode}"
    return "NOTHING"
