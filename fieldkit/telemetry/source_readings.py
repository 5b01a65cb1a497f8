"""Readings of a telemetry source during an attempt, from the file that `poll` in telemetry.sh writes.

Each run of the source's command has a line `==> SECONDS CODE BYTES <==`, that many bytes of output, and a line feed.
SECONDS are counted from the boot of the computer that ran it. CODE is the exit code, `large` if the output was longer
than `MAX_OUTPUT_BYTES`, or `interface` if the address is reached over the interface under test.
"""

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.measure.evidence import reading
from fieldkit.remote.command import printable
from fieldkit.telemetry import source_outputs
from fieldkit.telemetry.source_outputs import Values
from fieldkit.telemetry.telemetry_section import MAX_OUTPUT_BYTES, TelemetrySource

_HEAD: Final = re.compile(rb"==> ([0-9]{1,10})\.([0-9]{2}) ([0-9]{1,3}|large|interface) ([0-9]{1,5}) <==\n")
_HUNDREDTH_NS: Final = 10_000_000
_TOO_LONG: Final = f"its output was longer than {MAX_OUTPUT_BYTES >> 10} KiB"
_CURL_REASONS: Final = {
    "7": "connection refused",
    "22": "HTTP error",
    "28": "no answer in time",
    "56": "the connection was closed",
    "63": _TOO_LONG,
}
"""Reasons by exit code of curl (EXIT CODES in curl(1))."""


def file(role: Role, name: str, source: TelemetrySource) -> str:
    """Return the name of the file with the outputs of a source; the robot compresses its files."""
    if source.at == "laptop":
        return laptop_files.telemetry_file(role, name)
    return f"{role}-telemetry-{name}.txt"


@dataclass(frozen=True)
class SourceReadings:
    """Readings of one source.

    Attributes:
        values: Values of each run with at least one value, in order of time.
        runs: Number of runs.
        reasons: Number of the other runs by the reason why they have no value.
        since_boot_ns: Start of each run in `values`, in nanoseconds since the boot of the computer that ran it.
    """

    values: tuple[Values, ...]
    runs: int
    reasons: Counter[str]
    since_boot_ns: tuple[int, ...] = ()

    @property
    def reason(self) -> str:
        """Most frequent reason why runs have no value; empty if all have one, or there are no runs."""
        return self.reasons.most_common(1)[0][0] if self.reasons else ""


def read(folder: Path, role: Role, name: str, source: TelemetrySource) -> SourceReadings:
    """Return the readings of a source in an attempt.

    Raises:
        EvidenceError: The file is missing, or cannot be read.
    """
    return parse(_content(folder / file(role, name, source)), source)


def _content(path: Path) -> bytes:
    if not path.is_file() and path.with_name(f"{path.name}.gz").is_file():
        return reading.compressed(path.with_name(f"{path.name}.gz"))
    try:
        return bytes(reading.mapped(path))  # not as text: the sizes in the file are numbers of bytes before decoding
    except EvidenceError as error:
        raise EvidenceError("it was not queried, or its output was not fetched", where=str(path)) from error


def parse(content: bytes, source: TelemetrySource) -> SourceReadings:
    """Return the readings in a file; an incomplete last run, which was being written at the end, is omitted."""
    run_values: list[Values] = []
    since_boot_ns: list[int] = []
    reasons: Counter[str] = Counter()
    runs = position = 0
    while (head := _HEAD.match(content, position)) is not None:
        output = content[head.end() : head.end() + int(head[4])]
        position = head.end() + int(head[4]) + 1
        if position > len(content):
            break
        runs += 1
        reason = _failure_reason(head[3].decode(), output, source)
        if not reason:
            reason, values = _parse_values(source, output.decode(errors="replace"))
            if values:
                run_values.append(values)
                since_boot_ns.append(int(head[1]) * 10**9 + int(head[2]) * _HUNDREDTH_NS)
                continue
        reasons[reason] += 1
    return SourceReadings(tuple(run_values), runs, reasons, tuple(since_boot_ns))


def _failure_reason(code: str, output: bytes, source: TelemetrySource) -> str:
    """Return the reason why a run failed; empty if it succeeded."""
    no_program = f"{source.program} is not installed"
    # 128 + SIGXFSZ, which the limit of the output's size sends, and 128 + SIGKILL, which the time limit sends.
    reasons = {"0": "", "large": _TOO_LONG, "153": _TOO_LONG, "126": no_program, "127": no_program}
    reasons |= {"137": f"no answer in {source.limit:.0f} s"}
    reasons |= {"interface": f"its address {source.address} is reached over the interface under test"}
    if source.http is not None:
        reasons |= _CURL_REASONS
    error_text = printable(output, 120)
    return reasons.get(
        code, f"{source.program} failed with exit code {code}" + (f": {error_text}" if error_text else "")
    )


def _parse_values(source: TelemetrySource, output: str) -> tuple[str, Values]:
    """Return the values in an output, or the reason why there are none."""
    try:
        values = source_outputs.values(source, output)
    except ValueError as error:
        return f"its output {error}", {}
    return ("" if values else "its output has none of the values"), values
