"""The agent on a robot (`fieldkit.agent`): one file, made here, put there once per version."""

import hashlib
import io
from functools import cache
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.remote.script import HOME, demand
from fieldkit.remote.shell import Shell

_INSTALL_S: Final = 30.0
"""Some 140 kB, over a radio that may be slow."""

_ROOT: Final = Path(__file__).parents[1]
_EPOCH: Final = (1980, 1, 1, 0, 0, 0)
_LOOK: Final = '[ -O "$1" ] && [ ! -L "$1" ] && said=$(sha256sum <"$1") && [ "${said%% *}" = "$2" ]'
_PLACE: Final = 'umask 077 && cat >"$1.$$" && mv "$1.$$" "$1"'
_START: Final = "import sys\nfrom fieldkit.agent.__main__ import main\nsys.exit(main(sys.argv[1:]))\n"


@cache
def content() -> bytes:
    """Return the agent as a zip archive that Python runs; the same bytes for the same modules."""
    import zipfile  # noqa: PLC0415 (10 ms, and only topics need it)

    parts = {"__main__.py": _START.encode(), "fieldkit/__init__.py": b""}
    for path in sorted((_ROOT / "agent").rglob("*.py")):
        parts[f"fieldkit/{path.relative_to(_ROOT).as_posix()}"] = path.read_bytes()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, text in parts.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), text)
    return packed.getvalue()


def _sha256() -> str:
    return hashlib.sha256(content()).hexdigest()


def path_from_job() -> str:
    """Return where the agent lies as a job finds it, from an attempt's folder in a trial's (`jobs.work_folder`)."""
    return f"../../{_name()}"


def path_from_home() -> str:
    """Return where it lies as a command finds it that is no job."""
    return f"{HOME}/{_name()}"


def _name() -> str:
    return f"agent-{_sha256()[:12]}.pyz"


def install(shell: Shell) -> None:
    """Put the agent on the robot where it is not there yet; the job script has made its folder.

    Raises:
        LinkError: The robot did not answer.
        RobotError: Its home cannot be written.
    """
    path, deadline = path_from_home(), Deadline.after(_INSTALL_S)
    looked = shell.run(("sh", "-c", _LOOK, "sh", path, _sha256()), deadline=deadline, check=False)
    if looked.exit_code != 0:
        placed = shell.run(("sh", "-c", _PLACE, "sh", path), stdin=content(), deadline=deadline, check=False)
        demand(shell, placed, remedy=f"on the robot: touch ~/{HOME}/x; df -h ~")
