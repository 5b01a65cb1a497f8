"""A federate that fails, is silent, or sends garbage is named with its last time and the pending request."""

import os
import random
import shlex
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import pytest

from docs.generator.federate_frames import example_frames
from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.answering import FederateService, serve_channel
from sim_backends.federates.channels import ClosedError, DeadlineError, StreamChannel
from sim_backends.federates.frames import HEADER_BYTES, NETWORK, PHYSICS, MessageKind, encode
from sim_backends.federates.handshake import Hello, encode_join
from sim_backends.federates.protocols import FederateError, UnansweredError
from sim_backends.federates.remote import RemotePhysics, open_network, open_physics
from sim_backends.federates.serving import serve
from sim_backends.federates.session import FederateSession
from sim_backends.federates.transports.contract import TOKEN_VARIABLE
from sim_backends.federates.transports.joining import join
from sim_backends.federates.transports.tcp import TcpAddress
from sim_backends.physics.body import Twist
from sim_backends.world.motion import State
from tests.helpers.federate_examples import EXAMPLES, carts
from tests.helpers.federate_pairs import HELLO, Alter, Pair, channel_of, children, now_s
from tests.helpers.sshd import free_port

MS = 1_000_000
REQUESTS = ("advance physics", "ping", "fork", "release", "advance physics", "bye")
CARTS = shlex.join((sys.executable, str(EXAMPLES / "carts.py")))


def remote_carts(alter: Alter) -> RemotePhysics:
    return RemotePhysics(*Pair(FederateService(carts(), name="carts"), alter=alter)(HELLO))


@pytest.fixture(autouse=True)
def no_process_remains() -> Iterator[None]:
    start_s = now_s()
    yield
    assert children(start_s) == set()


def alter_from_second_states(alter: Callable[[bytes], bytes | None]) -> Alter:
    """Return a function that changes the second and later states."""
    count = 0

    def alter_later_states(frame: bytes) -> bytes | None:
        nonlocal count
        count += frame[4] == MessageKind.STATES
        return alter(frame) if count > 1 else frame

    return alter_later_states


@pytest.mark.parametrize(
    ("alter", "error", "message"),
    [
        (lambda frame: None, UnansweredError, "has not answered for 0.3 s: request to advance from 0 s to 0.0011 s"),
        (
            lambda frame: b"garbage" * 9,
            FederateError,
            "to advance from 0 s to 0.0011 s, with a malformed frame: byte 4: there is no kind of message 26465",
        ),
        (lambda frame: struct.pack("<I", 1 << 31) + frame[4:], FederateError, "byte 0: a size of 2147483648 bytes"),
        (lambda frame: frame[:8] + b"\7\0\0\0" + frame[12:], FederateError, "byte 8: it is for request 7 and copy 0"),
        (lambda frame: encode(MessageKind.DONE, 3, 0), FederateError, "byte 4: it is done, not states"),
        (
            lambda frame: encode(MessageKind.STATES, 3, 0, frame[HEADER_BYTES:-1]),
            FederateError,
            "byte 28: 3 items of at least",
        ),
        (
            lambda frame: encode(MessageKind.ERROR, 3, 0, b"\3\0a\nb"),
            FederateError,
            "request to advance from 0 s to 0.0011 s: a b",
        ),
    ],
)
def test_an_error_names_the_federate_the_request_and_the_byte(
    alter: Alter, error: type[Exception], message: str
) -> None:
    physics = remote_carts(alter_from_second_states(alter))
    physics.advance(0, {})
    if error is UnansweredError:
        physics.session._deadline_s = 0.3
    with pytest.raises(error) as error_info:
        physics.advance(1_100_000, {"ann": Twist(0.5)})
    text = str(error_info.value)
    assert message in text
    assert text.startswith("physics carts (test) ")
    with pytest.raises(FederateError, match="the connection to physics carts"):
        physics.advance(2 * MS, {})


