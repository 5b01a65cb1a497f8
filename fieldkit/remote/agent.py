"""Build the agent (`fieldkit.agent`) as one file, and install each version once on a robot."""

import hashlib
import io
from functools import cache
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.remote.script import HOME, require_success
from fieldkit.remote.shell import Shell

_INSTALL_S: Final = 30.0
"""Timeout of the copy: about 310 kB over a radio that may be slow."""

_ROOT: Final = Path(__file__).parents[1]
_FILE_TIME: Final = (1980, 1, 1, 0, 0, 0)
"""Modification time of all files in the archive, so that it depends only on their content."""
_CHECK_SCRIPT: Final = '[ -O "$1" ] && [ ! -L "$1" ] && actual=$(sha256sum <"$1") && [ "${actual%% *}" = "$2" ]'
_COPY_SCRIPT: Final = 'umask 077 && cat >"$1.$$" && mv "$1.$$" "$1"'
_START: Final = "import sys\nfrom fieldkit.agent.__main__ import main\nsys.exit(main(sys.argv[1:]))\n"


@cache
def content() -> bytes:
    """Return the agent as a zip archive that Python runs. The bytes are the same for the same modules."""
    import zipfile  # noqa: PLC0415 (takes 10 ms, and few commands need it)

    content_by_name = {"__main__.py": _START.encode(), "fieldkit/__init__.py": b""}
    for path in sorted((_ROOT / "agent").rglob("*.py")):
        content_by_name[f"fieldkit/{path.relative_to(_ROOT).as_posix()}"] = path.read_bytes()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in content_by_name.items():
            archive.writestr(zipfile.ZipInfo(name, _FILE_TIME), data)
    return buffer.getvalue()


def _sha256() -> str:
    return hashlib.sha256(content()).hexdigest()


def path_from_job() -> str:
    """Return the path of the agent for a job, relative to the folder of its attempt (`jobs.work_folder`)."""
    return f"../../{_file_name()}"


def path_from_home() -> str:
    """Return the path of the agent for a command that is not a job, relative to the user's home."""
    return f"{HOME}/{_file_name()}"


def _file_name() -> str:
    return f"agent-{_sha256()[:12]}.pyz"


def install(shell: Shell) -> None:
    """Copy the agent to the robot if it is missing there.

    The job script must be installed before, because its installation creates the folder of the agent.

    Raises:
        LinkError: The robot did not answer.
        RobotError: Its home cannot be written.
    """
    path, deadline = path_from_home(), Deadline.after(_INSTALL_S)
    check_result = shell.run(("sh", "-c", _CHECK_SCRIPT, "sh", path, _sha256()), deadline=deadline, check=False)
    if check_result.exit_code != 0:
        copy_result = shell.run(
            ("sh", "-c", _COPY_SCRIPT, "sh", path), stdin=content(), deadline=deadline, check=False
        )
        require_success(shell, copy_result, remedy=f"on the robot: touch ~/{HOME}/x; df -h ~")
