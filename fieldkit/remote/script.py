"""The job script on a robot: installed once per version, and called for all tasks that must outlive a connection."""

import hashlib
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LockLostError, RobotError
from fieldkit.core.units import format_duration
from fieldkit.remote.command import printable
from fieldkit.remote.shell import Completed, Shell

HOME: Final = ".fieldkit"
"""Folder of all files of fieldkit on a robot, below the user's home."""

REPLY_S: Final = 10.0
"""Timeout for the answer of a robot, in addition to the duration of the command."""

_PARTS: Final = (
    "common.sh",
    "leader.sh",
    "lock.sh",
    "snapshot.sh",
    "evidence.sh",
    "telemetry.sh",
    "motion.sh",
    "job.sh",
)
_FOLDER: Final = Path(__file__).parent

SCRIPT: Final = b"\n".join(_FOLDER.joinpath(name).read_bytes() for name in _PARTS)
_SHA256: Final = hashlib.sha256(SCRIPT).hexdigest()
SCRIPT_PATH: Final = f"{HOME}/job-{_SHA256[:12]}.sh"
CALL: Final = ("sh", SCRIPT_PATH)
"""The command that calls the script, without its verb."""

# Other users must not be able to write to the folder, because sudo runs the script as root for captures. A script
# that has another owner or other content is replaced.
_CHECK_SCRIPT: Final = (
    'umask 077 && mkdir -p "$1" && chmod go-rwx "$1" && [ -O "$2" ] && [ ! -L "$2" ] && '
    'actual=$(sha256sum <"$2") && [ "${actual%% *}" = "$3" ] && exec sh "$2" needs'
)
_COPY_SCRIPT: Final = (
    'umask 077 && mkdir -p "$1" && chmod go-rwx "$1" && cat >"$2.$$" && mv "$2.$$" "$2" && exec sh "$2" needs'
)

_MISSING_PROGRAM: Final = b"it lacks "
_INSTALL: Final = "install it: apt-get install util-linux coreutils gawk grep tar, or a full busybox"
_GREETING_BYTES: Final = 60
_READ_ONLY_REMEDY: Final = "on the robot: dmesg | tail; a failing SD card becomes read-only, so save its data"

HELD_REMEDY: Final = "wait, resume that trial if it is yours, or end it: fieldkit abort"
"""Remedy for a locked robot. The holder of the lock may be another trial of the operator whose laptop failed."""

_MESSAGE_PREFIX: Final = b"job.sh: "
_HELD: Final = re.compile(
    r"held (?P<age>-?\d{1,11}) (?P<remaining>-?\d{1,11}) (?P<since>\d{1,11}) (?P<user>\S+) (?P<purpose>.+)", re.ASCII
)
_LOST: Final = re.compile(
    r"(?P<kind>aborted|stopped|held|gone) (?P<since>\d{1,11}) (?P<user>\S+) (?P<purpose>.+)", re.ASCII
)
_LOSS_MESSAGES: Final = {
    "aborted": "the trial was aborted by {user} at {at}",
    "stopped": "{user} stopped the robots at {at} (fieldkit stop)",
    "held": "{user} locked the robot at {at} for {purpose}, after this trial's lock had expired",
    "gone": "the lock of this trial is missing; the last lock was that of {user} at {at} for {purpose}",
}


def install(shell: Shell, deadline: Deadline) -> None:
    """Install the job script on the robot if it is missing there, and check that the robot can run it.

    Raises:
        LinkError: The robot did not answer.
        RobotError: Its home cannot be written, a program is missing, or its login shell prints a greeting.
    """
    check_result = shell.run(
        ("sh", "-c", _CHECK_SCRIPT, "sh", HOME, SCRIPT_PATH, _SHA256), deadline=deadline, check=False
    )
    if check_result.stdout:  # a greeting would be mixed with the output of jobs, and with evidence
        raise RobotError(
            f"its login shell answers every command with {printable(check_result.stdout[:_GREETING_BYTES])!r}",
            where=shell.robot,
            remedy="first line of its start-up file (~/.bashrc) on the robot: case $- in *i*) ;; *) return ;; esac",
        )
    if check_result.exit_code == 0:
        return
    copy_result = shell.run(
        ("sh", "-c", _COPY_SCRIPT, "sh", HOME, SCRIPT_PATH), stdin=SCRIPT, deadline=deadline, check=False
    )
    require_success(
        shell,
        copy_result,
        remedy=_INSTALL if _MISSING_PROGRAM in copy_result.stderr else f"on the robot: touch ~/{HOME}/x; df -h ~",
    )


def call(shell: Shell, verb: str, *words: str, deadline: Deadline) -> bytes:
    """Run a verb of the script that neither starts a job nor waits for one; return its standard output.

    Raises:
        LinkError: The robot did not answer.
        LockLostError: This trial has lost its lock.
        RobotError: The script failed.
    """
    completed = shell.run((*CALL, verb, *words), deadline=deadline, check=False)
    require_success(shell, completed)
    return completed.stdout


def require_success(shell: Shell, completed: Completed, *, remedy: str = "") -> None:
    """Check that a call of the script succeeded. Raises the same errors as `call`."""
    if completed.exit_code == 0:
        return
    # A login shell that refuses the login (nologin) prints its message to either stream.
    output = printable(completed.stderr or completed.stdout) or "no message"
    what = (
        error_message(completed.stderr)
        or f"`{completed.argv[0]}` ended with exit code {completed.exit_code}: {output}"
    )
    match completed.exit_code:
        case 75 if match := _HELD.match(what):  # HELD; the script's exit codes are defined in common.sh
            age, remaining = (format_duration(float(match[name])) for name in ("age", "remaining"))
            holder = f"{match['user']} locked it at {_start_time(match)}, {age} ago, for {match['purpose']}"
            what = f"{holder}; the lock expires in {remaining}"
            remedy = HELD_REMEDY
        case 76 if loss := _LOST.match(what):  # LOST
            raise LockLostError(
                _LOSS_MESSAGES[loss["kind"]].format(at=_start_time(loss), **loss.groupdict()), where=shell.robot
            )
        case 77:  # REBOOTED
            remedy = "check its battery and power supply; on the robot: uptime -s"
        case 28:  # DISK
            remedy = f"find what fills its disk: df -h; du -sh ~/{HOME}/*; then remove old trials and bags"
    default_remedy = _READ_ONLY_REMEDY if "Read-only file system" in what else "run the command on the robot by hand"
    raise RobotError(what, where=shell.robot, remedy=remedy or default_remedy)


def word(text: str) -> str:
    """Return `text` as one word for the record of a lock; characters that are not allowed are replaced by `_`."""
    return re.sub(r"[^A-Za-z0-9._@-]", "_", text)[:80] or "-"


def error_message(stderr: bytes) -> str:
    """Return the error message of the script as one line; empty if standard error contains none."""
    reason, _, log = stderr.partition(_MESSAGE_PREFIX)[2].partition(b"\n")
    return ": ".join(text for text in (printable(reason), printable(log)) if text)


def _start_time(record: re.Match[str]) -> str:
    return f"{datetime.fromtimestamp(int(record['since']), UTC):%H:%M:%S UTC}"
