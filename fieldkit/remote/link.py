"""One SSH connection: checks the host key, logs in, and detects a silent peer."""

import contextlib
import logging
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from typing import Final

import paramiko
from typing_extensions import override

from fieldkit.core.deadline import Deadline, call_with_deadline
from fieldkit.core.errors import HostKeyError, RobotError
from fieldkit.core.units import format_count
from fieldkit.remote import sockets
from fieldkit.remote.identity import Address, Credentials, HostKey
from fieldkit.remote.keys import private_keys
from fieldkit.remote.sockets import Connect, Timing

Channel = paramiko.Channel
Transport = paramiko.Transport

SPARE_CHANNELS: Final = 2
"""Number of channels that are opened in advance: one for the next command, and one for a second command that starts
before another channel has been opened."""

BROKEN: Final = (paramiko.SSHException, OSError, EOFError)
"""Exceptions of a broken connection."""

# Errors are reported by fieldkit's exceptions; without a handler, paramiko would also print them to the terminal.
logging.getLogger("paramiko").addHandler(logging.NullHandler())

# Signature algorithms by key type. RSA keys use SHA-2 only: paramiko 5 has no SHA-1.
_SIGNATURES: Final = {
    "ssh-ed25519": ("ssh-ed25519",),
    "ecdsa-sha2-nistp256": ("ecdsa-sha2-nistp256",),
    "ecdsa-sha2-nistp384": ("ecdsa-sha2-nistp384",),
    "ecdsa-sha2-nistp521": ("ecdsa-sha2-nistp521",),
    "ssh-rsa": ("rsa-sha2-512", "rsa-sha2-256"),
}


_WEAK_ALGORITHMS: Final = ("cbc", "md5", "-96")
"""Parts of the names of weak ciphers and MACs, which paramiko would accept and OpenSSH 9 does not."""

_REFUSED: Final = "Unable to open channel"

# RFC 4253, section 6.1 requires support for packets of 35,000 bytes, and OpenSSH accepts 256 KiB.
_PACKET_BYTES: Final = 1 << 18
_BANNER_BYTES: Final = 1 << 16


class UnfitServerError(paramiko.SSHException):
    """The server violates the SSH protocol, or supports only insecure algorithms."""


class FloodError(UnfitServerError):
    """The server sent more data than allowed."""


class NoSessionError(paramiko.SSHException):
    """The server accepted the login, but refuses to open a channel."""


class _Packetizer(paramiko.packet.Packetizer):
    """Limits the length of packets and of the banner, because paramiko does not.

    Attributes:
        acknowledges: Whether answers of the server are acknowledged immediately. OpenSSH's server uses Nagle's
            algorithm (RFC 896): it delays a small packet until the previous one is acknowledged, which this computer
            delays by 40 ms (RFC 1122, section 4.2.3.2). Linux leaves the quick acknowledgement mode whenever data is
            sent (tcp(7), TCP_QUICKACK).
        has_ended: Whether reading from the connection has failed, which paramiko reports to one thread only.
    """

    def __init__(self, stream: socket.socket) -> None:
        super().__init__(stream)
        self.acknowledges = True
        self.has_ended = False
        self._stream = stream
        self._received_banner_bytes = 0

    @override
    def send_message(self, data: paramiko.Message) -> None:
        super().send_message(data)
        if self.acknowledges:
            self._stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    @override
    def read_message(self) -> tuple[int, paramiko.Message]:
        try:
            return super().read_message()
        except BROKEN:
            self.has_ended = True
            raise

    @override
    def read_all(self, n: int, check_rekey: bool = False) -> bytes:
        if n > _PACKET_BYTES:
            raise FloodError(f"it announced a packet of {n} bytes")
        return super().read_all(n, check_rekey)

    def _read_timeout(self, timeout: float) -> bytes:
        """Return a part of the banner; raises `FloodError` if the banner is too long."""
        piece: bytes = super()._read_timeout(timeout)  # type: ignore[misc]
        self._received_banner_bytes += len(piece)
        if self._received_banner_bytes > _BANNER_BYTES:
            raise FloodError(f"its banner has more than {_BANNER_BYTES} bytes")
        return piece


class _LimitedBuffer(paramiko.buffered_pipe.BufferedPipe):  # type: ignore[type-arg]
    """A buffer that is limited to the channel's window; paramiko would buffer any amount of unread data."""

    def __init__(self, window_bytes: int) -> None:
        super().__init__()
        self._window_bytes = window_bytes

    @override
    def feed(self, data: bytes) -> None:
        if len(self) + len(data) > self._window_bytes:
            raise FloodError("it sent more than its window allows")
        super().feed(data)


class LoginRefusedError(RobotError):
    """The robot refused the login."""


