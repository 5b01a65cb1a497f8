"""Robots in a test's hand: run programs on them, copy files, look at their links."""

import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Protocol

from fieldkit.backends.protocols import Cast, Robot, Testbed
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, LinkLostError, nearest
from fieldkit.core.model import LinkSample, Role
from fieldkit.core.text import harmless
from fieldkit.measure.evidence import iw
from fieldkit.pytest.programs import ProgramError, ProgramOutput, RunningProgram, until_closed
from fieldkit.remote.command import quote, with_environment
from fieldkit.remote.shell import Completed, Shell

TIMEOUT_S: Final = 30.0
FILE_BYTES: Final = 1 << 30
"""The largest file that is fetched, unless more is asked for."""

_END_S: Final = 10.0
_SHOWN: Final = 2000
# The file is there whole, or as it was.
_PUT: Final = (
    'mkdir -p "$(dirname "$1")" && cat >"$1.$$" && [ "$(wc -c <"$1.$$")" -eq "$2" ] && chmod "$3" "$1.$$" '
    '&& mv "$1.$$" "$1"'
)


class RobotsUp(Protocol):
    """Robots that are up, as a lab has them; what they return raises as `OpenedLab.open`."""

    @property
    def testbed(self) -> Testbed:
        """The robots."""
        ...

    @property
    def cast(self) -> Cast:
        """Who plays which role."""
        ...

    def tell(self, text: str) -> None:
        """Add a line to the evidence."""
        ...


