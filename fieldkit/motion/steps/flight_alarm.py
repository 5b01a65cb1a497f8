"""The alarm of a flight that ends without a landing: last known state of the drone, and the required action.

The pilot is the program that flies the drone, the guard lands it if the pilot fails, and the rescue lands it if both
fail.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.text import JSON_ERRORS, shorten
from fieldkit.motion.steps.flight_rescue import MANUAL_ACTION, FlightRescue
from fieldkit.motion.steps.piloting import FlightLease
from fieldkit.remote import jobs
from fieldkit.steps.scene import Announce, Planned


@contextmanager
def alarm_after_failure(
    flight: FlightLease, guard: Planned, rescue: FlightRescue, log: str, announce: Announce, *, landing_s: float
) -> Iterator[None]:
    """If the body fails, wait for the landing; report an alarm if the drone may still be in the air.

    This function waits only after a `RobotError`, so that Ctrl-C and a lost link are not delayed.

    Args:
        flight: Lease of the pilot.
        guard: Job of the guard.
        rescue: Rescue of the same flight; it must be active until this context is left.
        log: File of the drone's positions.
        announce: Called with the alarm.
        landing_s: Maximum duration of a landing.
    """
    try:
        yield
    except BaseException as error:
        if text := _alarm_text(flight, guard, rescue, log, landing_s if isinstance(error, RobotError) else 0.0):
            announce(text, None)
            if isinstance(error, FieldkitError):
                error.what, error.remedy = f"{error.what}. {text}", f"{MANUAL_ACTION}; then {error.remedy}"
        raise


def _alarm_text(flight: FlightLease, guard: Planned, rescue: FlightRescue, log: str, within_s: float) -> str:
    """Return the alarm; empty if the drone is on the ground or lands in this time.

    The function does not wait if no program can land the drone any longer: its pilot and its guard have exited, and
    there is no rescue or the rescue has exited, too.
    """
    deadline = Deadline.after(within_s)
    names = (log, guard.job.log, rescue.job.log, jobs.exit_file(guard.job), jobs.exit_file(rescue.job))
    tails: list[list[str]] = [[]] * len(names)
    while flight.is_aloft:
        with suppress(FieldkitError):
            flight.refresh()
            tails = flight.read_tails(names)
        _, guard_lines, rescue_lines, guard_code, rescue_code = tails
        if any(line.endswith(" landed") for line in (*guard_lines, *rescue_lines)):
            return ""
        has_alarm = any("ALARM:" in line for line in (*guard_lines, *rescue_lines, *flight.last_lines))
        have_exited = flight.exit_code and guard_code and (rescue_code or not rescue.may_land)
        if deadline.expired or has_alarm or have_exited:
            break
        flight.wait_for_next_poll()
    if not flight.is_aloft:
        return ""
    position_lines, guard_lines, rescue_lines, *_ = tails
    pilot_line = flight.last_lines[-1] if flight.last_lines else "none"
    guard_line, rescue_line = (
        shorten(lines[-1].partition(" ")[2]) if lines else "none" for lines in (guard_lines, rescue_lines)
    )
    return (
        f"ALARM: {flight.robot} MAY STILL BE IN THE AIR. LAST KNOWN: {_state_text(position_lines)}. {MANUAL_ACTION}. "
        f"Last line of its pilot: {pilot_line}; of its guard: {guard_line}; of its rescue: {rescue_line}"
    )


def _state_text(lines: Sequence[str]) -> str:
    """Return the last known state of a drone as text, from the last lines of its position file (untrusted)."""
    for line in reversed(lines):
        with suppress(*JSON_ERRORS):
            values = json.loads(line)
            ahead_m, left_m, up_m = (float(values[name]) for name in ("ahead_m", "left_m", "up_m"))
            mode = shorten(str(values.get("mode", "unknown")))
            return f"{ahead_m:.1f} M AHEAD OF ITS ORIGIN, {left_m:.1f} M TO THE LEFT, {up_m:.1f} M UP, MODE {mode}"
    return "NOTHING"
