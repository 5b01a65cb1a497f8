"""The job script on a robot: put there once per version, called for everything that must survive a connection."""

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
"""Folder of everything that fieldkit keeps on a robot, below the user's home."""

REPLY_S: Final = 10.0
"""How long the robot may take for its part of a command besides the command itself."""

_PARTS: Final = ("common.sh", "leader.sh", "lock.sh", "evidence.sh", "telemetry.sh", "motion.sh", "job.sh")
_FOLDER: Final = Path(__file__).parent

SCRIPT: Final = b"\n".join(_FOLDER.joinpath(name).read_bytes() for name in _PARTS)
_SHA256: Final = hashlib.sha256(SCRIPT).hexdigest()
SCRIPT_PATH: Final = f"{HOME}/job-{_SHA256[:12]}.sh"
CALL: Final = ("sh", SCRIPT_PATH)
"""How the script is called, before its verb."""

# Nobody else may write there, whoever made it: a capture by sudo runs the script as root. Where somebody could, a
# script that is not ours, or not whole, is replaced.
_LOOK: Final = (
    'umask 077 && mkdir -p "$1" && chmod go-rwx "$1" && [ -O "$2" ] && [ ! -L "$2" ] && '
    'said=$(sha256sum <"$2") && [ "${said%% *}" = "$3" ] && exec sh "$2" needs'
)
_PLACE: Final = (
    'umask 077 && mkdir -p "$1" && chmod go-rwx "$1" && cat >"$2.$$" && mv "$2.$$" "$2" && exec sh "$2" needs'
)

_LACKS: Final = b"it lacks "
_INSTALL: Final = "install it: apt-get install util-linux coreutils gawk grep tar, or a whole busybox"
_GREETING_BYTES: Final = 60
_MOUNTED: Final = "on the robot: dmesg | tail; a card that fails turns read-only, so save what it has"

HELD_REMEDY: Final = "wait, go on with it if it is yours, or end it: fieldkit abort"
"""What to do about a robot that somebody holds; one's own trial holds it too, when its laptop died."""

_SAYS: Final = b"job.sh: "
_HELD: Final = re.compile(
    r"held (?P<age>-?\d{1,11}) (?P<rest>-?\d{1,11}) (?P<since>\d{1,11}) (?P<who>\S+) (?P<what>.+)", re.ASCII
)
_LOST: Final = re.compile(
    r"(?P<kind>aborted|stopped|held|gone) (?P<since>\d{1,11}) (?P<who>\S+) (?P<what>.+)", re.ASCII
)
_WHY_LOST: Final = {
    "aborted": "the trial was aborted by {who} at {at}",
    "stopped": "{who} stopped the robots at {at} (fieldkit stop)",
    "held": "{who} took the robot at {at} for {what}, after this trial's lock had expired",
    "gone": "the lock of this trial is gone; the last to hold the robot was {who} at {at} for {what}",
}


def install(shell: Shell, deadline: Deadline) -> None:
    """Put the job script on the robot where it is not there yet, and see that the robot can run it.

    Raises:
        LinkError: The robot did not answer.
        RobotError: Its home cannot be written, it lacks a program, or its login shell greets commands.
    """
    looked = shell.run(("sh", "-c", _LOOK, "sh", HOME, SCRIPT_PATH, _SHA256), deadline=deadline, check=False)
    if looked.stdout:  # it would be taken for what a job says, and for evidence
        raise RobotError(
            f"its login shell answers every command with {printable(looked.stdout[:_GREETING_BYTES])!r}",
            where=shell.robot,
            remedy="first line of ~/.bashrc (or its like) on the robot: case $- in *i*) ;; *) return ;; esac",
        )
    if looked.exit_code == 0:
        return
    placed = shell.run(("sh", "-c", _PLACE, "sh", HOME, SCRIPT_PATH), stdin=SCRIPT, deadline=deadline, check=False)
    demand(shell, placed, remedy=_INSTALL if _LACKS in placed.stderr else f"on the robot: touch ~/{HOME}/x; df -h ~")


def call(shell: Shell, verb: str, *words: str, deadline: Deadline) -> bytes:
    """Run a verb of the script that starts and waits for no job; return what it printed.

    Raises:
        LinkError: The robot did not answer.
        LockLostError: The lock of this trial is not ours any more.
        RobotError: The script failed.
    """
    done = shell.run((*CALL, verb, *words), deadline=deadline, check=False)
    demand(shell, done)
    return done.stdout


def demand(shell: Shell, done: Completed, *, remedy: str = "") -> None:
    """Raise what a failed call of the script means: as `call`."""
    if done.exit_code == 0:
        return
    # A login shell that lets nobody in says so on either stream.
    said = printable(done.stderr or done.stdout) or "no message"
    what = complaint(done.stderr) or f"`{done.argv[0]}` ended with exit code {done.exit_code}: {said}"
    match done.exit_code:
        case 75 if held := _HELD.match(what):  # codes of the script's own, see common.sh
            age, rest = (format_duration(float(held[name])) for name in ("age", "rest"))
            what = f"{held['who']} holds it since {_moment(held)}, {age} ago, for {held['what']}; expires in {rest}"
            remedy = HELD_REMEDY
        case 76 if lost := _LOST.match(what):
            raise LockLostError(
                _WHY_LOST[lost["kind"]].format(at=_moment(lost), **lost.groupdict()), where=shell.robot
            )
        case 77:
            remedy = "see to its battery and supply; on the robot: uptime -s"
        case 28:
            remedy = f"see what fills its disk: df -h; du -sh ~/{HOME}/*; then remove old trials and bags"
    by_hand = _MOUNTED if "Read-only file system" in what else "run the command on the robot by hand"
    raise RobotError(what, where=shell.robot, remedy=remedy or by_hand)


def word(text: str) -> str:
    """Return `text` as one word that a lock's record can hold."""
    return re.sub(r"[^A-Za-z0-9._@-]", "_", text)[:80] or "-"


def complaint(stderr: bytes) -> str:
    """Return what the script says about its own failure as one line; empty where only a job spoke, or nothing."""
    reason, _, log = stderr.partition(_SAYS)[2].partition(b"\n")
    return ": ".join(text for text in (printable(reason), printable(log)) if text)


def _moment(record: re.Match[str]) -> str:
    return f"{datetime.fromtimestamp(int(record['since']), UTC):%H:%M:%S UTC}"
