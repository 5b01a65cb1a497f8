"""Robots in tests: run programs on them, copy files, read the state of their links."""

import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from fieldkit.backends.protocols import Cast, Robot, Testbed
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, LinkLostError, did_you_mean
from fieldkit.core.model import LinkSample, Role
from fieldkit.core.text import sanitized
from fieldkit.measure.evidence import robot_link_samples
from fieldkit.remote.command import quote, with_environment
from fieldkit.remote.shell import Completed, Shell

# The program replaces the inner shell (`exec`), so it has the process ID to which the signals are sent. SIGINT, as by
# Ctrl-C, is sent when standard input is closed, also if this process was killed. The outer shell returns an exit code
# even if a signal terminates the program.
_UNTIL_CLOSED: Final = (
    'exec 3<&0; { cat <&3 >/dev/null; kill -INT "$$"; sleep 2; kill -TERM "$$"; sleep 2; kill -KILL "$$"; } '
    '>/dev/null 2>&1 & exec "$@" 3<&- </dev/null'
)
_RUNNING: Final = ("sh", "-c", 'sh -c "$@"; exit "$?"', "sh", _UNTIL_CLOSED, "sh")


class ProgramError(AssertionError):
    """A program on a robot did not do what the test requires: the test fails, but the lab works."""


@dataclass(frozen=True)
class ProgramOutput:
    """The result of a program on a robot.

    Attributes:
        argv: The program with its arguments.
        exit_code: Its exit code.
        stdout: Its output; bytes that are not UTF-8 are replaced.
        stderr: Its output on standard error.
    """

    argv: tuple[str, ...]
    exit_code: int
    stdout: str
    stderr: str


class RunningProgram:
    """A program that runs on a robot.

    Attributes:
        output: Its result after it has exited, None before.
    """

    def __init__(self) -> None:
        self.output: ProgramOutput | None = None


def until_closed(argv: Sequence[str]) -> tuple[str, ...]:
    """Return the command that runs a program until the command's standard input is closed.

    The program then receives SIGINT, and SIGTERM and SIGKILL two and four seconds later if it continues.
    """
    return (*_RUNNING, *argv)


TIMEOUT_S: Final = 30.0
FILE_BYTES: Final = 1 << 30
"""Default limit for the size of a fetched file."""

_EXIT_TIMEOUT_S: Final = 10.0
_MAX_SHOWN_CHARACTERS: Final = 2000
# Replaces the file atomically: it is complete or unchanged.
_PUT: Final = (
    'mkdir -p "$(dirname "$1")" && cat >"$1.$$" && [ "$(wc -c <"$1.$$")" -eq "$2" ] && chmod "$3" "$1.$$" '
    '&& mv "$1.$$" "$1"'
)


class OpenedRobots(Protocol):
    """The opened robots of a lab. Its properties raise the errors of `OpenedLab.open`."""

    @property
    def testbed(self) -> Testbed:
        """The robots."""
        ...

    @property
    def cast(self) -> Cast:
        """The robot in each role."""
        ...

    def log(self, text: str) -> None:
        """Add a line to the log of the evidence."""
        ...


