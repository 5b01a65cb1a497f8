"""Robots simulated on this machine without SSH, with a folder as their home and a userland first in their PATH."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.remote.command import printable
from fieldkit.remote.shell import Completed
from tests.helpers.nightly import mark_nightly

USERLANDS = ("debian", "busybox", "bash")
"""The userlands: dash with coreutils and util-linux; BusyBox alone, with its ash as sh; bash as sh."""
USERLANDS_OF_LONG_TESTS = mark_nightly(USERLANDS, in_ci=("debian", "busybox"))
"""Parameters of a fixture of many tests. In CI, only the tests of locks run the script of jobs with bash."""


def userland_path(userland: str, folder: Path) -> str:
    """Link the programs of a userland in `folder`; return the PATH of a robot that uses them."""
    folder.mkdir(exist_ok=True)
    if userland == "bash":
        link(folder, "sh", "bash")
    if userland == "busybox":
        applets = subprocess.run(("busybox", "--list"), capture_output=True, text=True, check=True).stdout.split()
        for applet in applets:
            link(folder, applet, "busybox")
    return f"{folder}:{os.environ['PATH']}"


def link(folder: Path, name: str, program: str) -> None:
    """Link `name` in `folder` to a program of this machine."""
    target = shutil.which(program)
    assert target is not None
    (folder / name).symlink_to(target)


class LocalSession:
    """A command that runs in the home folder of a simulated robot."""

    def __init__(self, shell: "LocalShell", argv: Sequence[str], until: bytes | None = None) -> None:
        self.shell = shell
        self.argv = tuple(argv)
        environment = os.environ | {"HOME": str(shell.home), "PATH": shell.path}
        # Python would search the PATH of this process, not the robot's.
        program = shutil.which(argv[0], path=shell.path) or argv[0]
        pipe = subprocess.PIPE
        stdin = pipe if until is None else subprocess.DEVNULL
        self.process = subprocess.Popen(
            (program, *argv[1:]), cwd=shell.home, stdin=stdin, stdout=pipe, stderr=pipe, env=environment
        )
        assert self.process.stdout is not None
        self.is_ready = not until or self.process.stdout.readline() == until

    def end(self, *, deadline: Deadline, check: bool = True, stdin: bytes = b"") -> Completed:
        try:
            out, err = self.process.communicate(stdin, timeout=deadline.remaining_s)
        except subprocess.TimeoutExpired as error:
            raise LinkError(f"`{self.argv}` did not end in time", where=self.shell.robot) from error
        if check and self.process.returncode:
            raise RobotError(f"exit code {self.process.returncode}: {printable(err)}", where=self.shell.robot)
        return Completed(self.argv, self.process.returncode, out, err)


class LocalShell:
    """Runs commands in a folder that represents a robot's home."""

    def __init__(self, home: Path, path: str = os.environ["PATH"], robot: str = "here") -> None:
        self.home = home
        self.path = path
        self.robot = robot
        self.ssh_destination = robot
        self.sessions: list[LocalSession] = []

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> LocalSession:
        self.sessions.append(LocalSession(self, argv, until))
        return self.sessions[-1]

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        return self.begin(argv, deadline=deadline).end(deadline=deadline, check=check, stdin=stdin)

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        completed = self.run(argv, deadline=deadline, check=False)
        to.write_bytes(completed.stdout[:limit_bytes])
        if completed.exit_code:
            raise RobotError(f"exit code {completed.exit_code}: {printable(completed.stderr)}", where=self.robot)
        return completed

    def silence(self, seconds: float) -> AbstractContextManager[None]:
        return nullcontext()

    def close(self) -> None:
        """Close the input of all commands, as a closed connection would, and wait until they exit."""
        while self.sessions:
            process = self.sessions.pop().process
            if process.stdin is not None:
                process.stdin.close()
            process.wait(60)
