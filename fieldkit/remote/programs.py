"""Programs of the lab on a robot: copied into the folder of an attempt, and deleted with it."""

from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.remote.script import HOME, REPLY_S, demand
from fieldkit.remote.shell import Shell

_SLOWEST_BYTES_PER_S: Final = 14_000.0
"""As for evidence: a link that carries less is of no use."""

# $1 folder of the program, $2 its name, $3 its mode, $4 its SHA-256. A name that begins with a dot is not evidence,
# so that it is not fetched.
_PLACE: Final = (
    'umask 077 && mkdir -p "$1" && cat >"$1/$2.$$" && said=$(sha256sum <"$1/$2.$$") && '
    '{ [ "${said%% *}" = "$4" ] || { echo "the copy is not whole: $1/$2" >&2; exit 1; }; } && '
    'chmod "$3" "$1/$2.$$" && mv -f "$1/$2.$$" "$1/$2"'
)


def path(job: str, name: str) -> str:
    """Return where a program is for a job, seen from the folder of its attempt.

    Args:
        job: Name of the job that runs it; each has a folder of its own.
        name: Name of the file.
    """
    return f".put/{job}/{name}"


def place(shell: Shell, folder: str, at: str, content: bytes, sha256: str, *, executable: bool) -> None:
    """Copy a program into the folder of an attempt; repeated, it changes nothing.

    Args:
        shell: The robot.
        folder: The attempt's folder on the robot.
        at: From `path`.
        content: The program.
        sha256: Its SHA-256, which the robot checks.
        executable: Whether the copy may be executed.

    Raises:
        LinkError: The robot did not answer.
        RobotError: It cannot be written there.
    """
    inside, _, name = at.rpartition("/")
    argv = ("sh", "-c", _PLACE, "sh", f"{folder}/{inside}", name, "700" if executable else "600", sha256)
    deadline = Deadline.after(2 * REPLY_S + len(content) / _SLOWEST_BYTES_PER_S)
    placed = shell.run(argv, stdin=content, deadline=deadline, check=False)
    demand(shell, placed, remedy=f"on the robot: touch ~/{HOME}/x; df -h ~")
