"""The tests' own forwarder: what it calls a dead link is dead down to the acknowledgements."""

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from tests.helpers.forwarder import Forwarder

LONG_S = 60.0
DATA = bytes(range(256)) * 80_000  # more than all socket buffers on the way hold


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(LONG_S)
        yield listener


@pytest.fixture
def links(server: socket.socket) -> Iterator[Forwarder[str]]:
    with Forwarder({"robot": lambda timeout_s: socket.create_connection(server.getsockname(), timeout_s)}) as made:
        yield made


@pytest.fixture
def ends(links: Forwarder[str], server: socket.socket) -> Iterator[tuple[socket.socket, socket.socket]]:
    with ExitStack() as stack:
        near = stack.enter_context(links.reach("robot", LONG_S))
        far = stack.enter_context(server.accept()[0])
        far.settimeout(LONG_S)
        yield near, far


def receive_all(end: socket.socket) -> bytes:
    with end.makefile("rb") as file:
        return file.read()


def test_both_ways_arrive_whole_and_each_end_is_passed_on(ends: tuple[socket.socket, socket.socket]) -> None:
    near, far = ends

    def answer() -> None:
        far.sendall(receive_all(far))
        far.shutdown(socket.SHUT_WR)

    thread = threading.Thread(target=answer)
    thread.start()
    near.sendall(DATA)
    near.shutdown(socket.SHUT_WR)
    assert receive_all(near) == DATA
    thread.join()


def test_a_dead_link_acknowledges_nothing(links: Forwarder[str], ends: tuple[socket.socket, socket.socket]) -> None:
    near, _ = ends
    near.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 300)
    links.cut("robot")
    near.sendall(b"x")
    with pytest.raises(TimeoutError, match="Connection timed out"):
        near.recv(1)


def test_a_dead_link_passes_no_end_on_and_hangs_new_connections(
    links: Forwarder[str], ends: tuple[socket.socket, socket.socket]
) -> None:
    near, far = ends
    links.cut("robot")
    far.close()
    near.settimeout(0.3)
    with pytest.raises(TimeoutError):
        near.recv(1)
    with pytest.raises(TimeoutError):
        links.reach("robot", timeout_s=0.3)


def test_a_stream_goes_on_where_it_stood_when_the_link_comes_back(
    links: Forwarder[str], ends: tuple[socket.socket, socket.socket]
) -> None:
    near, far = ends
    thread = threading.Thread(target=far.sendall, args=(DATA,))
    thread.start()
    begun = bytearray(near.recv(1))
    links.cut("robot")
    near.settimeout(0.2)
    with suppress(TimeoutError):
        while data := near.recv(1 << 16):  # what was under way
            begun += data
    assert len(begun) < len(DATA)
    links.restore("robot")
    near.settimeout(LONG_S)
    while len(begun) < len(DATA):
        begun += near.recv(1 << 16)
    assert begun == DATA
    thread.join()


def test_a_dropped_stream_is_reset_and_a_new_one_carried(
    links: Forwarder[str], ends: tuple[socket.socket, socket.socket], server: socket.socket
) -> None:
    near, far = ends
    links.drop("robot")
    for end in (near, far):
        with pytest.raises(ConnectionResetError):
            end.recv(1)
    with links.reach("robot", LONG_S) as again, server.accept()[0] as there:
        again.sendall(b"x")
        assert there.recv(1) == b"x"


def test_a_far_side_that_is_not_there_resets(links: Forwarder[str], server: socket.socket) -> None:
    server.close()
    with pytest.raises(ConnectionResetError), links.reach("robot", LONG_S) as near:
        near.recv(1)