def test_a_timeout_has_the_last_time() -> None:
    physics = remote_carts(alter_from_second_states(lambda frame: None))
    physics.advance(0, {})
    physics.session._deadline_s = 0.3
    with pytest.raises(UnansweredError, match="; its last time is 0 s") as error_info:
        physics.advance(5 * MS, {})
    assert error_info.value.exit_code == 3


class SlowPhysics:
    """A physics federate that needs longer than the deadline for its third answer."""

    step_ns = MS
    limits_m_s2: Mapping[str, float] = MappingProxyType({})

    def __init__(self, hello: object) -> None:
        self._calls = 0

    def advance(self, to_ns: int, commands: object) -> dict[str, object]:
        self._calls += 1
        if self._calls == 3:
            time.sleep(3.0)
        return {agent.name: agent.start for agent in HELLO.agents}


def test_a_federate_that_sends_heartbeats_may_need_longer_than_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    hello = replace(HELLO, heartbeat_ms=50)
    physics = RemotePhysics(*Pair(FederateService(SlowPhysics), deadline_s=1.5)(hello))
    physics.advance(0, {})
    physics.advance(2 * MS, {})
    physics.advance(3 * MS, {})
    monkeypatch.setattr("sim_backends.federates.session.BUSY_DEADLINE_FACTOR", 1)
    physics_without_patience = RemotePhysics(*Pair(FederateService(SlowPhysics), deadline_s=1.5)(hello))
    physics_without_patience.advance(0, {})
    physics_without_patience.advance(2 * MS, {})
    with pytest.raises(UnansweredError, match=r"its last time is 0.002 s; it last reported 0.002 s"):
        physics_without_patience.advance(3 * MS, {})


def test_a_federate_whose_heartbeats_end_is_reported_after_one_deadline() -> None:
    counts = Counter[int]()

    def drop_later_frames(frame: bytes) -> bytes | None:
        counts[frame[4]] += 1
        is_late = counts[MessageKind.STATES] == 2 and counts[MessageKind.BUSY] > 1
        return None if is_late or counts[MessageKind.STATES] > 2 else frame

    service = FederateService(SlowPhysics)
    physics = RemotePhysics(*Pair(service, deadline_s=1.5, alter=drop_later_frames)(replace(HELLO, heartbeat_ms=50)))
    physics.advance(0, {})
    physics.advance(2 * MS, {})
    counts[MessageKind.BUSY] = 0
    with pytest.raises(UnansweredError, match=r"has sent neither an answer nor a heartbeat for 1\.5 s: request to"):
        physics.advance(3 * MS, {})


@pytest.mark.parametrize(
    ("signal_number", "message"),
    [
        (signal.SIGKILL, "the connection was closed; its last time is 0 s; it was terminated by SIGKILL"),
        (signal.SIGSTOP, "has not answered for 2 s: request to advance from 0 s to 0.003 s"),
    ],
)
def test_a_child_that_is_killed_or_suspended_is_named_and_terminated(
    signal_number: signal.Signals, message: str
) -> None:
    start_s = now_s()
    physics = open_physics(CARTS, HELLO, 20.0)
    physics.advance(0, {})
    physics.session._deadline_s = 2.0
    (pid,) = children(start_s)
    os.kill(pid, signal_number)
    with pytest.raises(FederateError, match=r"^physics carts \(.*carts.py'?\) ") as error_info:
        physics.advance(3 * MS, {})
    assert message in str(error_info.value)


def test_a_federate_that_fieldkit_has_not_started_is_named_and_not_terminated() -> None:
    port = free_port()
    process = subprocess.Popen([*shlex.split(CARTS), f"tcp-listen:127.0.0.1:{port}"])
    try:
        with closing(open_physics(f"tcp:127.0.0.1:{port}", HELLO, 20.0)) as physics:
            physics.advance(0, {})
        physics = open_physics(f"tcp:127.0.0.1:{port}", HELLO, 20.0)
        physics.advance(0, {})
        physics.session._deadline_s = 1.0
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(
            UnansweredError, match=rf"physics carts \(tcp:127.0.0.1:{port}\) has not answered for 1 s"
        ):
            physics.advance(MS, {})
        process.send_signal(signal.SIGCONT)
        physics = open_physics(f"tcp:127.0.0.1:{port}", HELLO, 20.0)
        process.kill()
        with pytest.raises(FederateError, match="the connection was closed"):
            physics.advance(MS, {})
    finally:
        process.kill()
        process.wait()


