"""Shell over SSH: pinned host key, deadlines for all operations, commands repeated after a loss of the link."""

import contextlib
import errno
import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Final

from fieldkit.core.deadline import Deadline, ExpiredError
from fieldkit.core.errors import LinkError, LinkLostError, RobotError
from fieldkit.remote.command import printable, quote
from fieldkit.remote.connection import Connection
from fieldkit.remote.drain import drain, wait_for_output
from fieldkit.remote.identity import Address, Credentials, HostKey
from fieldkit.remote.link import BROKEN, FloodError, Link, NoSessionError
from fieldkit.remote.persistent_shells import Execution, RunningCommand
from fieldkit.remote.script import CALL
from fieldkit.remote.shell import Completed
from fieldkit.remote.sockets import Connect, Timing

CONNECT_S: Final = Timing.connect_s
RECONNECT_TIMEOUT_S: Final = 60.0

_MAX_OUTPUT_BYTES: Final = 16 << 20  # default limit of the standard output of a command
_DISK_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class SshShell:
    """A Shell over one SSH connection, which is opened at its first use, and reopened after a loss.

    Args:
        robot: Name of the robot, for messages.
        connect: Opens the stream; provided by a backend.
        user: Login name.
        host_key: Pinned host key as in `known_hosts`: `ssh-ed25519 AAAA...`.
        private_key: OpenSSH private key text; None uses the keys of the SSH agent, unless there is a password.
        password: The password, which is then the only login method; None to use keys.
        host: Host name or address, for messages; empty for the name of the robot.
        port: SSH port, for messages.
        reconnect_timeout_s: Time after a loss during which attempts to reopen the connection are made.
        on_notice: Called with one line when the connection is lost, and when it is restored.
        crosses_radio: Whether the connection crosses the radio under test.
        timing: Timeouts of the connection.

    Raises:
        ConfigurationError: `host_key` is not a host key.
    """

    def __init__(
        self,
        robot: str,
        *,
        connect: Connect,
        user: str,
        host_key: str,
        private_key: str | None,
        password: str | None = None,
        host: str = "",
        port: int = 22,
        reconnect_timeout_s: float = RECONNECT_TIMEOUT_S,
        on_notice: Callable[[str], None] = lambda text: None,  # noqa: ARG005
        crosses_radio: bool = False,
        timing: Timing = Timing(),  # noqa: B008 (the default is immutable)
    ) -> None:
        self._connection = Connection(
            Address(robot, host or robot, port, user),
            connect,
            Credentials(HostKey.parse(host_key, robot), private_key, password),
            reconnect_timeout_s=reconnect_timeout_s,
            on_notice=on_notice,
            crosses_radio=crosses_radio,
            timing=timing,
        )

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self._connection.address.robot

    @property
    def ssh_destination(self) -> str:
        """The arguments for `ssh` to this robot."""
        return self._connection.address.ssh_arguments

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> "SshSession":
        """Start a command and return when the robot has accepted it, or has written `until`; see `Shell.begin`."""
        return self._begin(argv, deadline, ends_on_request=until is None, until=until or b"")

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        """Run a command and wait for its end; see `Shell.run`."""
        session = self._begin(argv, deadline, has_input=bool(stdin))
        return session.end(deadline=deadline, stdin=stdin, check=check)

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        """Run a command and write its standard output to a file; see `Shell.fetch`."""
        session = self._begin(argv, deadline)
        with to.open("wb") as out:
            return session.end(deadline=deadline, out=out, limit_bytes=limit_bytes)

    def _begin(
        self,
        argv: Sequence[str],
        deadline: Deadline,
        *,
        ends_on_request: bool = False,
        has_input: bool = False,
        until: bytes = b"",
    ) -> "SshSession":
        """Start a command, again after each loss of the link, and return its session."""

        def attempt(attempt_deadline: Deadline) -> SshSession:
            link, channel = _start(
                self._connection, argv, attempt_deadline, ends_on_request=ends_on_request, has_input=has_input
            )
            with _converting_errors(self._connection.address, link, argv), contextlib.ExitStack() as stack:
                stack.enter_context(contextlib.closing(channel))
                is_ready = not until or wait_for_output(channel, until, deadline=attempt_deadline, robot=self.robot)
                link.acknowledge()
                stack.pop_all()
            return SshSession(
                self._connection,
                argv,
                (link, channel),
                ends_on_request=ends_on_request,
                has_input=has_input,
                is_ready=is_ready,
            )

        return self._connection.run_with_retries(attempt, deadline)

    def silence(self, seconds: float) -> contextlib.AbstractContextManager[None]:
        """Keep the connection silent during the body, if it crosses the radio under test; see `Shell.silence`."""
        return self._connection.silence(seconds)

    def close(self) -> None:
        """Close the connection, and end all waits for it in other threads."""
        self._connection.close()


