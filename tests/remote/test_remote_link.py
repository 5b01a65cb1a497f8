"""A link that hangs, breaks and is restored: each wait has a timeout, and each command is completed."""

import contextlib
import errno
import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import paramiko
import pytest
from paramiko.common import AUTH_FAILED, AUTH_SUCCESSFUL, OPEN_SUCCEEDED

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError, LinkLostError, RobotError
from fieldkit.remote.keys import read_private_key
from fieldkit.remote.shell import Completed
from fieldkit.remote.sockets import Timing
from fieldkit.remote.ssh import SshShell
from tests.helpers.sshd import Server, wait_until

pytestmark = pytest.mark.emulated

SOON = 60.0
QUICK = Timing(connect_s=SOON, probe_s=1, dead_s=1.0, reply_s=SOON, pause_s=0.02)
HANGS_S = 1.5
"""Timeout for an event that does not occur."""


def soon() -> Deadline:
    return Deadline.after(SOON)


class DeadlineClock:
    """A clock of deadlines that advances only after a test causes a hang, so earlier steps have no timeout."""

    def __init__(self) -> None:
        self._created_s = time.monotonic()
        self._started_s: float | None = None

    def start(self) -> None:
        self._started_s = time.monotonic()

    def monotonic(self) -> float:
        now_s = time.monotonic()
        stopped_until_s = self._created_s + SOON if self._started_s is None else self._started_s
        return self._created_s + max(0.0, now_s - stopped_until_s)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> DeadlineClock:
    fake_clock = DeadlineClock()
    monkeypatch.setattr("fieldkit.core.deadline.time", fake_clock)
    return fake_clock


class HaltingServer(paramiko.ServerInterface):
    """An SSH server that stops at a request and reports it, or refuses logins."""

    def __init__(self, halt_point: str, on_request: Callable[[], None]) -> None:
        self.halt_point = halt_point
        self.on_request = on_request
        self.go = threading.Event()

    def halt(self, halt_point: str) -> None:
        if self.halt_point == halt_point:
            self.on_request()
            self.go.wait(SOON)

    def get_allowed_auths(self, username: str) -> str:
        return "publickey"

    def check_auth_publickey(self, username: str, key: paramiko.PKey) -> int:
        self.halt("auth")
        return AUTH_FAILED if self.halt_point == "refuse" else AUTH_SUCCESSFUL

    def check_channel_request(self, kind: str, chanid: int) -> int:
        self.halt("channel")
        return OPEN_SUCCEEDED

    def check_channel_exec_request(self, channel: paramiko.Channel, command: bytes) -> bool:
        self.halt("exec")
        if self.halt_point == "command":
            self.on_request()
        return True  # no command is run


class FakeServer:
    """Serves connections on loopback in sequence."""

    def __init__(self, serve: Callable[[socket.socket], object]) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.transports: list[object] = []
        self.serve = serve
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                stream, _ = self.listener.accept()
                self.transports.append((stream, self.serve(stream)))

    def connect(self, timeout_s: float) -> socket.socket:
        return socket.create_connection(self.listener.getsockname(), timeout=timeout_s)


def ssh_server(
    stream: socket.socket,
    key: paramiko.PKey,
    halt_point: str = "never",
    on_request: Callable[[], None] = lambda: None,
) -> paramiko.Transport:
    transport = paramiko.Transport(stream)
    transport.add_server_key(key)
    transport.start_server(event=threading.Event(), server=HaltingServer(halt_point, on_request))
    return transport


@pytest.fixture(scope="module")
def rsa() -> paramiko.RSAKey:
    return paramiko.RSAKey.generate(2048)


def pinned_key(key: paramiko.PKey) -> str:
    return f"{key.get_name()} {key.get_base64()}"


@pytest.fixture
def start_fake_server() -> Iterator[Callable[[Callable[[socket.socket], object]], FakeServer]]:
    servers: list[FakeServer] = []

    def start(serve: Callable[[socket.socket], object]) -> FakeServer:
        servers.append(FakeServer(serve))
        return servers[-1]

    yield start
    for fake_server in servers:
        fake_server.listener.close()


