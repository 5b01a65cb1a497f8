"""Read the state of a robot with one script, in a single round trip."""

import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.remote.command import quote
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import CommandResult
from fieldkit.trial.check import tools

# All commands except the detection of tools have 20 s in total. A command can hang, for example df on a network drive
# that cannot be reached.
PROBE_S: Final = 20.0 + tools.PROBE_S

_SCRIPT: Final = resources.files("fieldkit.trial.check").joinpath("probe.sh").read_text(encoding="ascii")
_HEAD: Final = re.compile(r"^==> (.+): ([0-9]{1,3}) <==$", re.MULTILINE)

Sections = Mapping[str, CommandResult]
"""Results of the probe's commands, by section name. Each command writes one section of the probe's output."""

MISSING_SECTION: Final = CommandResult(text="", code=CommandResult.MISSING)
"""Result of a section that the robot did not send."""


def run_probe(shell: Shell, interface: str, commands: Mapping[str, Sequence[str]]) -> Sections:
    """Run the probe on a robot.

    Args:
        shell: The robot.
        interface: Interface under test.
        commands: Further commands, by section name.

    Raises:
        LinkError: The robot did not answer within `PROBE_S`.
        RobotError: The probe wrote too much output.
    """
    completed = shell.run(
        ("sh", "-s", interface), stdin=script(commands).encode(), deadline=Deadline.after(PROBE_S), check=False
    )
    return parse(completed.stdout.decode(errors="replace"))


def script(commands: Mapping[str, Sequence[str]]) -> str:
    """Return the probe as one shell script."""
    return _SCRIPT + "".join(f"{quote(('section', name, *argv))}\n" for name, argv in commands.items())


def parse(text: str) -> Sections:
    """Return the sections of a probe's output. If several sections have the same name, the first is used."""
    sections: dict[str, CommandResult] = {}
    parts = _HEAD.split(text)[1:]
    for name, code, section_text in zip(parts[::3], parts[1::3], parts[2::3], strict=True):
        sections.setdefault(name, CommandResult(section_text.strip("\n"), int(code)))
    return sections