def test_a_child_that_fails_shows_its_last_output(tmp_path: Path) -> None:
    program = tmp_path / "fails.py"
    program.write_text("import sys\nprint('no licence', file=sys.stderr)\nsys.exit(7)\n", encoding="utf-8")
    with pytest.raises(FederateError, match=r"it has exited with code 7; its last output: no licence"):
        open_physics(shlex.join((sys.executable, str(program))), HELLO, 20.0)
    program.write_text("import sys\nsys.exit('\\n'.join(f'at line {n}\\x1b' for n in range(20)))\n", encoding="utf-8")
    with pytest.raises(FederateError) as error_info:
        open_physics(shlex.join((sys.executable, str(program))), HELLO, 20.0)
    lines = "".join(f"\n    at line {number} " for number in range(10, 20))
    assert error_info.value.what.endswith(f"it has exited with code 1; its last output:{lines}")
    with pytest.raises(ConfigurationError, match="the federate /nowhere/at-all cannot be started"):
        open_physics("/nowhere/at-all", HELLO, 20.0)


def test_a_child_that_prints_to_its_standard_output_is_an_error_with_a_remedy() -> None:
    with pytest.raises(FederateError, match="byte 4: there is no kind of message") as error_info:
        open_physics("sh -c 'echo loading the world ...; exec cat >/dev/null'", HELLO, 20.0)
    assert error_info.value.remedy == "standard output carries only frames; print to standard error"


def test_an_unknown_scheme_shows_the_addresses() -> None:
    with pytest.raises(ConfigurationError, match=r"'quic:127.0.0.1:7000' is not an address") as error_info:
        open_physics("quic:127.0.0.1:7000", HELLO, 20.0)
    assert error_info.value.remedy.startswith("use tcp:HOST:PORT, tcp-listen:HOST:PORT, udp:HOST:PORT, ")
    assert error_info.value.remedy.endswith(", or a command, for example 'python3 carts.py'")


def test_output_of_the_federates_code_does_not_reach_the_protocol(tmp_path: Path) -> None:
    program = tmp_path / "chatty.py"
    program.write_text(
        f"import os, runpy, subprocess, sys\n"
        f"from sim_backends.federates.serving import serve\n"
        f"Carts = runpy.run_path({str(EXAMPLES / 'carts.py')!r})['Carts']\n"
        "class Chatty(Carts):\n"
        "    def advance(self, to_ns, commands):\n"
        "        print('advance', to_ns, flush=True)\n"
        "        os.write(1, b'raw')\n"
        "        assert sys.stdin.read() == ''\n"
        "        return super().advance(to_ns, commands)\n"
        "serve(Chatty)\n",
        encoding="utf-8",
    )
    with closing(open_physics(shlex.join((sys.executable, str(program))), HELLO, 20.0)) as physics:
        for step in range(5):
            assert physics.advance(step * MS, {}).keys() == {"ann", "bob", "cy"}
        assert physics.session._child is not None
        assert "raw" in "".join(physics.session._child.last_output)