class RobotHandle:
    """An open robot.

    Args:
        role: Its role.
        lab: Its lab.
    """

    def __init__(self, role: Role, lab: OpenedRobots) -> None:
        self.role = role
        self._lab = lab

    def __repr__(self) -> str:
        return f"<robot {self.name}, {self.role}>"

    @property
    def name(self) -> str:
        """Its name in the lab."""
        return self._robot.name

    @property
    def address(self) -> str:
        """Its IPv4 address on the radio under test."""
        return self._robot.address

    @property
    def profile(self) -> str:
        """Name of its profile."""
        return self._robot.profile.name

    def run(
        self,
        argv: Sequence[str],
        timeout: float = TIMEOUT_S,
        *,
        check: bool = True,
        stdin: str | bytes = b"",
        ros: bool = False,
    ) -> ProgramOutput:
        """Run a program and wait until it exits.

        If the connection is lost, it is opened again and the program is run again from its start. Do not use
        it for programs that must not run twice.

        Args:
            argv: The program with its arguments; they are not interpreted by a shell.
            timeout: Seconds after which the test fails.
            check: Whether the test fails if the exit code is not 0.
            stdin: Content of its standard input.
            ros: Whether it runs in the ROS environment of the robot's profile.

        Raises:
            ProgramError: It did not exit in time, or its exit code is not 0 and `check` is set.
            LinkError: The robot could not be reached.
            RobotError: A signal terminated it, or its output is too long.
        """
        __tracebackhide__ = True
        content = stdin.encode() if isinstance(stdin, str) else stdin
        command, shell = self._command(argv, ros=ros), self._shell
        return self._result(
            argv,
            lambda: shell.run(command, deadline=Deadline.after(timeout), stdin=content, check=False),
            check=check,
        )

    @contextmanager
    def running(self, argv: Sequence[str], *, ros: bool = False) -> Iterator[RunningProgram]:
        """Run a program while the body runs, then stop it with SIGINT, and if needed with SIGTERM and SIGKILL.

        It is also stopped if this process or the connection to the robot ends.

        Args:
            argv: The program with its arguments.
            ros: Whether it runs in the ROS environment of the robot's profile.

        Raises:
            ProgramError: It did not exit, not even after SIGKILL.
            LinkError: The robot could not be reached.
        """
        command = until_closed(self._command(argv, ros=ros))
        session = self._shell.begin(command, deadline=Deadline.after(TIMEOUT_S))
        self._lab.log(f"{self.name} & {quote(argv)}")
        program = RunningProgram()
        try:
            yield program
        finally:
            program.output = self._result(
                argv, lambda: session.end(deadline=Deadline.after(_EXIT_TIMEOUT_S), check=False)
            )

    def put(self, local: str | Path, remote: str) -> None:
        """Copy a file with its mode to the robot; missing folders are created.

        Args:
            local: The local file.
            remote: Its path on the robot, absolute or relative to the home folder of the login user.

        Raises:
            ConfigurationError: The file cannot be read.
            LinkError: The robot could not be reached.
            RobotError: The file cannot be written on the robot.
        """
        source = Path(local)
        try:
            content, mode = source.read_bytes(), source.stat().st_mode & 0o777
        except OSError as error:
            raise ConfigurationError(
                f"cannot be read: {error.strerror}", where=str(source), remedy="give the path of a readable file"
            ) from error
        command = ("sh", "-c", _PUT, "sh", remote, str(len(content)), f"{mode:o}")
        self._shell.run(command, deadline=Deadline.after(_seconds_for(len(content))), stdin=content)
        self._lab.log(f"{self.name} < {source} to {remote}")

    def get(self, remote: str, local: str | Path, *, limit_bytes: int = FILE_BYTES) -> Path:
        """Copy a file from the robot; return its local path.

        Args:
            remote: Its path on the robot, absolute or relative to the home folder of the login user.
            local: Local path; if it is an existing folder, the file keeps its name.
            limit_bytes: Maximum size.

        Raises:
            LinkError: The robot could not be reached.
            RobotError: The file cannot be read on the robot, or is larger.
        """
        path = Path(local)
        path = path / Path(remote).name if path.is_dir() else path
        deadline = Deadline.after(_seconds_for(limit_bytes))
        self._shell.fetch(("cat", "--", remote), path, deadline=deadline, limit_bytes=limit_bytes)
        self._lab.log(f"{self.name} > {remote} to {path}")
        return path

    def link(self) -> LinkSample:
        """Return the current state of its radio's links: signal, rates, counters per station.

        On a real robot this is the output of `iw`; without `iw` there are no stations.

        Raises:
            LinkError: The robot, or the process of the modelled radio, did not answer.
        """
        radio_model = self._lab.testbed.oracle  # the source of exact data about a modelled radio
        if radio_model is not None:
            return radio_model.links(continue_sampling=False)[self.role][-1]
        command = ("iw", "dev", self._robot.profile.radio.interface, "station", "dump")
        result = self._shell.run(command, deadline=Deadline.after(TIMEOUT_S), check=False)
        return LinkSample(time.time_ns(), robot_link_samples.parse_stations(result.stdout.decode(errors="replace")))

    @property
    def _robot(self) -> Robot:
        robots_by_role = self._lab.cast
        if self.role not in robots_by_role:
            raise ConfigurationError(
                f"no robot has the role {self.role} any more: a trial opened the robots with another topology",
                remedy="run trials with the topology of the lab",
            )
        return robots_by_role[self.role]

    @property
    def _shell(self) -> Shell:
        return self._lab.testbed.shells[self.role]

    def _command(self, argv: Sequence[str], *, ros: bool) -> tuple[str, ...]:
        if isinstance(argv, str):
            raise ConfigurationError(
                f"{argv!r} is one word; a program and its arguments are a list",
                where=self.name,
                remedy=f"write {shlex.split(argv)!r}",
            )
        if not ros:
            return tuple(argv)
        ros_profile = self._robot.profile.ros
        if ros_profile is None:
            raise ConfigurationError(
                f"its profile {self.profile} has no section ros:", where=self.name, remedy="remove ros=True"
            )
        return with_environment(argv, setup=ros_profile.command.setup, environment=ros_profile.environment)

    def _result(self, argv: Sequence[str], wait: Callable[[], Completed], *, check: bool = False) -> ProgramOutput:
        """Return the result of a program; a timeout is a test failure, not a robot error.

        Raises:
            ProgramError: The program did not exit in time, or its exit code is not 0 and `check` is set.
            LinkLostError: The connection broke.
        """
        __tracebackhide__ = True
        command_text = f"{self.name} $ {quote(argv)}"
        try:
            result = wait()
        except LinkLostError:
            raise
        except LinkError as error:
            self._lab.log(f"{command_text}\n{error.what}")
            raise ProgramError(f"{self.name}: {error.what}") from None
        out, err = (text.decode(errors="replace") for text in (result.stdout, result.stderr))
        self._lab.log(f"{command_text}\n{out}{err}exit code {result.exit_code}")
        if check and result.exit_code != 0:
            excerpt = sanitized((err or out).strip())[-_MAX_SHOWN_CHARACTERS:] or "it printed nothing"
            raise ProgramError(f"{self.name}: `{quote(argv)}` exited with code {result.exit_code}: {excerpt}")
        return ProgramOutput(tuple(argv), result.exit_code, out, err)


