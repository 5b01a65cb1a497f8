"""The table of cross-checks: the checks of every attempt, and the checks that kinds of step declare."""

from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.steps import base

ATTEMPT_CHECKS: Final = (
    CrossCheck(
        "restarts of a robot",
        (),
        "`ROLE-after.txt`: boot",
        ("`ROLE-before.txt`: boot",),
        "a robot that a step restarts",
    ),
    CrossCheck(
        "clocks that were set",
        (),
        "`ROLE-after.txt`: clock and seconds since boot",
        ("`ROLE-before.txt`: the same",),
        "the error of the readings, 10 ms",
    ),
    CrossCheck(
        "clocks and their time sources",
        ("*_time_*", "*_laptop_offset_*", "marks*"),
        "`ROLE-sources-before.txt`, `ROLE-sources-after.txt`; `exchanges.txt` with `ROLE-before.txt`: clock",
        (),
        "compared with the clock offset in both captures: a contradiction is the mark `clocks disagree`",
        CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        "changes of channel and regulatory domain",
        ("*_channel", "*_regulatory_domain"),
        "`ROLE-sources-after.txt`: iw-info, iw-reg",
        ("`ROLE-sources-before.txt`: the same",),
        "none; unknown if one is missing",
    ),
    CrossCheck(
        "computers, and the neighbourhood of radios",
        ("*_cpu_share", "*_temperature_c", "*_power_state", "*_battery_*", "*_disk_free_bytes", "*_other*"),
        "`ROLE-sources-before.txt`, `ROLE-sources-after.txt`",
        (),
        "only the robot reports them",
        CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        "terminations of jobs",
        (),
        "`ROLE-after.txt`: jobs",
        ("the procedure", "logs and outputs of jobs: a job with such a file has a recorded termination"),
        "jobs of steps inside a fault",
    ),
    CrossCheck(
        "completeness of a robot's state files",
        (),
        "sections of `ROLE-after.txt`",
        ("sections of `ROLE-before.txt`",),
        "a section that a robot cannot provide is missing in both; older trials have no jobs",
    ),
    CrossCheck(
        "robot that wrote a file",
        (),
        "name of each file in a robot's archive",
        ("names that only the laptop writes", "jobs of the other robots"),
        "none: the evidence is refused",
    ),
    CrossCheck(
        "values of telemetry sources in a robot's profile",
        ("*_link_source", "*_sinr_*", "*_band", "*_cell", "*_neighbours_min", "*_telemetry_samples"),
        "`ROLE-telemetry-NAME.txt`, `ROLE-telemetry-NAME-laptop.txt`",
        (),
        "only the radio measures them; a source that fails gives no value",
        CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        "lateness and radio links of the emulator",
        ("emulator_*", "sender_*", "receiver_*"),
        "`lateness.txt`, `link.csv`; `ROLE-link.txt` of a robot",
        (),
        "only the emulator or the radio's driver measures them",
        CheckOutcome.UNCHECKED,
    ),
)


def rows() -> Iterator[tuple[str, CrossCheck]]:
    """Yield the kind of step and the check of every cross-check; the kind is empty for checks of every attempt."""
    yield from (("", check) for check in ATTEMPT_CHECKS)
    for kind, step in base.step_types().items():
        yield from ((kind, check) for check in step.cross_checks)


def covers(kind: str, column: str) -> bool:
    """Return True if a check of a kind of step covers a column."""
    checks = (check for name, check in rows() if name == kind)
    return any(fnmatchcase(column, pattern) for check in checks for pattern in check.columns)


def markdown() -> str:
    """Return the table for `docs/evidence.md`."""
    lines = [
        "| step | quantity | source | compared with | permitted difference | otherwise |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for kind, check in rows():
        against = "; ".join(check.against) or "nothing"
        step = f"`{kind}`" if kind else "every attempt"
        lines.append(
            f"| {step} | {check.quantity} | {check.source} | {against} | {check.tolerance} | {check.outcome} |"
        )
    return "\n".join(lines) + "\n"
