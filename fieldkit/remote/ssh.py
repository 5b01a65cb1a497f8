"""Shell over SSH: pinned host key, a deadline on everything, a command sent again when the link was lost."""

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
from fieldkit.remote.drain import drain, hear
from fieldkit.remote.identity import Address, Credentials, HostKey
from fieldkit.remote.link import BROKEN, Connect, FloodError, Link, NoSessionError, Timing
from fieldkit.remote.script import CALL
from fieldkit.remote.shell import Completed
from fieldkit.remote.standing import Running, Turn

CONNECT_S: Final = Timing.connect_s
PATIENCE_S: Final = 60.0

_KEEP_OUTPUT_BYTES: Final = 16 << 20
_NO_ROOM: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class SshShell:
    """A Shell over one SSH connection, made when first used and again after it was lost.

    Args:
        robot: Name of the robot, for messages.
        connect: Opens the stream; a backend decides by which way.
        user: Login name.
        host_key: Pinned host key as in `known_hosts`: `ssh-ed25519 AAAA...`.
        private_key: OpenSSH private key text; None asks the SSH agent, unless there is a password.
        password: Tried alone where it is given.
        host: Where the robot is, for messages; its name where left out.
        port: Its SSH port, for messages.
        patience_s: How long a lost connection is awaited.
        notice: Told in one line when the connection is lost, and when it is back.
        on_air: Whether it crosses the radio under test.
        timing: How long it waits.

    Raises:
        ConfigurationError: `host_key` is none.
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
        patience_s: float = PATIENCE_S,
        notice: Callable[[str], None] = lambda text: None,  # noqa: ARG005
        on_air: bool = False,
        timing: Timing = Timing(),  # noqa: B008 (frozen)
    ) -> None:
        self._connection = Connection(
            Address(robot, host or robot, port, user),
            connect,
            Credentials(HostKey.parse(host_key, robot), private_key, password),
            patience_s=patience_s,
            notice=notice,
            on_air=on_air,
            timing=timing,
        )

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self._connection.address.robot

    @property
    def by_hand(self) -> str:
        """See `Shell.by_hand`."""
        return self._connection.address.by_hand

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> "SshSession":
        """See `Shell.begin`."""
        return self._begin(argv, deadline, asks=until is None, until=until or b"")

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        """See `Shell.run`."""
        session = self._begin(argv, deadline, feeds=bool(stdin))
        return session.end(deadline=deadline, stdin=stdin, check=check)

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        """See `Shell.fetch`."""
        session = self._begin(argv, deadline)
        with to.open("wb") as out:
            return session.end(deadline=deadline, out=out, limit_bytes=limit_bytes)

    def _begin(
        self,
        argv: Sequence[str],
        deadline: Deadline,
        *,
        asks: bool = False,
        feeds: bool = False,
        until: bytes = b"",
    ) -> "SshSession":
        def attempt(within: Deadline) -> SshSession:
            link, channel = _start(self._connection, argv, within, asks=asks, feeds=feeds)
            with _explained(self._connection.address, link, argv), contextlib.ExitStack() as opened:
                opened.enter_context(contextlib.closing(channel))
                told = not until or hear(channel, until, deadline=within, robot=self.robot)
                link.acknowledge()
                opened.pop_all()
            return SshSession(self._connection, argv, (link, channel), asks=asks, feeds=feeds, told=told)

        return self._connection.persist(attempt, deadline)

    def silence(self, seconds: float) -> contextlib.AbstractContextManager[None]:
        """See `Shell.silence`."""
        return self._connection.silence(seconds)

    def close(self) -> None:
        """See `Shell.close`."""
        self._connection.close()


class SshSession:
    """See `Session`; made by `SshShell.begin`.

    Args:
        connection: Carries it.
        argv: The command.
        running: Its channel, and the link of that.
        asks: Whether the robot tells its end when asked.
        feeds: Whether it gets standard input.
        told: See `Session.told`.
    """

    def __init__(
        self,
        connection: Connection,
        argv: Sequence[str],
        running: tuple[Link, Running],
        *,
        asks: bool,
        feeds: bool,
        told: bool,
    ) -> None:
        self.told = told
        self._connection = connection
        self._argv = tuple(argv)
        self._running: tuple[Link, Running] | None = running
        self._asks = asks
        self._feeds = feeds

    def end(
        self,
        *,
        deadline: Deadline,
        check: bool = True,
        stdin: bytes = b"",
        out: IO[bytes] | None = None,
        limit_bytes: int = _KEEP_OUTPUT_BYTES,
    ) -> Completed:
        """See `Session.end`, `Shell.run` and `Shell.fetch`; output goes to `out` where it is given."""
        kept = io.BytesIO()
        into = out or kept

        def attempt(within: Deadline) -> tuple[int, bytes]:
            link, channel = self._running or _start(
                self._connection, self._argv, within, asks=self._asks, feeds=self._feeds
            )
            self._running = None
            into.seek(0)
            into.truncate()
            with _explained(self._connection.address, link, self._argv), contextlib.closing(channel):
                given = stdin if self._asks or self._feeds else None
                if isinstance(channel, Turn):  # which has no input to be closed
                    given = None
                    if self._asks:
                        channel.ask()
                done = drain(channel, into, stdin=given, deadline=within, limit_bytes=limit_bytes, robot=self._robot)
                standing = f"exec {quote((*CALL, 'stand'))}" if _is_call(self._argv) else None
                self._connection.replenish(link, standing)
                return done

        exit_code, stderr = self._connection.persist(attempt, deadline)
        if check and exit_code != 0:
            raise RobotError(
                f"`{quote(self._argv)}` ended with exit code {exit_code}: "
                f"{printable(stderr or kept.getvalue()) or 'no message'}",
                where=self._robot,
                remedy="run the command on the robot by hand",
            )
        return Completed(self._argv, exit_code, kept.getvalue(), stderr)

    @property
    def _robot(self) -> str:
        return self._connection.address.robot


def _start(
    connection: Connection, argv: Sequence[str], deadline: Deadline, *, asks: bool, feeds: bool
) -> tuple[Link, Running]:
    """Return a command that the robot has accepted, and the link that carries it.

    Whose end is told at once finds standard input empty without a word from us, which would cross what it sends.
    Whose end is asked for has it open, in a session of its own. A call of the job script that gets no input goes to
    a standing shell, if one has nothing else to do.
    """
    # A shell that is told where to read from may stand between us and the command's end, unless it is replaced.
    words = quote(argv) if asks or feeds else f"exec {quote(argv)} </dev/null"
    ended = connection.ended
    link = connection.link(deadline)
    try:
        with _explained(connection.address, link, argv):
            turn = None
            if _is_call(argv) and not feeds:
                turn = connection.standing.begin(link, quote(argv[len(CALL) :]), deadline, ended, held=asks)
            return link, turn or link.begin(words, deadline, ended)
    except LinkError:
        link.close()  # a server that does not answer this will not answer the next
        raise


def _is_call(argv: Sequence[str]) -> bool:
    """Whether a command is one that fits a line of the job script's standing shell."""
    return tuple(argv[: len(CALL)]) == CALL and not any("\n" in word for word in argv)