@pytest.mark.parametrize(
    ("halt_point", "message"),
    [
        ("banner", "robot did not send its SSH banner in time"),
        ("keys", "robot did not agree on keys in time"),
        ("auth", "robot did not answer the login in time"),
        ("channel", "`true` did not get a channel in time"),
        ("exec", "`true` did not start in time"),
        ("command", "`true` did not end in time"),
    ],
)
def test_any_hang_of_a_server_is_reported(
    server: Server,
    rsa: paramiko.RSAKey,
    start_fake_server: Callable[..., FakeServer],
    clock: DeadlineClock,
    *,
    halt_point: str,
    message: str,
) -> None:
    def serve(stream: socket.socket) -> object:
        if halt_point in {"banner", "keys"}:
            if halt_point == "keys":
                stream.sendall(b"SSH-2.0-halting\r\n")
            clock.start()
            return None
        return ssh_server(stream, rsa, halt_point, clock.start)

    shell = server.shell(connect=start_fake_server(serve).connect, host_key=pinned_key(rsa), timing=QUICK)
    with pytest.raises(LinkError, match=message) as error_info:
        shell.run(("true",), deadline=Deadline.after(HANGS_S))
    assert error_info.value.where == "robot"
    assert "ssh " in error_info.value.remedy
    shell.close()


def serve_flood(stream: socket.socket, key: paramiko.PKey, sent_sizes: list[int]) -> paramiko.Transport:
    """Serve a channel. After a command is requested, send data beyond the window of the channel without end."""

    def flood() -> None:
        packet = paramiko.Message()
        packet.add_byte(bytes((paramiko.common.MSG_CHANNEL_DATA,)))
        packet.add_int(transport._channels.values()[0].remote_chanid)  # type: ignore[attr-defined]
        packet.add_string(bytes(1 << 15))
        with contextlib.suppress(EOFError, OSError):
            while transport.is_active() and len(sent_sizes) < FLOOD_PACKETS:
                transport._send_message(packet)  # type: ignore[attr-defined]
                sent_sizes.append(1 << 15)

    transport = ssh_server(stream, key, "command", lambda: threading.Thread(target=flood, daemon=True).start())
    return transport


FLOOD_PACKETS = 2000
"""Number of packets in a flood of 64 MB."""


def test_flooding_server_does_not_fill_the_memory_while_nothing_is_read(
    server: Server, rsa: paramiko.RSAKey, start_fake_server: Callable[..., FakeServer]
) -> None:
    sent_sizes: list[int] = []
    fake_server = start_fake_server(lambda stream: serve_flood(stream, rsa, sent_sizes))
    shell = server.shell(connect=fake_server.connect, host_key=pinned_key(rsa), timing=QUICK, host="turtle.example")

    def run() -> None:
        session = shell.begin(("true",), deadline=soon())
        wait_until(lambda: not is_up(shell), soon())
        session.end(deadline=soon())

    with pytest.raises(
        RobotError, match="violated the SSH protocol during `true`: it sent more than its window"
    ) as error_info:
        run()
    assert "turtle.example" in error_info.value.remedy
    assert len(sent_sizes) < FLOOD_PACKETS, "the connection was closed"
    shell.close()


@pytest.mark.parametrize(
    ("flood", "message"),
    [
        (b"x" * 128, "its banner has more than 65536 bytes"),
        (b"SSH-2.0-x\r\n" + b"\x7f\xff\xff\xfc" * 1024, "announced a packet of"),
    ],
    ids=["banner", "packet"],
)
def test_flood_before_the_login_closes_the_connection(
    server: Server, start_fake_server: Callable[..., FakeServer], flood: bytes, message: str
) -> None:
    def serve(stream: socket.socket) -> object:
        def send() -> None:
            with contextlib.suppress(OSError):
                for _ in range(1 << 14):
                    stream.sendall(flood)

        threading.Thread(target=send, daemon=True).start()
        return None

    shell = server.shell(connect=start_fake_server(serve).connect, timing=QUICK)
    with pytest.raises(FieldkitError, match=message):
        shell.run(("true",), deadline=soon())


