"""Snapshots of a robot's sources: outputs of programs that report the state of its clock and computer at one time.

`fieldkit/remote/snapshot.sh` runs the command of each source and writes the snapshot. For each source, it contains a
line `==> NAME <==`, the lines of the output, each preceded by a space, and the line ` code CODE`. A source is missing
if the robot does not have its program.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import reading

_NEXT: Final = "\n==> next <==\n"
_HEADER: Final = re.compile(r"==> ([a-z][a-z0-9-]{0,30}) <==", re.ASCII)
_CODE: Final = re.compile(r" code ([0-9]{1,3})", re.ASCII)
_FAILURES: Final = {None: "was interrupted", 137: "did not answer in time", 153: "printed too much"}
"""Failure by exit code. 137 and 153 are 128 plus SIGKILL and SIGXFSZ."""
_NOT_EXECUTABLE: Final = (126, 127)
"""Exit codes of a program that cannot be started. 126 occurs because `command -v` of BusyBox also finds files that
are not executable."""
MAX_SOURCES: Final = 50
"""Maximum number of sources in a snapshot; further sources are ignored."""


@dataclass(frozen=True)
class SourceOutput:
    """Output of one source.

    Attributes:
        text: Standard output and standard error.
        code: Exit code; None if the snapshot was interrupted.
    """

    text: str
    code: int | None

    @property
    def failure(self) -> str | None:
        """The reason why the source has no value, for example `did not answer in time`; None if it succeeded."""
        return None if self.code == 0 else _FAILURES.get(self.code, f"failed with exit code {self.code}")


Snapshot = Mapping[str, SourceOutput]
"""Outputs of a robot's sources by name."""


def before_file(role: Role) -> str:
    """Return the name of the file with a robot's snapshot before an attempt."""
    return f"{role}-sources-before.txt"


def after_file(role: Role) -> str:
    """Return the name of the file with a robot's snapshot after an attempt."""
    return f"{role}-sources-after.txt"


def during_file(role: Role) -> str:
    """Return the name of the file with the reports on a robot's clock during an attempt."""
    return f"{role}-sources-during.txt"


def read(path: Path) -> Snapshot:
    """Return the snapshot in a file.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    return parse(reading.text(path))


def read_series(path: Path) -> tuple[Snapshot, ...]:
    """Return the snapshots in a file that has a line `==> next <==` before each of them.

    The last snapshot is omitted if it was interrupted.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    _, *texts = f"\n{reading.text(path)}".split(_NEXT)
    if texts and not _CODE.fullmatch(texts[-1].rstrip("\n").rpartition("\n")[2]):
        del texts[-1]
    return tuple(map(parse, texts))


def read_attempt(evidence: AttemptEvidence, role: Role) -> tuple[Snapshot, Snapshot]:
    """Return the snapshots of a robot before and after an attempt. A missing snapshot is empty."""
    before, after = (evidence.read_or_none(read, file(role)) or {} for file in (before_file, after_file))
    return before, after


def parse(text: str) -> Snapshot:
    """Return the outputs in the text of a snapshot. If a source occurs several times, the first output is used."""
    outputs: dict[str, SourceOutput] = {}
    name, lines = "", list[str]()

    def store_output() -> None:
        code = _CODE.fullmatch(lines[-1]) if lines else None
        is_missing = code is not None and int(code[1]) in _NOT_EXECUTABLE
        if name and name not in outputs and len(outputs) < MAX_SOURCES and not is_missing:
            body = "\n".join(line.removeprefix(" ") for line in lines[: -1 if code else None])
            outputs[name] = SourceOutput(body.strip("\n"), int(code[1]) if code else None)

    for line in text.split("\n"):
        if header := _HEADER.fullmatch(line):
            store_output()
            name, lines = header[1], []
        elif line.startswith(" "):
            lines.append(line)
    store_output()
    return outputs
