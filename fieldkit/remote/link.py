"""One SSH connection: host key checked, logged in, dead when its peer is silent."""

import contextlib
import logging
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Final

import paramiko
from typing_extensions import override

from fieldkit.core.deadline import Deadline, bounded
from fieldkit.core.errors import HostKeyError, RobotError
from fieldkit.core.units import format_count
from fieldkit.remote.identity import Address, Credentials, HostKey
from fieldkit.remote.keys import private_keys

Connect = Callable[[float], socket.socket]
"""Returns a fresh connected stream socket to the robot's SSH server within so many seconds, or raises OSError."""

Channel = paramiko.Channel
Transport = paramiko.Transport

SPARES: Final = 2
"""How many channels a link keeps open for commands to come: one for the next, one while its successor is made."""

BROKEN: Final = (paramiko.SSHException, OSError, EOFError)
"""What a connection raises when it breaks."""

# What goes wrong reaches the operator as an error of ours; without a handler it would be on the terminal as well.
logging.getLogger("paramiko").addHandler(logging.NullHandler())

# An RSA key signs with SHA-2: paramiko 5 has no SHA-1.
_SIGNATURES: Final = {
    "ssh-ed25519": ("ssh-ed25519",),
    "ecdsa-sha2-nistp256": ("ecdsa-sha2-nistp256",),
    "ecdsa-sha2-nistp384": ("ecdsa-sha2-nistp384",),
    "ecdsa-sha2-nistp521": ("ecdsa-sha2-nistp521",),
    "ssh-rsa": ("rsa-sha2-512", "rsa-sha2-256"),
}


_BROKEN_WORDS: Final = ("cbc", "md5", "-96")
"""In names of ciphers and MACs that paramiko takes where a server has no others, and OpenSSH 9 does not."""

_REFUSED: Final = "Unable to open channel"

# RFC 4253, section 6.1 asks for packets of 35,000 bytes at least, and OpenSSH takes 256 KiB.
_PACKET_BYTES: Final = 1 << 18
_BANNER_BYTES: Final = 1 << 16


class UnfitServerError(paramiko.SSHException):
    """The server speaks SSH, and not as one that is safe to talk to."""


class FloodError(UnfitServerError):
    """The server sent more than it was allowed to."""


class NoSessionError(paramiko.SSHException):
    """The server let us in, and opens no channel."""


class _Packetizer(paramiko.packet.Packetizer):
    """Reads no longer packet and no longer banner than any server needs; paramiko takes whatever comes.

    Attributes:
        acknowledges: Whether what the server answers is acknowledged immediately. OpenSSH's server leaves Nagle's
            algorithm on (RFC 896): it holds a small packet back until the one before it is acknowledged, which this
            computer delays by 40 ms (RFC 1122, section 4.2.3.2). Linux ends quick acknowledgement whenever data is
            sent (tcp(7), TCP_QUICKACK).
    """

    def __init__(self, stream: socket.socket) -> None:
        super().__init__(stream)
        self.acknowledges = True
        self._stream = stream
        self._greeting_bytes = 0

    @override
    def send_message(self, data: paramiko.Message) -> None:
        super().send_message(data)
        if self.acknowledges:
            self._stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    @override
    def read_all(self, n: int, check_rekey: bool = False) -> bytes:
        if n > _PACKET_BYTES:
            raise FloodError(f"it announced a packet of {n} bytes")
        return super().read_all(n, check_rekey)

    def _read_timeout(self, timeout: float) -> bytes:
        """Return a piece of the banner."""
        piece: bytes = super()._read_timeout(timeout)  # type: ignore[misc]
        self._greeting_bytes += len(piece)
        if self._greeting_bytes > _BANNER_BYTES:
            raise FloodError(f"its banner has more than {_BANNER_BYTES} bytes")
        return piece


class _Pipe(paramiko.buffered_pipe.BufferedPipe):  # type: ignore[type-arg]
    """Holds what a channel's window allows; paramiko keeps all that a server sends before somebody reads it."""

    def __init__(self, window_bytes: int) -> None:
        super().__init__()
        self._window_bytes = window_bytes

    @override
    def feed(self, data: bytes) -> None:
        if len(self) + len(data) > self._window_bytes:
            raise FloodError("it sent more than its window allows")
        super().feed(data)


class LoginRefusedError(RobotError):
    """The robot answered and did not let us in."""