@pytest.mark.parametrize(
    ("option", "names", "message"),
    [
        ("ciphers", ("aes128-cbc", "3des-cbc"), "no acceptable ciphers"),
        ("digests", ("hmac-md5", "hmac-sha1-96"), "no acceptable macs"),
    ],
)
def test_login_to_a_server_with_only_weak_ciphers_is_rejected(
    server: Server,
    rsa: paramiko.RSAKey,
    start_fake_server: Callable[..., FakeServer],
    *,
    option: str,
    names: tuple[str, ...],
    message: str,
) -> None:
    def serve(stream: socket.socket) -> object:
        transport = paramiko.Transport(stream)
        setattr(transport.get_security_options(), option, names)
        transport.add_server_key(rsa)
        transport.start_server(event=threading.Event(), server=HaltingServer("never", lambda: None))
        return transport

    shell = server.shell(connect=start_fake_server(serve).connect, host_key=pinned_key(rsa), timing=QUICK)
    with pytest.raises(RobotError, match=f"is not secure enough for a login: {message}") as error_info:
        shell.run(("true",), deadline=soon())
    assert error_info.value.remedy.startswith("update it")


def test_hanging_name_resolution_has_a_timeout(server: Server) -> None:
    unset_event = threading.Event()

    def connect(timeout_s: float) -> socket.socket:
        unset_event.wait(SOON)
        return server.connect(timeout_s)

    shell = server.shell(connect=connect, timing=Timing(connect_s=HANGS_S), host="turtle.example")
    with pytest.raises(LinkLostError, match=r"turtle.example did not accept the connection in time") as error_info:
        shell.run(("true",), deadline=soon())
    assert error_info.value.remedy.startswith("ping -c 3 turtle.example")
    unset_event.set()


def test_hanging_ssh_agent_has_a_timeout(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: DeadlineClock
) -> None:
    with socket.socket(socket.AF_UNIX) as agent, ExitStack() as accepted_sockets:
        agent.bind(str(tmp_path / "agent"))
        agent.listen()

        def accept_request() -> None:
            accepted_sockets.enter_context(agent.accept()[0])
            clock.start()

        threading.Thread(target=accept_request, daemon=True).start()
        monkeypatch.setenv("SSH_AUTH_SOCK", str(tmp_path / "agent"))
        with pytest.raises(LinkLostError, match="did not answer the login in time"):
            server.shell(private_key=None, timing=QUICK).run(("true",), deadline=Deadline.after(HANGS_S))


def raise_on_connect(error: OSError) -> Callable[[float], socket.socket]:
    def connect(timeout_s: float) -> socket.socket:
        raise error

    return connect


@pytest.mark.parametrize(
    ("connect", "message", "command"),
    [
        (
            raise_on_connect(socket.gaierror(socket.EAI_NONAME, "Name or service not known")),
            "name cannot be resolved",
            "getent hosts robot",
        ),
        (raise_on_connect(ConnectionRefusedError()), "nothing listens on port 22", "sudo systemctl start ssh"),
        (
            raise_on_connect(OSError(errno.EHOSTUNREACH, "No route to host")),
            "there is no route to it",
            "ip route get robot",
        ),
        (raise_on_connect(TimeoutError("timed out")), "did not accept the connection in time", "ping -c 3 robot"),
        (
            raise_on_connect(OSError(errno.EPERM, "not permitted")),
            "cannot be reached for SSH: .*not permitted",
            "ping",
        ),
    ],
)
def test_reason_of_a_failed_connection_is_reported_immediately(
    server: Server, connect: Callable[[float], socket.socket], message: str, command: str
) -> None:
    timeouts_s: list[float] = []

    def connect_and_count(timeout_s: float) -> socket.socket:
        timeouts_s.append(timeout_s)
        return connect(timeout_s)

    with pytest.raises(LinkLostError, match=message) as error_info:
        server.shell(connect=connect_and_count).run(("true",), deadline=soon())
    assert error_info.value.remedy.startswith(command) or command in error_info.value.remedy
    assert len(timeouts_s) == 1, "the first connection is not retried"