class RobotHandles:
    """The robots of a lab, by role and by name: `robots.sender`, `robots["turtlebot-1"]`.

    Args:
        lab: The lab.
    """

    def __init__(self, lab: OpenedRobots) -> None:
        self._lab = lab

    def __repr__(self) -> str:
        return f"<robots {', '.join(f'{robot.role}: {robot.name}' for robot in self)}>"

    def __getitem__(self, name: str) -> RobotHandle:
        """Return a robot by its role or its name.

        Raises:
            ConfigurationError: There is no such robot.
        """
        robots_by_role = self._lab.cast
        for role, robot in robots_by_role.items():
            if name in {role, robot.name}:
                return RobotHandle(role, self._lab)
        names = [*robots_by_role, *(robot.name for robot in robots_by_role.values())]
        raise ConfigurationError(
            f"there is no robot {name!r} in this lab",
            remedy=did_you_mean(name, names, f"its robots: {', '.join(names)}"),
        )

    def __getattr__(self, name: str) -> RobotHandle:
        """Return a robot by its role, or by a name that is a Python identifier."""
        if name.startswith("_"):
            raise AttributeError(name)
        return self[name]

    def __iter__(self) -> Iterator[RobotHandle]:
        """Yield every robot, in the order of roles."""
        return (self[role] for role in self._lab.cast)

    def __len__(self) -> int:
        """Return the number of robots."""
        return len(self._lab.cast)


def _seconds_for(size_bytes: int) -> float:
    """Return the time limit for copying a file, which assumes at least 100 kB/s."""
    return TIMEOUT_S + size_bytes / 1e5