@dataclass(frozen=True)
class Timing:
    """Waiting times of an SSH connection. The kernel ends one whose peer is silent for about `probe_s` + `dead_s`.

    Attributes:
        connect_s: From the robot's name to the end of the login; shorter than the 10 s in which people hear of a
            dead link, which may have died while nobody used it.
        probe_s: Silence after which the kernel asks whether the peer is there, in whole seconds.
        dead_s: Age of unacknowledged data at which it is not. With SSH keepalives alone, paramiko still called a
            dead connection active after 25 s (field notes).
        reply_s: What is left at least to a command that is sent again.
        pause_s: The first pause between attempts to connect again; each is twice as long, up to `probe_s`.
    """

    connect_s: float = 8.0
    probe_s: int = 2
    dead_s: float = 5.0
    reply_s: float = 10.0
    pause_s: float = 0.2


def over_tcp(host: str, port: int) -> Connect:
    """Return how to reach an SSH server over this computer's network."""
    return lambda timeout_s: socket.create_connection((host, port), timeout=timeout_s)


class Link:
    """A connection to one SSH server. `close` from another thread ends whatever waits here.

    Args:
        connect: Opens the stream; a backend decides by which way.
        timing: How long the kernel waits for the peer.

    Attributes:
        doing: What the server is to do next, for messages: `FIRST`, or `send its SSH banner`.
    """

    FIRST: Final = "accept the connection"

    def __init__(self, connect: Connect, timing: Timing) -> None:
        self.doing = self.FIRST
        self._connect = connect
        self._timing = timing
        self._lock = threading.Lock()
        self._closed = False
        self._stream: socket.socket | None = None
        self._transport: paramiko.Transport | None = None
        self._spares: list[Future[Channel]] = []

    @property
    def alive(self) -> bool:
        """Whether it is logged in and not known to be broken."""
        return not self._closed and self._transport is not None and self._transport.is_authenticated()

    def greet(self, kind: str) -> HostKey:
        """Connect, agree on keys, and return the server's host key: of type `kind` if it has one.

        Raises:
            OSError: The stream could not be opened, or broke.
            SSHException: The server speaks no SSH.
            UnfitServerError: It offers nothing that is safe.
            EOFError: It hung up.
        """
        stream = self._connect(self._timing.connect_s)
        _watch(stream, self._timing)
        transport = paramiko.Transport(stream, packetizer_class=_Packetizer)
        with self._lock:
            self._stream, self._transport = stream, transport
            if self._closed:
                stream.close()
        # Who waits for us keeps the deadline; these only must not come sooner.
        transport.banner_timeout = transport.auth_timeout = 2 * self._timing.connect_s
        kinds = sorted(_SIGNATURES, key=lambda one: one != kind)
        options = transport.get_security_options()
        options.key_types = [name for one in kinds for name in _SIGNATURES[one]]
        options.ciphers, options.digests = _safe(options.ciphers), _safe(options.digests)
        self.doing = "send its SSH banner"
        agreed = threading.Event()
        transport.start_client(event=agreed)
        while not agreed.wait(0.02):
            if transport.remote_version:
                self.doing = "agree on keys"
        if not transport.is_active():
            error = transport.get_exception() or EOFError("it hung up")
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
            ConfigurationError: There is no key to log in with.
            OSError, SSHException, EOFError: As `greet`.
        """
        pinned = credentials.host_key
        offered = self.greet(pinned.kind)
        if offered != pinned:
            raise HostKeyError(
                f"the host key changed: pinned {pinned.fingerprint}, offered {offered.fingerprint}",
                where=address.robot,
                remedy=f"do not go on, unless it was reinstalled: fieldkit enroll {address.robot} --replace",
            )
        self.doing = "answer the login"
        _, transport = self._up()
        count = 0
        for attempt in _attempts(transport, address, credentials):
            with contextlib.suppress(paramiko.AuthenticationException):
                attempt()
            if transport.is_authenticated():
                self.replenish()
                return
            if not transport.is_active():  # a server also hangs up on the sixth wrong key
                break
            count += 1
        if not count:
            raise EOFError("it hung up")
        raise _refused(address, credentials, count)

    def begin(self, command: str, deadline: Deadline, ended: threading.Event) -> Channel:
        """Return the channel of a command that the server has accepted.

        Raises:
            ExpiredError: The deadline passed, or `ended` was set.
            OSError, SSHException, EOFError: The connection broke.
        """
        _, transport = self._up()
        channel = bounded(lambda: self._channel(transport), deadline, ended, what="get a channel")
        bounded(lambda: channel.exec_command(command), deadline, ended, what="start")
        self.acknowledge()
        assert isinstance(transport.packetizer, _Packetizer)
        # From now on no packet more than necessary: a radio under test may be measured.
        transport.packetizer.acknowledges = False
        return channel

    def acknowledge(self) -> None:
        """Acknowledge what the robot said now, so that no late acknowledgement meets what its command sends."""
        stream, _ = self._up()
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def endure(self, seconds: float) -> None:
        """Let the peer be silent for so many seconds more than else, before the kernel takes it for gone."""
        stream, _ = self._up()
        _bear(stream, self._timing.dead_s + seconds)

    def replenish(self) -> None:
        """Begin to open channels for commands to come, so that none waits for its own: call when a command ended.

        Not when one begins: the answers would meet what it sends.
        """
        _, transport = self._up()
        if _hangs_up(transport):
            return
        with self._lock:
            wanted = max(0, SPARES - len(self._spares))
            self._spares += [self._opening(transport) for _ in range(wanted)]

    def settle(self, deadline: Deadline) -> None:
        """Wait until no channel is being opened ahead, or the deadline has passed."""
        with self._lock:
            spares = list(self._spares)
        wait(spares, timeout=deadline.remaining_s)

    def another(self) -> Channel | None:
        """Return a channel beside the spare ones; None where the server has no room for it.

        Raises:
            OSError, SSHException, EOFError: The connection broke, or the server refuses more.
        """
        _, transport = self._up()
        if _hangs_up(transport):
            return None
        with self._lock:
            spares = list(self._spares)
        for spare in spares:
            spare.result()  # a server that keeps to few has none for this
        return self._open(transport)

    def _channel(self, transport: paramiko.Transport) -> Channel:
        """Return an open channel: a spare one, unless the server keeps to fewer or has closed it."""
        while True:
            with self._lock:
                spare = self._spares.pop(0) if self._spares else None
            if spare is None:
                return self._open(transport)
            with contextlib.suppress(NoSessionError):
                if not (channel := spare.result()).closed:
                    return channel

    def _opening(self, transport: paramiko.Transport) -> "Future[Channel]":
        future: Future[Channel] = Future()

        def work() -> None:
            try:
                future.set_result(self._open(transport))
            except BROKEN as error:
                future.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        return future

    def _open(self, transport: paramiko.Transport) -> Channel:
        try:
            channel = transport.open_session(timeout=self._channel_s)
        except paramiko.SSHException as error:
            # Of two channels that are refused at once, paramiko gives the reason to one.
            if isinstance(error, paramiko.ChannelException) or _REFUSED in str(error):
                raise NoSessionError(getattr(error, "text", "it gives no reason")) from error
            raise
        window_bytes = transport.default_window_size
        channel.in_buffer, channel.in_stderr_buffer = _Pipe(window_bytes), _Pipe(window_bytes)
        return channel

    @property
    def _channel_s(self) -> float:
        """How long a channel may take: longer than who waits for it does."""
        return 2 * self._timing.connect_s

    def close(self) -> None:
        """End the connection, also while it is being made; what runs on the robot goes on."""
        with self._lock:
            self._closed = True
            stream, transport = self._stream, self._transport
        if stream is not None and transport is not None:
            transport.close()
            stream.close()

    def _up(self) -> tuple[socket.socket, paramiko.Transport]:
        if self._stream is None or self._transport is None:
            raise EOFError("not connected")
        return self._stream, self._transport


def _hangs_up(transport: paramiko.Transport) -> bool:
    """Whether the server hangs up over channels that are opened ahead.

    dropbear (2022.83) closes those that wait for a command when that of another ends.
    """
    return "dropbear" in transport.remote_version


def _safe(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in names if not any(word in name for word in _BROKEN_WORDS))


def _watch(stream: socket.socket, timing: Timing) -> None:
    """Let the kernel end the connection when the peer is gone, also while nothing is sent."""
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    _bear(stream, timing.dead_s)
    stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, timing.probe_s)
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, timing.probe_s)


def _bear(stream: socket.socket, seconds: float) -> None:
    """Let data or probes be unacknowledged for so long: with it set, Linux counts no probes (tcp(7))."""
    stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(seconds * 1000))


def _attempts(
    transport: paramiko.Transport, address: Address, credentials: Credentials
) -> Iterator[Callable[[], object]]:
    """Yield each way to log in."""
    user, password = address.user, credentials.password
    if password is not None:
        yield lambda: transport.auth_password(user, password)
        return
    for key in private_keys(credentials.private_key, where=address.robot):
        yield lambda key=key: transport.auth_publickey(user, key)  # type: ignore[misc]


def _refused(address: Address, credentials: Credentials, count: int) -> LoginRefusedError:
    if credentials.password is not None:
        by, remedy = "the password", f"ssh {address.by_hand}, and log in with that password"
    else:
        by, remedy = format_count(count, "key"), f"ssh-copy-id {address.by_hand}"
    return LoginRefusedError(
        f"refused the login of {address.user!r} with {by}",
        where=address.robot,
        remedy=f"{remedy}; is `user` right in the site file?",
    )
