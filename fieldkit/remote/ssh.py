"""Shell over SSH: pinned host key, a deadline on everything, both streams drained. The only user of paramiko."""

import contextlib
import io
import select
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Final

import paramiko

from fieldkit.deadline import Deadline
from fieldkit.errors import ConfigurationError, FieldkitError, LinkError, RobotError
from fieldkit.remote.command import printable, quote
from fieldkit.remote.shell import Completed

Connect = Callable[[float], socket.socket]
"""Returns a fresh connected stream socket to the robot's SSH server within so many seconds, or raises OSError."""

CONNECT_S: Final = 10.0
# Unacknowledged data older than this ends the connection. With a dead link and SSH keepalives alone, paramiko
# still called the transport active after 25 s (field notes).
TCP_USER_TIMEOUT_MS: Final = 5_000

_CHUNK: Final = 1 << 16
_KEEP_OUTPUT_BYTES: Final = 16 << 20


class SshShell:
    """A Shell over one SSH connection, made when first used and again after it broke.

    Args:
        robot: Name of the robot, for messages.
        connect: Opens the stream; a backend decides by which way.
        user: Login name.
        host_key: Pinned host key as in `known_hosts`: `ssh-ed25519 AAAA...`.
        private_key: OpenSSH private key text; None asks the SSH agent.
    """

    def __init__(self, robot: str, *, connect: Connect, user: str, host_key: str, private_key: str | None) -> None:
        self._robot = robot
        self._connect = connect
        self._user = user
        self._host_key = _parse_host_key(host_key, robot)
        self._private_key = private_key
        self._transport: paramiko.Transport | None = None
        self._link: socket.socket | None = None
        self._lock = threading.Lock()

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self._robot

    def begin(self, argv: Sequence[str], *, deadline: Deadline) -> "SshSession":
        """See `Shell.begin`."""
        with self.explained(argv):
            channel, link = self._open_channel(deadline)
            channel.exec_command(quote(argv))
            # Acknowledge the robot's answer now, so that no late acknowledgement meets what the command sends.
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        return SshSession(self, channel, argv)

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        """See `Shell.run`."""
        return self.begin(argv, deadline=deadline).end(deadline=deadline, stdin=stdin, check=check)

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        """See `Shell.fetch`."""
        session = self.begin(argv, deadline=deadline)
        with to.open("wb") as out:
            return session.end(deadline=deadline, out=out, limit_bytes=limit_bytes)

    def close(self) -> None:
        """See `Shell.close`."""
        with self._lock:
            if self._transport is not None:
                self._transport.close()
                self._transport = self._link = None

    @contextlib.contextmanager
    def explained(self, argv: Sequence[str]) -> Iterator[None]:
        """Turn what paramiko and the socket raise into errors with the robot, the command and a remedy."""
        command = quote(argv)
        try:
            yield
        except FieldkitError:
            raise
        except TimeoutError as error:
            raise LinkError(
                f"`{command}` did not end in time", where=self._robot, remedy="check the robot and its control link"
            ) from error
        except (paramiko.SSHException, OSError, EOFError) as error:
            self.close()
            raise LinkError(
                f"the connection broke during `{command}`: {error or type(error).__name__}",
                where=self._robot,
                remedy="check that the robot is up and in range",
            ) from error

    def _open_channel(self, deadline: Deadline) -> tuple[paramiko.Channel, socket.socket]:
        with self._lock:
            if self._transport is None or self._link is None or not self._transport.is_active():
                self._transport, self._link = self._login(deadline)
            transport, link = self._transport, self._link
        channel = transport.open_session(timeout=max(0.1, deadline.remaining_s))
        channel.settimeout(max(0.1, deadline.remaining_s))
        return channel, link

    def _login(self, deadline: Deadline) -> tuple[paramiko.Transport, socket.socket]:
        within = deadline.sooner(CONNECT_S)
        try:
            link = self._connect(within.remaining_s)
        except OSError as error:
            raise LinkError(
                f"cannot be reached for SSH: {error}",
                where=self._robot,
                remedy="check that the robot is up, in range, and that host and port in the site file are right",
            ) from error
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, TCP_USER_TIMEOUT_MS)
        transport = paramiko.Transport(link)
        try:
            transport.banner_timeout = transport.auth_timeout = max(0.1, within.remaining_s)
            transport.get_security_options().key_types = _algorithms(self._host_key)
            transport.start_client(timeout=max(0.1, within.remaining_s))
            self._check_host_key(transport)
            self._authenticate(transport)
        except BaseException:
            transport.close()
            raise
        return transport, link

    def _check_host_key(self, transport: paramiko.Transport) -> None:
        offered = transport.get_remote_server_key()
        if offered.asbytes() != self._host_key.asbytes():
            raise RobotError(
                f"the host key changed: pinned {self._host_key.fingerprint}, offered {offered.fingerprint}",
                where=self._robot,
                remedy="if the robot was reinstalled, pin its new key in the site file; if not, do not go on",
            )

    def _authenticate(self, transport: paramiko.Transport) -> None:
        keys: Sequence[paramiko.PKey]
        if self._private_key is None:
            keys = paramiko.Agent().get_keys()
            if not keys:
                raise ConfigurationError(
                    "the SSH agent has no key",
                    where=self._robot,
                    remedy="ssh-add, or name `key:` in the site file",
                )
        else:
            keys = [_parse_private_key(self._private_key, self._robot)]
        for key in keys:
            with contextlib.suppress(paramiko.BadAuthenticationType, paramiko.AuthenticationException):
                transport.auth_publickey(self._user, key)
                return
        raise RobotError(
            f"refused the login of {self._user!r} with {len(keys)} key(s)",
            where=self._robot,
            remedy="put the public key into the robot's authorized_keys; check `user` in the site file",
        )