class Link:
    """A connection to one SSH server. `close` from another thread ends all waits.

    Args:
        connect: Opens the stream; provided by a backend.
        timing: Timeouts of the connection.

    Attributes:
        awaited_action: The next action of the server, for messages, for example `send its SSH banner`.
    """

    FIRST_ACTION: Final = "accept the connection"

    def __init__(self, connect: Connect, timing: Timing) -> None:
        self.awaited_action = self.FIRST_ACTION
        self._connect = connect
        self._timing = timing
        self._lock = threading.Lock()
        self._closed = False
        self._stream: socket.socket | None = None
        self._transport: paramiko.Transport | None = None
        self._spares: list[Future[Channel]] = []

    @property
    def alive(self) -> bool:
        """Whether the link is logged in, and no error has occurred."""
        return not self._closed and self._transport is not None and self._transport.is_authenticated()

    def exchange_keys(self, kind: str) -> HostKey:
        """Connect, exchange keys, and return the server's host key, of type `kind` if it has one.

        Raises:
            OSError: The stream could not be opened, or broke.
            SSHException: The server does not support SSH.
            UnfitServerError: It supports only insecure algorithms.
            EOFError: It closed the connection.
        """
        stream = self._connect(self._timing.connect_s)
        sockets.enable_keepalive(stream, self._timing)
        transport = paramiko.Transport(stream, packetizer_class=_Packetizer)
        with self._lock:
            self._stream, self._transport = stream, transport
            if self._closed:
                stream.close()
        # The caller has a deadline; these timeouts must only be longer.
        transport.banner_timeout = transport.auth_timeout = 2 * self._timing.connect_s
        key_types = sorted(_SIGNATURES, key=lambda key_type: key_type != kind)
        options = transport.get_security_options()
        options.key_types = [name for key_type in key_types for name in _SIGNATURES[key_type]]
        options.ciphers, options.digests = _without_weak(options.ciphers), _without_weak(options.digests)
        self.awaited_action = "send its SSH banner"
        key_exchanged = threading.Event()
        transport.start_client(event=key_exchanged)
        while not key_exchanged.wait(0.02):
            if transport.remote_version:
                self.awaited_action = "agree on keys"
        if not transport.is_active():
            error = transport.get_exception() or EOFError("it closed the connection")
            if isinstance(error, paramiko.ssh_exception.IncompatiblePeer):
                raise UnfitServerError(str(error).partition("(")[2].rstrip(")")) from error
            raise error
        key = transport.get_remote_server_key()
        return HostKey(f"{key.get_name()} {key.get_base64()}", transport.remote_version)

    def log_in(self, address: Address, credentials: Credentials) -> None:
        """Connect, check the host key and log in.

        Raises:
            RobotError: The host key is not the pinned one.
            LoginRefusedError: The robot refused the user, the key or the password.
            ConfigurationError: There is no key for the login.
            OSError, SSHException, EOFError: For the same reasons as `exchange_keys`.
        """
        pinned_key = credentials.host_key
        server_key = self.exchange_keys(pinned_key.kind)
        if server_key != pinned_key:
            raise HostKeyError(
                f"the host key changed: pinned {pinned_key.fingerprint}, offered {server_key.fingerprint}",
                where=address.robot,
                remedy=f"continue only if it was reinstalled: fieldkit enroll {address.robot} --replace",
            )
        self.awaited_action = "answer the login"
        _, transport = self._connection()
        count = 0
        for attempt in _login_attempts(transport, address, credentials):
            with contextlib.suppress(paramiko.AuthenticationException):
                attempt()
            if transport.is_authenticated():
                self.open_spare_channels()
                return
            if not transport.is_active():  # a server may disconnect after several wrong keys, OpenSSH after six
                break
            count += 1
        if not count:
            raise EOFError("it closed the connection")
        raise _refused_error(address, credentials, count)

    def begin(self, command: str, deadline: Deadline, close_event: threading.Event) -> Channel:
        """Start a command, and return its channel when the server has accepted it.

        Raises:
            ExpiredError: The deadline passed, or `close_event` was set.
            OSError, SSHException, EOFError: The connection broke.
        """
        _, transport = self._connection()
        channel = call_with_deadline(lambda: self._channel(transport), deadline, close_event, what="get a channel")
        call_with_deadline(lambda: channel.exec_command(command), deadline, close_event, what="start")
        self.acknowledge()
        assert isinstance(transport.packetizer, _Packetizer)
        # From now on only necessary packets are sent, because the radio under test may be measured.
        transport.packetizer.acknowledges = False
        return channel

    def acknowledge(self) -> None:
        """Send the TCP acknowledgement now, because a delayed one could collide with packets of the command."""
        stream, _ = self._connection()
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def extend_timeout(self, seconds: float) -> None:
        """Extend `Timing.dead_s`, the time that the peer may be silent, by some seconds."""
        stream, _ = self._connection()
        sockets.set_timeout(stream, self._timing.dead_s + seconds)

    def open_spare_channels(self) -> None:
        """Start to open channels in advance, so that later commands need not wait for a channel.

        Must be called after a command has ended. At the start of a command, the answers would collide with its
        packets.
        """
        _, transport = self._connection()
        if _closes_spare_channels(transport):
            return
        with self._lock:
            missing_count = max(0, SPARE_CHANNELS - len(self._spares))
            self._spares += [self._open_in_background(transport) for _ in range(missing_count)]

    def wait_until_open(self, deadline: Deadline) -> None:
        """Wait until all channels that are being opened in advance are open, or the deadline has passed."""
        with self._lock:
            spares = list(self._spares)
        wait(spares, timeout=deadline.remaining_s)

    def open_additional(self) -> Channel | None:
        """Open a channel in addition to the spare ones.

        Return None without opening a channel if the server closes channels that are opened in advance.

        Raises:
            OSError, SSHException, EOFError: The connection broke, or the server refuses more.
        """
        _, transport = self._connection()
        if _closes_spare_channels(transport):
            return None
        with self._lock:
            spares = list(self._spares)
        for spare in spares:
            spare.result()  # raises an error if the server has refused a spare channel: it would also refuse this one
        return self._open(transport)

    def _channel(self, transport: paramiko.Transport) -> Channel:
        """Return an open channel: a spare one, or a new one if the server has refused or closed the spare ones."""
        while True:
            with self._lock:
                spare = self._spares.pop(0) if self._spares else None
            if spare is None:
                return self._open(transport)
            with contextlib.suppress(NoSessionError):
                if not (channel := spare.result()).closed:
                    return channel

    def _open_in_background(self, transport: paramiko.Transport) -> "Future[Channel]":
        future: Future[Channel] = Future()

        def open_channel() -> None:
            try:
                future.set_result(self._open(transport))
            except BROKEN as error:
                future.set_exception(error)

        threading.Thread(target=open_channel, daemon=True).start()
        return future

    def _open(self, transport: paramiko.Transport) -> Channel:
        try:
            channel = transport.open_session(timeout=self._channel_timeout_s)
        except paramiko.SSHException as error:
            # If two channels are refused at the same time, paramiko reports the reason for one only.
            if isinstance(error, paramiko.ChannelException) or _REFUSED in str(error):
                raise NoSessionError(getattr(error, "text", "it gives no reason")) from error
            raise
        window_bytes = transport.default_window_size
        channel.in_buffer, channel.in_stderr_buffer = _LimitedBuffer(window_bytes), _LimitedBuffer(window_bytes)
        return channel

    @property
    def _channel_timeout_s(self) -> float:
        """Timeout for opening a channel; longer than the deadline of the waiting thread."""
        return 2 * self._timing.connect_s

    def close(self) -> None:
        """Close the connection, also while it is being opened; commands on the robot continue."""
        with self._lock:
            self._closed = True
            stream, transport = self._stream, self._transport
        if stream is not None and transport is not None:
            transport.close()
            stream.close()

    def _connection(self) -> tuple[socket.socket, paramiko.Transport]:
        if self._stream is None or self._transport is None:
            raise EOFError("not connected")
        return self._stream, self._transport