@contextlib.contextmanager
def _explained(address: Address, link: Link, argv: Sequence[str]) -> Iterator[None]:
    """Turn what paramiko, the socket and the deadline raise into errors with robot, command and remedy."""
    command, robot = quote(argv), address.robot
    try:
        yield
    except ExpiredError as error:
        raise LinkError(
            f"`{command}` did not {error} in time", where=robot, remedy=f"ssh {address.by_hand}; does the robot hang?"
        ) from error
    except FloodError as error:
        link.close()
        raise RobotError(
            f"its SSH server did not keep to SSH during `{command}`: {error}",
            where=robot,
            remedy=f"ssh -v {address.by_hand} true; is it the robot that answers, and its SSH server up to date?",
        ) from error
    except BROKEN as error:
        link.close()
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            raise  # this machine's own disk: connecting again would not help
        if isinstance(error, NoSessionError):
            raise LinkLostError(
                f"its SSH server opens no session: {error}",
                where=robot,
                remedy=f"ssh {address.by_hand} true; on the robot: grep -i MaxSessions /etc/ssh/sshd_config",
            ) from error
        raise LinkLostError(
            f"the connection broke during `{command}`: {error or type(error).__name__}",
            where=robot,
            remedy=f"ping -c 3 {address.host}; is the robot up and in range?",
        ) from error