class SshSession:
    """A running command, created by `SshShell.begin`.

    Args:
        connection: The connection.
        argv: The command.
        link_and_channel: The link, and the channel of the command on it.
        ends_on_request: Whether the robot reports the end of the command only on request.
        has_input: Whether the command has standard input.
        is_ready: True if the command wrote the expected output, see `Session.is_ready`.
    """

    def __init__(
        self,
        connection: Connection,
        argv: Sequence[str],
        link_and_channel: tuple[Link, Execution],
        *,
        ends_on_request: bool,
        has_input: bool,
        is_ready: bool,
    ) -> None:
        self.is_ready = is_ready
        self._connection = connection
        self._argv = tuple(argv)
        self._link_and_channel: tuple[Link, Execution] | None = link_and_channel
        self._ends_on_request = ends_on_request
        self._has_input = has_input

    def end(
        self,
        *,
        deadline: Deadline,
        check: bool = True,
        stdin: bytes = b"",
        out: IO[bytes] | None = None,
        limit_bytes: int = _MAX_OUTPUT_BYTES,
    ) -> Completed:
        """Wait for the end of the command; see `Session.end`, `Shell.run` and `Shell.fetch`.

        Args:
            deadline: Time limit.
            check: Whether to raise if the exit code is not 0.
            stdin: Standard input of the command.
            out: File for standard output; None to return it in the result.
            limit_bytes: Maximum size of standard output.
        """
        buffer = io.BytesIO()
        output = out or buffer

        def attempt(attempt_deadline: Deadline) -> tuple[int, bytes]:
            link, channel = self._link_and_channel or _start(
                self._connection,
                self._argv,
                attempt_deadline,
                ends_on_request=self._ends_on_request,
                has_input=self._has_input,
            )
            self._link_and_channel = None
            output.seek(0)
            output.truncate()
            with _converting_errors(self._connection.address, link, self._argv), contextlib.closing(channel):
                pending_input = stdin if self._ends_on_request or self._has_input else None
                if isinstance(channel, RunningCommand):  # it has no standard input that could be closed
                    pending_input = None
                    if self._ends_on_request:
                        channel.request_end()
                completed = drain(
                    channel,
                    output,
                    stdin=pending_input,
                    deadline=attempt_deadline,
                    limit_bytes=limit_bytes,
                    robot=self._robot,
                )
                shell_command = f"exec {quote((*CALL, 'command_loop'))}" if _is_call(self._argv) else None
                self._connection.open_spare_channels(link, shell_command)
                return completed

        exit_code, stderr = self._connection.run_with_retries(attempt, deadline)
        if check and exit_code != 0:
            raise RobotError(
                f"`{quote(self._argv)}` ended with exit code {exit_code}: "
                f"{printable(stderr or buffer.getvalue()) or 'no message'}",
                where=self._robot,
                remedy="run the command on the robot by hand",
            )
        return Completed(self._argv, exit_code, buffer.getvalue(), stderr)

    @property
    def _robot(self) -> str:
        return self._connection.address.robot


def _start(
    connection: Connection, argv: Sequence[str], deadline: Deadline, *, ends_on_request: bool, has_input: bool
) -> tuple[Link, Execution]:
    """Start a command; return it and its link when the robot has accepted it.

    The standard input of a command whose end is reported without a request is /dev/null, so that no packet to close
    it is sent while the command sends data. If its end is reported on request, its standard input stays open in a
    separate session. A call of the job script without standard input runs in a persistent shell, if one is free.
    """
    # Without `exec`, the login shell would wait for the command and delay the report of its end.
    command_line = quote(argv) if ends_on_request or has_input else f"exec {quote(argv)} </dev/null"
    close_event = connection.close_event
    link = connection.link(deadline)
    try:
        with _converting_errors(connection.address, link, argv):
            command = None
            if _is_call(argv) and not has_input:
                command = connection.shells.begin(
                    link, quote(argv[len(CALL) :]), deadline, close_event, ends_on_request=ends_on_request
                )
            return link, command or link.begin(command_line, deadline, close_event)
    except LinkError:
        link.close()  # a server that does not answer this command will not answer the next one
        raise


def _is_call(argv: Sequence[str]) -> bool:
    """Return True if a command is a call of the job script that fits on one line of a persistent shell."""
    return tuple(argv[: len(CALL)]) == CALL and not any("\n" in word for word in argv)


@contextlib.contextmanager
def _converting_errors(address: Address, link: Link, argv: Sequence[str]) -> Iterator[None]:
    """Convert exceptions of paramiko, the socket and the deadline to errors with robot, command and remedy.

    Raises:
        LinkError: The deadline passed.
        LinkLostError: The connection broke, or the server opens no session; the link is then closed.
        RobotError: The server violated the SSH protocol.
        OSError: The disk of this computer is full.
    """
    command, robot = quote(argv), address.robot
    try:
        yield
    except ExpiredError as error:
        raise LinkError(
            f"`{command}` did not {error} in time",
            where=robot,
            remedy=f"ssh {address.ssh_arguments}; does the robot hang?",
        ) from error
    except FloodError as error:
        link.close()
        raise RobotError(
            f"its SSH server violated the SSH protocol during `{command}`: {error}",
            where=robot,
            remedy=f"ssh -v {address.ssh_arguments} true; does the robot answer, and is its SSH server up to date?",
        ) from error
    except BROKEN as error:
        link.close()
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            raise  # the disk of this machine is full: reconnecting would not help
        if isinstance(error, NoSessionError):
            raise LinkLostError(
                f"its SSH server opens no session: {error}",
                where=robot,
                remedy=f"ssh {address.ssh_arguments} true; on the robot: grep -i MaxSessions /etc/ssh/sshd_config",
            ) from error
        raise LinkLostError(
            f"the connection broke during `{command}`: {error or type(error).__name__}",
            where=robot,
            remedy=f"ping -c 3 {address.host}; is the robot up and in range?",
        ) from error