class SshSession:
    """See `Session`; made by `SshShell.begin`."""

    def __init__(self, shell: SshShell, channel: paramiko.Channel, argv: Sequence[str]) -> None:
        self._shell = shell
        self._channel = channel
        self._argv = tuple(argv)

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
        with self._shell.explained(self._argv), contextlib.closing(self._channel):
            exit_code, stderr = self._drain(out or kept, stdin=stdin, deadline=deadline, limit_bytes=limit_bytes)
        if check and exit_code != 0:
            raise RobotError(
                f"`{quote(self._argv)}` ended with exit code {exit_code}: {printable(stderr) or 'no message'}",
                where=self._shell.robot,
                remedy="run the command on the robot by hand",
            )
        return Completed(self._argv, exit_code, kept.getvalue(), stderr)

    def _drain(self, out: IO[bytes], *, stdin: bytes, deadline: Deadline, limit_bytes: int) -> tuple[int, bytes]:
        channel = self._channel
        stderr = bytearray()
        received = 0
        feed: memoryview | None = memoryview(stdin)
        while not deadline.expired:
            feed = _feed(channel, feed)
            ended = channel.eof_received or channel.closed  # read before the buffers, so that none is left
            received += _copy(channel, out)
            if received > limit_bytes:
                raise RobotError(
                    f"sent more than {limit_bytes} bytes", where=self._shell.robot, remedy="check what it sends"
                )
            while channel.recv_stderr_ready():
                stderr += channel.recv_stderr(_CHUNK)
                del stderr[:-_CHUNK]
            if ended:
                # recv_exit_status has no time-out (paramiko/paramiko#1815), its event has.
                if not channel.status_event.wait(deadline.remaining_s):
                    break
                return _exit_code(channel), bytes(stderr)
            # The descriptor reports both streams and their end, but not room to send.
            select.select([channel.fileno()], [], [], min(deadline.remaining_s, 1.0 if feed is None else 0.01))
        raise TimeoutError


def _feed(channel: paramiko.Channel, pending: memoryview | None) -> memoryview | None:
    """Send what the channel takes of `pending`; at its end close standard input and return None."""
    while pending and channel.send_ready():
        pending = pending[channel.send(pending[:_CHUNK].tobytes()) :]
    if pending is not None and not pending:
        channel.shutdown_write()
        return None
    return pending


def _copy(channel: paramiko.Channel, out: IO[bytes]) -> int:
    """Write what has arrived on standard output to `out`; return its size."""
    size = 0
    while channel.recv_ready():
        data = channel.recv(_CHUNK)
        out.write(data)
        size += len(data)
    return size


def _exit_code(channel: paramiko.Channel) -> int:
    code = channel.recv_exit_status()
    if code < 0:
        raise EOFError("the connection ended before the command")
    return code


def _parse_host_key(text: str, robot: str) -> paramiko.PKey:
    try:
        kind, encoded = text.split()[:2]
        entry = paramiko.hostkeys.HostKeyEntry.from_line(f"{robot} {kind} {encoded}")
    except (ValueError, paramiko.SSHException) as error:
        raise ConfigurationError("its pinned host key cannot be read", where=robot, remedy=_PIN) from error
    if entry is None or entry.key is None:
        raise ConfigurationError("its pinned host key cannot be read", where=robot, remedy=_PIN)
    return entry.key


_PIN: Final = "write host_key: ssh-ed25519 AAAA..., the first two words of the robot's /etc/ssh/*_key.pub"


def _algorithms(key: paramiko.PKey) -> tuple[str, ...]:
    """Ask for the pinned key's type alone; an RSA key signs with SHA-2 (paramiko 5 has no SHA-1)."""
    return ("rsa-sha2-512", "rsa-sha2-256") if key.get_name() == "ssh-rsa" else (key.get_name(),)


def _parse_private_key(text: str, robot: str) -> paramiko.PKey:
    for kind in (paramiko.Ed25519Key, paramiko.ECDSAKey, paramiko.RSAKey):
        with contextlib.suppress(paramiko.SSHException):
            return kind.from_private_key(io.StringIO(text))
    raise ConfigurationError(
        "its private key cannot be used",
        where=robot,
        remedy="use an ed25519 key; load one with a passphrase by ssh-add",
    )