def connection_error(transport: paramiko.Transport) -> BaseException | None:
    """Return the error of the connection of a closed channel, or None if the server has closed only the channel.

    paramiko stores its exception, closes the channels of the connection, and only then marks the connection as
    inactive. On a busy computer the time between these actions has no limit.
    """
    assert isinstance(transport.packetizer, _Packetizer)
    error = transport.saved_exception
    if isinstance(error, paramiko.ChannelException):  # the server has refused another channel
        error = None
    if error is None and (transport.packetizer.has_ended or not transport.is_active()):
        error = EOFError("the connection ended before the command")
    return error


def _closes_spare_channels(transport: paramiko.Transport) -> bool:
    """Return True if the server closes channels that are opened in advance.

    dropbear (2022.83) closes channels without a command when the command of another channel ends.
    """
    return "dropbear" in transport.remote_version


def _without_weak(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in names if not any(word in name for word in _WEAK_ALGORITHMS))


def _login_attempts(
    transport: paramiko.Transport, address: Address, credentials: Credentials
) -> Iterator[Callable[[], object]]:
    """Yield a function for each login method."""
    user, password = address.user, credentials.password
    if password is not None:
        yield lambda: transport.auth_password(user, password)
        return
    for key in private_keys(credentials.private_key, where=address.robot):
        yield lambda key=key: transport.auth_publickey(user, key)  # type: ignore[misc]


def _refused_error(address: Address, credentials: Credentials, count: int) -> LoginRefusedError:
    if credentials.password is not None:
        method, remedy = "the password", f"ssh {address.ssh_arguments}, and log in with that password"
    else:
        method, remedy = format_count(count, "key"), f"ssh-copy-id {address.ssh_arguments}"
    return LoginRefusedError(
        f"refused the login of {address.user!r} with {method}",
        where=address.robot,
        remedy=f"{remedy}; is `user` right in the site file?",
    )