def start_server(address: str, **settings: object) -> threading.Thread:
    thread = threading.Thread(target=lambda: serve(carts(), address=address, runs=1, **settings), daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize("coordinator_first", [True, False])
@pytest.mark.parametrize("federate_listens", [True, False])
def test_either_side_may_listen_and_start_first(*, federate_listens: bool, coordinator_first: bool) -> None:
    port = free_port()
    schemes = ("tcp-listen", "tcp") if federate_listens else ("tcp", "tcp-listen")
    address, other_address = (f"{scheme}:127.0.0.1:{port}" for scheme in schemes)
    if coordinator_first:
        timer = threading.Timer(0.15, start_server, [address])
        timer.start()
    else:
        start_server(address)
    with closing(open_physics(other_address, HELLO, 20.0)) as physics:
        assert physics.advance(0, {})["ann"] == HELLO.agents[0].start


def test_heartbeats_are_shorter_than_the_deadline() -> None:
    port = free_port()
    hellos: list[Hello] = []

    def make(hello: Hello) -> object:
        hellos.append(hello)
        return StationaryPhysics(hello)

    threading.Thread(target=lambda: serve(make, address=f"tcp-listen:127.0.0.1:{port}", runs=2), daemon=True).start()
    for deadline_s in (2.0, 20.0):
        open_physics(f"tcp:127.0.0.1:{port}", HELLO, deadline_s).close()
    assert [hello.heartbeat_ms for hello in hellos] == [500, 1000]


def test_a_token_is_needed_beyond_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    for address in ("tcp:192.0.2.1:7000", "tcp-listen:0.0.0.0:7000"):
        with pytest.raises(ConfigurationError, match="there is no token"):
            open_physics(address, HELLO, 1.0)
    with pytest.raises(ConfigurationError, match="is not an address"):
        open_physics("tcp:localhost", HELLO, 1.0)


def test_a_federate_refuses_a_wrong_token(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    monkeypatch.setenv(TOKEN_VARIABLE, "right")
    thread = threading.Thread(target=_serve_once, args=(port,), daemon=True)
    with TcpAddress("tcp", "127.0.0.1", port).listen() as listener:
        thread.start()
        with closing(listener.accept(time.monotonic() + 20)) as channel:
            channel.receive(time.monotonic() + 20)  # join
            session = FederateSession(PHYSICS, "test", channel, deadline_s=20.0)
            with pytest.raises(FederateError, match="PermissionError: the token is wrong"):
                session.welcome(replace(HELLO, token="wrong"))
    thread.join(20)


def _serve_once(port: int) -> None:
    with suppress(SystemExit):
        serve(carts(), address=f"tcp:127.0.0.1:{port}")


def test_other_programs_are_rejected_and_the_wait_continues(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, "right")
    port = free_port()
    address = TcpAddress("tcp", "127.0.0.1", port, listens=True)

    def connect_all() -> None:
        for data in (
            b"GET / HTTP/1.1\r\n\r\n",
            encode(MessageKind.JOIN, 0, 0, encode_join("wrong")),
            encode(MessageKind.BYE, 0, 0),
        ):
            with socket.create_connection(("127.0.0.1", port)) as connection:
                connection.sendall(data)
                assert connection.recv(1) == b""  # nothing is sent to it, not even the token
        channel = TcpAddress("tcp", "127.0.0.1", port).connect(time.monotonic() + 20)
        join(channel, "right", time.monotonic() + 20)
        serve_channel(channel, FederateService(carts()), "right")

    threading.Timer(0.1, connect_all).start()
    with closing(open_physics(str(address), HELLO, 20.0)) as physics:
        assert physics.advance(0, {})


def test_no_connection_within_the_deadline_is_an_error() -> None:
    port = free_port()
    for scheme, message in (
        ("tcp", "no connection to tcp:127"),
        ("tcp-listen", "no federate has connected to tcp-l"),
    ):
        with pytest.raises(UnansweredError, match=message):
            open_physics(f"{scheme}:127.0.0.1:{port}", HELLO, 0.2)


def test_the_error_about_a_missing_connection_has_the_reason_of_the_last_rejection() -> None:
    port = free_port()

    def connect() -> None:
        channel = TcpAddress("tcp", "127.0.0.1", port).connect(time.monotonic() + 20)
        join(channel, "wrong", time.monotonic() + 20)

    threading.Timer(0.1, connect).start()
    message = r"no federate has connected to \S+ \(a program without the right token was rejected\) within 2 s"
    with pytest.raises(UnansweredError, match=message):
        open_physics(f"tcp-listen:127.0.0.1:{port}", HELLO, 2.0)


def test_a_federate_of_the_other_role_is_named() -> None:
    with pytest.raises(FederateError, match="it is a physics federate, but a network federate was requested"):
        open_network(CARTS, replace(HELLO, role=NETWORK), 20.0)
    assert HELLO.role == PHYSICS


class StationaryPhysics:
    """A physics federate whose robots do not move."""

    step_ns = MS
    limits_m_s2: Mapping[str, float] = MappingProxyType({})

    def __init__(self, hello: Hello) -> None:
        self._states = {agent.name: agent.start for agent in hello.agents}

    def advance(self, to_ns: int, commands: object) -> dict[str, State]:
        return self._states


def mutate(frame: bytes, rng: random.Random) -> bytes:
    data = bytearray(frame)
    for _ in range(rng.randint(1, 4)):
        data[rng.randrange(len(data))] = rng.choice((0, 1, 0x7F, 0xFF, rng.randrange(256)))
    return bytes(data[: rng.choice((len(data), len(data), rng.randrange(len(data) + 1)))])


def test_mutated_requests_end_the_session_of_a_federate_or_are_answered() -> None:
    frames = [encode(MessageKind.HELLO, 1, 0, HELLO.encode()), *(example_frames()[name] for name in REQUESTS)]
    for seed in range(80):
        rng = random.Random(seed)
        peer, other = socket.socketpair()
        channel = channel_of(other)
        thread = threading.Thread(
            target=serve_channel, args=(channel, FederateService(StationaryPhysics)), daemon=True
        )
        thread.start()
        mutated_number = rng.randrange(len(frames))
        with peer, suppress(BrokenPipeError, ConnectionResetError):
            for number, frame in enumerate(frames):
                peer.sendall(mutate(frame, rng) if number == mutated_number else frame)
            peer.shutdown(socket.SHUT_WR)
        thread.join(20)
        assert not thread.is_alive(), seed
        channel.close()


def test_mutated_answers_raise_only_errors_that_name_the_federate() -> None:
    for seed in range(80):
        rng = random.Random(seed)
        alter = alter_from_second_states(lambda frame, rng=rng: mutate(frame, rng))  # type: ignore[misc]
        physics = RemotePhysics(
            *Pair(FederateService(StationaryPhysics, name="still"), alter=alter, deadline_s=0.05)(HELLO)
        )
        try:
            for step in range(4):
                physics.advance(step * MS, {})
        except FederateError as error:
            assert "physics still (test)" in error.what  # noqa: PT017 (a mutation may also be valid)
        physics.close()


def test_a_full_channel_reaches_the_deadline_of_its_writer() -> None:
    peer, other = socket.socketpair()
    with closing(StreamChannel(peer.fileno(), peer.fileno())) as channel, other:
        with pytest.raises(DeadlineError):
            channel.send(bytes(1 << 24), time.monotonic() + 0.1)
        peer.detach()
    with pytest.raises(ClosedError):
        channel.receive(time.monotonic() + 1)


def test_a_closed_channel_does_not_write_to_a_file_with_the_same_descriptor(monkeypatch: pytest.MonkeyPatch) -> None:
    peer, other = socket.socketpair()
    with other:
        channel = StreamChannel(other.detach(), peer.fileno())
        channel.close()
        peer.detach()
        file, writer = socket.socketpair()
        with file, writer:
            monkeypatch.setattr(channel, "_write_fd", writer.fileno())  # as if the kernel had reused the descriptor
            with pytest.raises(ClosedError):
                channel.send(b"frame", time.monotonic() + 1)
            file.setblocking(False)
            with pytest.raises(BlockingIOError):
                file.recv(1)
