"""The UDP socket by which init detects that the routing daemon is ready."""

import socket

from sim_backends.emulated.robot import network
from tests.helpers.sshd import free_port


def test_a_socket_is_found_while_it_is_bound() -> None:
    port = free_port()
    assert not network.has_udp6_socket(port)
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as bound_socket:
        bound_socket.bind(("", port))
        assert network.has_udp6_socket(port)
    assert not network.has_udp6_socket(port)
