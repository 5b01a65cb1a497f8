"""Copy programs from this computer to a robot, into the folder of an attempt; they are deleted with it."""

from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.remote.script import HOME, REPLY_S, require_success
from fieldkit.remote.shell import Shell

_MIN_BYTES_PER_S: Final = 14_000.0
"""Minimum rate of a usable link, the same as for evidence."""

# $1 folder of the program, $2 its name, $3 its mode, $4 its SHA-256. Folders whose name begins with a dot are not
# evidence, so that the program is not fetched.
_COPY_SCRIPT: Final = (
    'umask 077 && mkdir -p "$1" && cat >"$1/$2.$$" && actual=$(sha256sum <"$1/$2.$$") && '
    '{ [ "${actual%% *}" = "$4" ] || { echo "the copy is incomplete: $1/$2" >&2; exit 1; }; } && '
    'chmod "$3" "$1/$2.$$" && mv -f "$1/$2.$$" "$1/$2"'
)


def path(job: str, name: str) -> str:
    """Return the path of a program for a job, relative to the folder of the attempt.

    Args:
        job: Name of the job that runs it; each job has a separate folder.
        name: Name of the file.
    """
    return f".put/{job}/{name}"


def copy(shell: Shell, folder: str, program_path: str, content: bytes, sha256: str, *, executable: bool) -> None:
    """Copy a program into the folder of an attempt; idempotent.

    Args:
        shell: The robot.
        folder: The attempt's folder on the robot.
        program_path: The path of the program, from `path`.
        content: The program.
        sha256: Its SHA-256, which the robot checks.
        executable: Whether the copy may be executed.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The program cannot be written to the folder, or the copy is incomplete.
    """
    program_folder, _, name = program_path.rpartition("/")
    argv = (
        "sh",
        "-c",
        _COPY_SCRIPT,
        "sh",
        f"{folder}/{program_folder}",
        name,
        "700" if executable else "600",
        sha256,
    )
    deadline = Deadline.after(2 * REPLY_S + len(content) / _MIN_BYTES_PER_S)
    copy_result = shell.run(argv, stdin=content, deadline=deadline, check=False)
    require_success(shell, copy_result, remedy=f"on the robot: touch ~/{HOME}/x; df -h ~")
