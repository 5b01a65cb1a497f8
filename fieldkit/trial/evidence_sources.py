"""The table of cross-checks: the checks of every attempt, and the checks that kinds of step declare."""

from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.steps import base

ATTEMPT_CHECKS: Final = (
    CrossCheck(
        quantity="restarts of a robot",
        columns=(),
        source="`ROLE-after.txt`: boot",
        against=("`ROLE-before.txt`: boot",),
        tolerance="a robot may restart if a step restarts it",
    ),
    CrossCheck(
        quantity="clocks that were set",
        columns=(),
        source="`ROLE-after.txt`: clock and seconds since boot",
        against=("the same values in `ROLE-before.txt`",),
        tolerance="10 ms, the error of the readings",
    ),
    CrossCheck(
        quantity="clocks and their time sources",
        columns=("*_time_*", "*_laptop_offset_*", "marks*"),
        source="`ROLE-sources-*.txt`; `exchanges.txt` with `ROLE-before.txt`: clock",
        against=("the clock offset in both captures",),
        tolerance="1 ms in addition to the errors of both",
        outcome=CheckOutcome.MARKED,
    ),
    CrossCheck(
        quantity="changes of channel and regulatory domain",
        columns=("*_channel", "*_regulatory_domain"),
        source="`ROLE-sources-after.txt`: iw-info, iw-reg",
        against=("the same values in `ROLE-sources-before.txt`",),
        tolerance="none; if a file is missing, changes cannot be detected",
    ),
    CrossCheck(
        quantity="state of computers, and other Wi-Fi networks",
        columns=("*_cpu_share", "*_temperature_c", "*_power_state", "*_battery_*", "*_disk_free_bytes", "*_other*"),
        source="`ROLE-sources-before.txt`, `ROLE-sources-after.txt`",
        against=(),
        tolerance="only the robot reports them",
        outcome=CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        quantity="terminations of jobs",
        columns=(),
        source="`ROLE-after.txt`: jobs",
        against=("the procedure", "logs and outputs of jobs: a job with such a file has a recorded termination"),
        tolerance="jobs of steps inside a fault may end in any way",
    ),
    CrossCheck(
        quantity="completeness of a robot's state files",
        columns=(),
        source="sections of `ROLE-after.txt`",
        against=("sections of `ROLE-before.txt`",),
        tolerance="a section that a robot cannot provide is missing in both; older trials have no section `jobs`",
    ),
    CrossCheck(
        quantity="robot that wrote a file",
        columns=(),
        source="name of each file in a robot's archive",
        against=("names that only the laptop writes", "jobs of the other robots"),
        tolerance="none; the evidence is refused",
    ),
    CrossCheck(
        quantity="values of telemetry sources in a robot's profile",
        columns=("*_link_source", "*_sinr_*", "*_band", "*_cell", "*_neighbours_min", "*_telemetry_samples"),
        source="`ROLE-telemetry-NAME.txt`, `ROLE-telemetry-NAME-laptop.txt`",
        against=(),
        tolerance="only the radio measures them; a source that fails gives no value",
        outcome=CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        quantity="lateness and radio links of the emulator",
        columns=("emulator_*", "sender_*", "receiver_*"),
        source="`lateness.txt`, `link.csv`; `ROLE-link.txt` of a robot",
        against=(),
        tolerance="only the emulator or the radio's driver measures them",
        outcome=CheckOutcome.UNCHECKED,
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
    """Return the table for `docs/evidence.md`. Its last column is the consequence of a larger difference."""
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