class RobotHandle:
    """A robot that is up.

    Args:
        role: What it plays.
        lab: Its lab.
    """

    def __init__(self, role: Role, lab: RobotsUp) -> None:
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
        """Run a program and wait for its end.

        When the connection is lost it is made again, and the program run again from its start: run none twice that
        must not be.

        Args:
            argv: The program with its arguments; no shell sees them.
            timeout: Seconds after which the test fails.
            check: Whether another exit code than 0 fails the test.
            stdin: What it reads.
            ros: Whether it runs in the robot's ROS environment, as its profile says.

        Raises:
            ProgramError: It did not end in time, or with another exit code.
            LinkError: The robot could not be reached.
        """
        __tracebackhide__ = True
        given = stdin.encode() if isinstance(stdin, str) else stdin
        command, shell = self._command(argv, ros=ros), self._shell
        return self._ended(
            argv, lambda: shell.run(command, deadline=Deadline.after(timeout), stdin=given, check=False), check=check
        )

    @contextmanager
    def running(self, argv: Sequence[str], *, ros: bool = False) -> "Iterator[RunningProgram]":
        """Let a program run while the body does, then end it as Ctrl-C does, if need be by SIGTERM and SIGKILL.

        It ends also when this process does, or the connection to the robot.

        Args:
            argv: As `run`.
            ros: As `run`.

        Raises:
            LinkError: The robot could not be reached.
        """
        command = until_closed(self._command(argv, ros=ros))
        session = self._shell.begin(command, deadline=Deadline.after(TIMEOUT_S))
        self._lab.tell(f"{self.name} & {quote(argv)}")
        program = RunningProgram()
        try:
            yield program
        finally:
            program.output = self._ended(argv, lambda: session.end(deadline=Deadline.after(_END_S), check=False))

    def put(self, local: str | Path, remote: str) -> None:
        """Copy a file to the robot, with its mode; folders that are missing are made.

        Args:
            local: The file here.
            remote: Its path there, below the home of the login user where it does not begin with a slash.

        Raises:
            ConfigurationError: The file cannot be read.
            LinkError: The robot could not be reached.
            RobotError: It cannot be written there.
        """
        source = Path(local)
        try:
            content, mode = source.read_bytes(), source.stat().st_mode & 0o777
        except OSError as error:
            raise ConfigurationError(
                f"cannot be read: {error.strerror}", where=str(source), remedy="name a file that is there"
            ) from error
        command = ("sh", "-c", _PUT, "sh", remote, str(len(content)), f"{mode:o}")
        self._shell.run(command, deadline=Deadline.after(_seconds_for(len(content))), stdin=content)
        self._lab.tell(f"{self.name} < {source} to {remote}")

    def get(self, remote: str, local: str | Path, *, limit_bytes: int = FILE_BYTES) -> Path:
        """Copy a file from the robot; return where it is.

        Args:
            remote: Its path there, as in `put`.
            local: Where it goes; into a folder that is there under its own name.
            limit_bytes: The most that is taken.

        Raises:
            LinkError: The robot could not be reached.
            RobotError: It cannot be read there, or is larger.
        """
        to = Path(local)
        to = to / Path(remote).name if to.is_dir() else to
        deadline = Deadline.after(_seconds_for(limit_bytes))
        self._shell.fetch(("cat", "--", remote), to, deadline=deadline, limit_bytes=limit_bytes)
        self._lab.tell(f"{self.name} > {remote} to {to}")
        return to

    def link(self) -> LinkSample:
        """Return what its radio tells of its links now: signal, rates, counters per station.

        On a real robot that is what `iw` says; without `iw` there are no stations.

        Raises:
            LinkError: The robot, or the modelled radio, did not answer.
        """
        testbed = self._lab.testbed
        if testbed.oracle is not None:
            return testbed.oracle.links(go_on=False)[self.role][-1]
        command = ("iw", "dev", self._robot.profile.radio.interface, "station", "dump")
        done = self._shell.run(command, deadline=Deadline.after(TIMEOUT_S), check=False)
        return LinkSample(time.time_ns(), iw.stations(done.stdout.decode(errors="replace")))

    @property
    def _robot(self) -> Robot:
        cast = self._lab.cast
        if self.role not in cast:
            raise ConfigurationError(
                f"nobody plays {self.role} any more: other robots were brought up",
                remedy="ask for topology= in trials as the lab has it",
            )
        return cast[self.role]

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
        has = self._robot.profile.ros
        if has is None:
            raise ConfigurationError(
                f"its profile {self.profile} has no ros:", where=self.name, remedy="leave ros=True out"
            )
        return with_environment(argv, setup=has.command.setup, environment=has.environment)

    def _ended(self, argv: Sequence[str], wait: Callable[[], Completed], *, check: bool = False) -> ProgramOutput:
        """Return what became of a program; that it takes too long is the test's matter, and not the robot's."""
        __tracebackhide__ = True
        words = f"{self.name} $ {quote(argv)}"
        try:
            done = wait()
        except LinkLostError:
            raise
        except LinkError as error:
            self._lab.tell(f"{words}\n{error.what}")
            raise ProgramError(f"{self.name}: {error.what}") from None
        out, err = (text.decode(errors="replace") for text in (done.stdout, done.stderr))
        self._lab.tell(f"{words}\n{out}{err}exit code {done.exit_code}")
        if check and done.exit_code != 0:
            said = harmless((err or out).strip())[-_SHOWN:] or "it printed nothing"
            raise ProgramError(f"{self.name}: `{quote(argv)}` ended with exit code {done.exit_code}: {said}")
        return ProgramOutput(tuple(argv), done.exit_code, out, err)


class RobotHandles:
    """The robots of a lab, by role and by name: `robots.sender`, `robots["turtlebot-1"]`.

    Args:
        lab: The lab.
    """

    def __init__(self, lab: RobotsUp) -> None:
        self._lab = lab

    def __repr__(self) -> str:
        return f"<robots {', '.join(f'{robot.role}: {robot.name}' for robot in self)}>"

    def __getitem__(self, name: str) -> RobotHandle:
        """Return a robot by its role or its name.

        Raises:
            ConfigurationError: There is none.
        """
        cast = self._lab.cast
        for role, robot in cast.items():
            if name in {role, robot.name}:
                return RobotHandle(role, self._lab)
        known = [*cast, *(robot.name for robot in cast.values())]
        raise ConfigurationError(
            f"there is no robot {name!r} in this lab", remedy=nearest(name, known, f"there are: {', '.join(known)}")
        )

    def __getattr__(self, name: str) -> RobotHandle:
        """Return a robot by its role."""
        if name.startswith("_"):
            raise AttributeError(name)
        return self[name]

    def __iter__(self) -> Iterator[RobotHandle]:
        """Yield every robot, in the order of roles."""
        return (self[role] for role in self._lab.cast)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._lab.cast)


def _seconds_for(size_bytes: int) -> float:
    """Return how long a file may take: a way that carries less than 100 kB/s is no way for it."""
    return TIMEOUT_S + size_bytes / 1e5
