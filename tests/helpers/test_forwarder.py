"""Tests of the forwarder that other tests use; a cut link does not even send acknowledgements."""

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from tests.helpers.forwarder import Forwarder

TIMEOUT_S = 60.0
DATA = bytes(range(256)) * 80_000  # larger than all socket buffers on the path together


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(TIMEOUT_S)
        yield listener


@pytest.fixture
def links(server: socket.socket) -> Iterator[Forwarder[str]]:
    with Forwarder(
        {"robot": lambda timeout_s: socket.create_connection(server.getsockname(), timeout_s)}
    ) as forwarder:
        yield forwarder


@pytest.fixture
def ends(links: Forwarder[str], server: socket.socket) -> Iterator[tuple[socket.socket, socket.socket]]:
    with ExitStack() as stack:
        client = stack.enter_context(links.reach("robot", TIMEOUT_S))
        server_end = stack.enter_context(server.accept()[0])
        server_end.settimeout(TIMEOUT_S)
        yield client, server_end


def receive_all(end: socket.socket) -> bytes:
    with end.makefile("rb") as file:
        return file.read()


def test_both_directions_and_both_stream_ends_are_forwarded(ends: tuple[socket.socket, socket.socket]) -> None:
    client, server_end = ends

    def echo() -> None:
        server_end.sendall(receive_all(server_end))
        server_end.shutdown(socket.SHUT_WR)

    thread = threading.Thread(target=echo)
    thread.start()
    client.sendall(DATA)
    client.shutdown(socket.SHUT_WR)
    assert receive_all(client) == DATA
    thread.join()


def test_a_cut_link_sends_no_acknowledgements(
    links: Forwarder[str], ends: tuple[socket.socket, socket.socket]
) -> None:
    client, _ = ends
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 300)
    links.cut("robot")
    client.sendall(b"x")
    with pytest.raises(TimeoutError, match="Connection timed out"):
        client.recv(1)


def test_a_cut_link_forwards_no_stream_end_and_new_connections_hang(
    links: Forwarder[str], ends: tuple[socket.socket, socket.socket]
) -> None:
    client, server_end = ends
    links.cut("robot")
    server_end.close()
    client.settimeout(0.3)
    with pytest.raises(TimeoutError):
        client.recv(1)
    with pytest.raises(TimeoutError):
        links.reach("robot", timeout_s=0.3)


def test_a_stream_continues_when_the_link_is_restored(
    links: Forwarder[str], ends: tuple[socket.socket, socket.socket]
) -> None:
    client, server_end = ends
    thread = threading.Thread(target=server_end.sendall, args=(DATA,))
    thread.start()
    received_data = bytearray(client.recv(1))
    links.cut("robot")
    client.settimeout(0.2)
    with suppress(TimeoutError):
        while data := client.recv(1 << 16):  # data in transit
            received_data += data
    assert len(received_data) < len(DATA)
    links.restore("robot")
    client.settimeout(TIMEOUT_S)
    while len(received_data) < len(DATA):
        received_data += client.recv(1 << 16)
    assert received_data == DATA
    thread.join()


def test_a_dropped_stream_is_reset_and_a_new_one_is_forwarded(
    links: Forwarder[str], ends: tuple[socket.socket, socket.socket], server: socket.socket
) -> None:
    client, server_end = ends
    links.drop("robot")
    for end in (client, server_end):
        with pytest.raises(ConnectionResetError):
            end.recv(1)
    with links.reach("robot", TIMEOUT_S) as new_client, server.accept()[0] as new_server_end:
        new_client.sendall(b"x")
        assert new_server_end.recv(1) == b"x"


def test_an_unreachable_endpoint_resets_the_stream(links: Forwarder[str], server: socket.socket) -> None:
    server.close()
    with pytest.raises(ConnectionResetError), links.reach("robot", TIMEOUT_S) as client:
        client.recv(1)