def test_host_key_of_another_type_counts_as_changed(
    server: Server, rsa: paramiko.RSAKey, start_fake_server: Callable[..., FakeServer]
) -> None:
    shell = server.shell(connect=start_fake_server(lambda stream: ssh_server(stream, rsa)).connect)
    with pytest.raises(RobotError, match=r"host key changed: pinned SHA256:\S+, offered SHA256:\S+") as error_info:
        shell.run(("true",), deadline=soon())
    assert "fieldkit enroll robot --replace" in error_info.value.remedy


def test_too_many_keys_cause_a_refused_login(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "agent"
    with subprocess.Popen(("ssh-agent", "-D", "-a", str(path)), stdout=subprocess.DEVNULL) as agent:
        try:
            wait_until(path.exists, soon())
            monkeypatch.setenv("SSH_AUTH_SOCK", str(path))
            for number in range(8):
                key = tmp_path / f"key{number}"
                subprocess.run(("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)), check=True)
                subprocess.run(("ssh-add", "-q", str(key)), check=True)
            with pytest.raises(RobotError, match="refused the login of 'root' with 5 key"):
                server.shell(private_key=None).run(("true",), deadline=soon())
        finally:
            agent.terminate()


def test_key_file_with_a_passphrase_requires_the_agent(tmp_path: Path) -> None:
    path = tmp_path / "my key"
    subprocess.run(("ssh-keygen", "-q", "-t", "ed25519", "-N", "secret", "-f", str(path)), check=True)
    with pytest.raises(ConfigurationError, match="its private key has a passphrase") as error_info:
        read_private_key(str(path), where="robot")
    assert error_info.value.remedy.startswith(f"ssh-add '{path}', ")


@pytest.mark.parametrize(
    ("path", "command"),
    [
        ("~/.ssh/no such key", "ls -l ~/'.ssh/no such key'; "),
        ("~nobody-of-that-name/id", "ls -l '~nobody-of-that-name/id'; "),
    ],
)
def test_missing_key_file_is_reported_with_its_path(path: str, command: str) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read") as error_info:
        read_private_key(path, where="robot")
    assert error_info.value.remedy.startswith(command)


@pytest.mark.parametrize("content", [b"", b"\xff", b"ssh-ed25519 AAAA a public key"])
def test_key_file_without_a_key_is_reported(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=r"cannot be (read|used)") as error_info:
        read_private_key(str(path), where="robot")
    assert str(path) in error_info.value.remedy


class CuttableLine:
    """A connection to the server, which a test can cut, close and redirect."""

    def __init__(self, server: Server) -> None:
        self.connect_to = server.connect
        self.links: list[socket.socket] = []
        self.attempts = 0
        self.accepts_connections = True

    def connect(self, timeout_s: float) -> socket.socket:
        self.attempts += 1
        if not self.accepts_connections:
            raise ConnectionRefusedError
        self.links.append(self.connect_to(timeout_s))
        return self.links[-1]

    def cut(self) -> None:
        self.links[-1].shutdown(socket.SHUT_RDWR)


@pytest.fixture
def line(server: Server) -> CuttableLine:
    return CuttableLine(server)


@pytest.fixture
def notices() -> list[str]:
    return []


@pytest.fixture
def shell(server: Server, line: CuttableLine, notices: list[str]) -> Iterator[SshShell]:
    test_shell = server.shell(connect=line.connect, timing=QUICK, reconnect_timeout_s=SOON, on_notice=notices.append)
    yield test_shell
    test_shell.close()


def is_up(shell: SshShell) -> bool:
    link = shell._connection._link
    assert link is not None
    return link.alive


@pytest.fixture
def pool() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(2) as new_pool:
        yield new_pool


class WaitingCommand:
    """An idempotent command that records its starts, writes `part`, and writes `whole` when the file `go` exists.

    It exits when the folder of the test is deleted, because sshd does not terminate the command of a lost client.
    """

    def __init__(self, folder: Path) -> None:
        self.starts = folder / "starts"
        self.go = folder / "go"
        script = 'echo $$ >>"$0"; echo part; while [ -e "$0" -a ! -e "$1" ]; do sleep 0.02; done; echo whole'
        self.argv = ("sh", "-c", script, str(self.starts), str(self.go))

    def wait_for_starts(self, count: int, running: Future[Any] | None = None) -> None:
        """Wait until the command was started `count` times; raise the error of `running` if it ends before."""

        def is_reached() -> bool:
            if running is not None and running.done():
                raise AssertionError(f"the command ended early: {running.exception() or running.result()}")
            return self.starts.exists() and len(self.starts.read_text().split()) == count

        wait_until(is_reached, soon())


@pytest.fixture
def waiting_command(tmp_path: Path) -> Iterator[WaitingCommand]:
    command = WaitingCommand(tmp_path)
    yield command
    command.go.touch()


def test_command_whose_link_breaks_is_sent_again(
    shell: SshShell, line: CuttableLine, waiting_command: WaitingCommand, notices: list[str], pool: ThreadPoolExecutor
) -> None:
    future = pool.submit(shell.run, waiting_command.argv, deadline=soon())
    waiting_command.wait_for_starts(1)
    line.cut()
    waiting_command.wait_for_starts(2)
    waiting_command.go.touch()
    assert future.result(SOON).stdout == b"part\nwhole\n"
    assert len(notices) == 2
    assert notices[0].startswith("robot: the link is lost; trying again for ")
    assert notices[1].startswith("robot: the link is open again after ")


def test_link_that_breaks_before_the_expected_output_is_not_an_end(
    shell: SshShell, line: CuttableLine, waiting_command: WaitingCommand, pool: ThreadPoolExecutor
) -> None:
    command = pool.submit(shell.begin, waiting_command.argv, deadline=soon(), until=b"part\nwhole\n")
    waiting_command.wait_for_starts(1)
    line.cut()
    waiting_command.wait_for_starts(2)
    waiting_command.go.touch()
    session = command.result(SOON)
    assert session.is_ready
    assert session.end(deadline=soon()).exit_code == 0


def test_link_that_is_interrupted_is_restored(
    shell: SshShell, line: CuttableLine, waiting_command: WaitingCommand, notices: list[str], pool: ThreadPoolExecutor
) -> None:
    session = shell.begin(waiting_command.argv, deadline=soon())
    line.accepts_connections = False
    line.cut()
    wait_until(lambda: not is_up(shell), soon())
    deadline = Deadline.after(2.0)
    future = pool.submit(session.end, deadline=deadline)
    wait_until(lambda: line.attempts >= 4 and deadline.expired, soon())
    waiting_command.go.touch()
    line.accepts_connections = True
    assert future.result(SOON).stdout == b"part\nwhole\n", "the reply has a separate timeout after the deadline"
    assert [notice.split(";")[0] for notice in notices][:1] == ["robot: the link is lost"]
    assert len(notices) == 2


def test_two_commands_that_lose_one_link_are_sent_again_with_one_notice(
    shell: SshShell, line: CuttableLine, notices: list[str], pool: ThreadPoolExecutor, tmp_path: Path
) -> None:
    waiting_commands = [WaitingCommand(tmp_path / name) for name in ("a", "b")]
    for command in waiting_commands:
        command.go.parent.mkdir()
    future = [pool.submit(shell.run, command.argv, deadline=soon()) for command in waiting_commands]
    for command in waiting_commands:
        command.wait_for_starts(1)
    line.cut()
    for command in waiting_commands:
        command.wait_for_starts(2)
        command.go.touch()
    assert [command.result(SOON).stdout for command in future] == [b"part\nwhole\n"] * 2
    assert len(notices) == 2
    assert len(line.links) == 2


def test_session_that_detects_the_loss_later_uses_the_restored_link(
    shell: SshShell, line: CuttableLine, notices: list[str], tmp_path: Path
) -> None:
    waiting_commands = [WaitingCommand(tmp_path / name) for name in ("a", "b")]
    sessions = []
    for command in waiting_commands:
        command.go.parent.mkdir()
        sessions.append(shell.begin(command.argv, deadline=soon()))
    line.cut()
    for command in waiting_commands:
        command.go.touch()
    for session in sessions:
        assert session.end(deadline=soon()).stdout == b"part\nwhole\n"
    assert len(notices) == 2
    assert len(line.links) == 2


def test_robot_that_refuses_logins_while_it_boots_is_retried(
    server: Server, rsa: paramiko.RSAKey, start_fake_server: Callable[..., FakeServer], notices: list[str]
) -> None:
    logins: list[socket.socket] = []

    def serve(stream: socket.socket) -> object:
        logins.append(stream)
        return ssh_server(stream, rsa, "refuse" if len(logins) in {2, 3} else "never")

    fake_server = start_fake_server(serve)
    shell = server.shell(
        connect=fake_server.connect, host_key=pinned_key(rsa), timing=QUICK, on_notice=notices.append
    )
    shell.begin(("true",), deadline=soon())
    logins[0].shutdown(socket.SHUT_RDWR)
    wait_until(lambda: not is_up(shell), soon())
    shell.begin(("true",), deadline=soon())
    assert len(logins) == 4
    assert [re.split(";| after", notice)[0] for notice in notices] == [
        "robot: the link is lost",
        "robot: the link is open again",
    ]
    shell.close()


def test_fetch_starts_its_file_again(
    shell: SshShell, line: CuttableLine, waiting_command: WaitingCommand, tmp_path: Path, pool: ThreadPoolExecutor
) -> None:
    into = tmp_path / "into"
    future = pool.submit(shell.fetch, waiting_command.argv, into, deadline=soon(), limit_bytes=100)
    waiting_command.wait_for_starts(1)
    line.cut()
    waiting_command.wait_for_starts(2, future)
    waiting_command.go.touch()
    assert future.result(SOON).exit_code == 0
    assert into.read_bytes() == b"part\nwhole\n"


@pytest.mark.parametrize("other_takes_error", [False, True])
def test_slow_end_of_a_connection_is_not_a_signal(
    shell: SshShell,
    line: CuttableLine,
    waiting_command: WaitingCommand,
    pool: ThreadPoolExecutor,
    monkeypatch: pytest.MonkeyPatch,
    *,
    other_takes_error: bool,
) -> None:
    """On a busy computer, a connection may end long after its channels."""
    future = pool.submit(shell.run, waiting_command.argv, deadline=soon())
    waiting_command.wait_for_starts(1)
    link = shell._connection._link
    assert link is not None
    transport = link._transport
    assert transport is not None
    unlink = paramiko.Channel._unlink  # type: ignore[attr-defined]

    def unlink_and_wait(channel: paramiko.Channel) -> None:
        if channel.get_transport() is not transport:
            unlink(channel)
            return
        if other_takes_error:
            transport.get_exception()
        for channel_to_unlink in transport._channels.values():  # type: ignore[attr-defined]
            unlink(channel_to_unlink)
        wait_until(lambda: future.done() or len(waiting_command.starts.read_text().split()) == 2, soon())

    monkeypatch.setattr(paramiko.Channel, "_unlink", unlink_and_wait)
    line.cut()
    waiting_command.wait_for_starts(2, future)
    waiting_command.go.touch()
    assert future.result(SOON).stdout == b"part\nwhole\n"


@pytest.mark.parametrize("ended_by", ["the body", "its time"])
def test_link_over_the_radio_is_not_reopened_during_a_measurement(
    server: Server,
    line: CuttableLine,
    waiting_command: WaitingCommand,
    notices: list[str],
    *,
    pool: ThreadPoolExecutor,
    clock: DeadlineClock,
    ended_by: str,
) -> None:
    shell = server.shell(
        connect=line.connect, timing=QUICK, reconnect_timeout_s=SOON, on_notice=notices.append, crosses_radio=True
    )
    session = shell.begin(waiting_command.argv, deadline=soon())
    with shell.silence(SOON if ended_by == "the body" else HANGS_S):
        line.cut()
        future = pool.submit(session.end, deadline=soon())
        wait_until(lambda: bool(notices), soon())
        assert re.match(
            "robot: the link is lost; it is not reopened while its radio is being measured, for up to .*", notices[0]
        )
        assert line.attempts == 1
        if ended_by == "its time":
            clock.start()
            waiting_command.wait_for_starts(2)
        else:
            with pytest.raises(TimeoutError):
                future.result(HANGS_S)
            assert line.attempts == 1
    waiting_command.wait_for_starts(2)
    waiting_command.go.touch()
    assert future.result(SOON).stdout == b"part\nwhole\n"
    assert notices[1].startswith("robot: the link is open again after ")
    shell.close()


@pytest.mark.parametrize("crosses_radio", [True, False])
def test_timeout_of_a_link_over_the_radio_is_extended(server: Server, *, crosses_radio: bool) -> None:
    shell = server.shell(timing=QUICK, crosses_radio=crosses_radio)
    shell.run(("true",), deadline=soon())

    def user_timeout_ms() -> int:
        link = shell._connection._link
        assert link is not None
        assert link._stream is not None
        return link._stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)

    with shell.silence(30.0):
        assert user_timeout_ms() == (31_000 if crosses_radio else 1_000)
    assert user_timeout_ms() == 1_000
    shell.close()


def test_silence_lasts_until_the_latest_end(server: Server) -> None:
    """Concurrent steps share a shell, so the end of a step must not end the silence of another."""
    shell = server.shell(timing=QUICK, crosses_radio=True)
    shell.run(("true",), deadline=soon())
    connection = shell._connection
    link = connection._link
    assert link is not None
    stream = link._stream
    assert stream is not None

    def user_timeout_ms() -> int:
        return stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)

    longer, shorter = shell.silence(3000.0), shell.silence(30.0)
    with longer:
        with shorter:
            assert user_timeout_ms() > 2_900_000
        assert user_timeout_ms() > 2_900_000
        assert connection._silence_s() > 2_900
    assert user_timeout_ms() == 1_000
    assert not connection._silence_s()
    shell.close()


def test_patience_applies_once_per_loss_of_the_link(shell: SshShell, line: CuttableLine, server: Server) -> None:
    impatient_shell = server.shell(connect=line.connect, timing=QUICK, reconnect_timeout_s=2.0)
    assert impatient_shell.run(("echo", "up"), deadline=soon()).stdout == b"up\n"
    line.accepts_connections = False
    line.cut()
    with pytest.raises(LinkLostError, match="nothing listens"):
        impatient_shell.run(("true",), deadline=soon())
    attempts_before = line.attempts
    assert attempts_before > 2
    with pytest.raises(LinkLostError, match="nothing listens"):
        impatient_shell.run(("true",), deadline=soon())
    assert line.attempts == attempts_before + 1, "a single attempt without a wait"
    line.accepts_connections = True
    assert impatient_shell.run(("echo", "back"), deadline=soon()).stdout == b"back\n"
    impatient_shell.close()


def test_command_that_takes_too_long_is_not_sent_again(
    shell: SshShell, line: CuttableLine, waiting_command: WaitingCommand
) -> None:
    session = shell.begin(waiting_command.argv, deadline=soon())
    waiting_command.wait_for_starts(1)
    with pytest.raises(LinkError, match="did not end in time"):
        session.end(deadline=Deadline.after(0.1))
    assert len(waiting_command.starts.read_text().split()) == 1
    assert line.attempts == 1


def test_suspended_server_causes_a_timeout(shell: SshShell, line: CuttableLine) -> None:
    parent = int(shell.run(("sh", "-c", "echo $PPID"), deadline=soon()).stdout)
    os.kill(parent, signal.SIGSTOP)
    try:
        with pytest.raises(LinkError, match=r"did not (get a channel|start) in time"):
            shell.run(("true",), deadline=Deadline.after(0.3))
    finally:
        os.kill(parent, signal.SIGCONT)
    assert line.attempts == 1


def test_other_host_key_after_a_break_is_final(
    shell: SshShell,
    line: CuttableLine,
    waiting_command: WaitingCommand,
    rsa: paramiko.RSAKey,
    start_fake_server: Callable[..., FakeServer],
) -> None:
    session = shell.begin(waiting_command.argv, deadline=soon())
    line.connect_to = start_fake_server(lambda stream: ssh_server(stream, rsa)).connect
    line.cut()
    with pytest.raises(RobotError, match=r"host key changed: pinned SHA256:\S+, offered SHA256:\S+"):
        session.end(deadline=soon())
    assert line.attempts == 2, "there is no retry after the changed key"


def error_after_close(future: "Future[Completed]", shell: SshShell) -> FieldkitError:
    start_s = time.monotonic()
    shell.close()
    with pytest.raises(LinkError) as error_info:
        future.result(SOON)
    assert time.monotonic() - start_s < SOON / 4, "it must end before its deadline"
    return error_info.value


def test_close_ends_a_waiting_command(
    shell: SshShell, waiting_command: WaitingCommand, pool: ThreadPoolExecutor
) -> None:
    future = pool.submit(shell.run, waiting_command.argv, deadline=soon())
    waiting_command.wait_for_starts(1)
    assert "fieldkit closed the connection" in str(error_after_close(future, shell))


def test_close_ends_the_wait_for_a_lost_link(
    server: Server, line: CuttableLine, waiting_command: WaitingCommand, notices: list[str], pool: ThreadPoolExecutor
) -> None:
    shell = server.shell(connect=line.connect, reconnect_timeout_s=60.0, on_notice=notices.append)
    future = pool.submit(shell.run, waiting_command.argv, deadline=soon())
    waiting_command.wait_for_starts(1)
    line.accepts_connections = False
    line.cut()
    wait_until(lambda: len(notices) == 1, soon())
    assert "fieldkit closed the connection" in str(error_after_close(future, shell))
    line.accepts_connections = True
    assert shell.run(("echo", "new"), deadline=soon()).stdout == b"new\n", "a closed shell can be used again"
    shell.close()


def test_close_ends_a_hanging_login(
    server: Server, start_fake_server: Callable[..., FakeServer], pool: ThreadPoolExecutor
) -> None:
    silent_server = start_fake_server(lambda stream: None)
    shell = server.shell(connect=silent_server.connect)
    future = pool.submit(shell.run, ("true",), deadline=soon())
    wait_until(lambda: len(silent_server.transports) == 1, soon())
    assert "fieldkit closed the connection" in str(error_after_close(future, shell))


@pytest.mark.quiet
def test_close_returns_quickly(shell: SshShell, waiting_command: WaitingCommand, pool: ThreadPoolExecutor) -> None:
    future = pool.submit(shell.run, waiting_command.argv, deadline=soon())
    waiting_command.wait_for_starts(1)
    start_s = time.monotonic()
    shell.close()
    with pytest.raises(LinkError):
        future.result(SOON)
    assert time.monotonic() - start_s < 1.0


class CountingSocket(socket.socket):
    """Counts requests for quick acknowledgement."""

    requests = 0

    def setsockopt(self, *option: Any) -> None:  # noqa: ANN401 (options of several types)
        self.requests += option[:2] == (socket.IPPROTO_TCP, socket.TCP_QUICKACK)
        super().setsockopt(*option)


def test_quick_acknowledgement_in_handshakes_and_at_starts_of_commands_only(server: Server) -> None:
    """A server with Nagle's algorithm waits 40 ms otherwise. Additional packets would cross the radio under test."""
    streams = []

    def connect(timeout_s: float) -> socket.socket:
        stream = CountingSocket()
        streams.append(stream)
        stream.settimeout(timeout_s)
        stream.connect(("127.0.0.1", server.port))
        return stream

    with contextlib.closing(server.shell(connect=connect)) as shell:
        shell.run(("true",), deadline=Deadline.after(60))
        (stream,) = streams
        assert stream.requests > 8, "there is a request after each message of the handshake and the login"
        before = stream.requests
        shell.run(("true",), deadline=Deadline.after(60))
        assert stream.requests - before <= 2, "there is no request after each message"
