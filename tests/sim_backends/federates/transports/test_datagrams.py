"""The UDP transport: lost, repeated and reordered datagrams, and datagrams of programs without a cookie."""

import random
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any

import pytest

from sim_backends.federates.channels import ClosedError, DeadlineError, FrameChannel
from sim_backends.federates.exchanges import encode_number
from sim_backends.federates.frames import MessageKind, encode
from sim_backends.federates.transports import datagrams
from sim_backends.federates.transports.datagrams import (
    DATAGRAM_HEADER_BYTES,
    MAX_DATAGRAM_BYTES,
    DatagramHeader,
    DatagramKind,
    RetransmissionTimer,
    pack_datagram,
    unpack_datagram,
)
from sim_backends.federates.transports.udp_transport import UdpAddress
from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT
from tests.helpers.sshd import free_port

Forward = Callable[[bytes, bool], list[bytes]]
"""Returns the datagrams that the network delivers for a datagram; the flag is True towards the listening side."""


def deadline_after(duration_s: float) -> float:
    return time.monotonic() + duration_s


class Network:
    """A UDP relay between the two sides of a connection.

    Args:
        server_port: Port of the side that listens.
        forward: Changes the stream of datagrams.
    """

    def __init__(self, server_port: int, forward: Forward) -> None:
        self.forward = forward
        self.count = 0
        self._client_side, self._server_side = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._client_side.bind(("127.0.0.1", 0))
        self._server_side.connect(("127.0.0.1", server_port))
        self.port = self._client_side.getsockname()[1]
        self._client: Any = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopped.is_set():
            for side in select.select([self._client_side, self._server_side], [], [], 0.05)[0]:
                with suppress(OSError):
                    datagram, peer = side.recvfrom(65536)
                    self.count += 1
                    if side is self._client_side:
                        self._client = peer
                    for forwarded_datagram in self.forward(datagram, side is self._client_side):
                        if side is self._client_side:
                            self._server_side.send(forwarded_datagram)
                        else:
                            self._client_side.sendto(forwarded_datagram, self._client)

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()
        self._client_side.close()
        self._server_side.close()


def forward_unchanged(datagram: bytes, _: bool) -> list[bytes]:
    return [datagram]


def make_lossy(seed: int) -> Forward:
    """Return a network that loses 20 % of the datagrams, repeats 10 %, and delays 10 % until after the next one."""
    rng = random.Random(seed)
    delayed_by_direction: dict[bool, list[bytes]] = {True: [], False: []}

    def forward(datagram: bytes, is_to_server: bool) -> list[bytes]:
        draw_value, delayed_datagrams = rng.random(), delayed_by_direction[is_to_server]
        if draw_value < 0.2:
            return []
        if draw_value < 0.3:
            delayed_datagrams.append(datagram)
            return []
        released_datagrams = tuple(delayed_datagrams)
        delayed_datagrams.clear()
        return [datagram] * (2 if draw_value < 0.4 else 1) + list(released_datagrams)

    return forward


@contextmanager
def open_connection(forward: Forward) -> Iterator[tuple[FrameChannel, FrameChannel, Network]]:
    """Yield the channel of the side that connected, the channel of the side that listened, and the network."""
    port = free_port()
    network = Network(port, forward)
    first_frame = encode(MessageKind.PING, 0, 0, b"8 bytes.")
    try:
        with UdpAddress("udp", "127.0.0.1", port, listens=True).listen() as listener:
            accepted_channels: list[FrameChannel] = []
            thread = threading.Thread(
                target=lambda: accepted_channels.append(listener.accept(deadline_after(30))), daemon=True
            )
            thread.start()
            federate_end = UdpAddress("udp", "127.0.0.1", network.port).connect(deadline_after(30))
            federate_end.send(first_frame, deadline_after(30))
            while thread.is_alive():
                with suppress(DeadlineError):
                    federate_end.receive(deadline_after(0.05))
            with closing(federate_end), closing(accepted_channels[0]) as coordinator_end:
                assert coordinator_end.receive(deadline_after(30)).body == b"8 bytes."
                yield federate_end, coordinator_end, network
    finally:
        network.stop()


def exchange(federate_end: FrameChannel, coordinator_end: FrameChannel, bodies: list[bytes]) -> None:
    """Send each body from both sides, as request and answer."""

    def answer() -> None:
        for body in bodies:
            assert coordinator_end.receive(deadline_after(60)).body == body
            coordinator_end.send(encode(MessageKind.STATES, 1, 0, body), deadline_after(60))
        # The last answer is resent until it is acknowledged; the network may lose the end of the connection.
        with suppress(ClosedError):
            while not closed.is_set():
                with suppress(DeadlineError):
                    coordinator_end.receive(deadline_after(0.1))

    closed = threading.Event()
    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    for body in bodies:
        federate_end.send(encode(MessageKind.PING, 1, 0, body), deadline_after(60))
        assert federate_end.receive(deadline_after(60)).body == body
    federate_end.close()
    closed.set()
    thread.join(60)
    assert not thread.is_alive()


@pytest.mark.parametrize("seed", mark_nightly([1, 2, 3, 4]))
def test_lost_repeated_and_reordered_datagrams_change_nothing(seed: int) -> None:
    rng = random.Random(seed)
    bodies = [rng.randbytes(rng.choice((0, 8, 700, 1160, 5000))) for _ in range(15)]
    bodies += [rng.randbytes(100_000)]  # more than the window
    with open_connection(make_lossy(seed)) as (federate_end, coordinator_end, network):
        exchange(federate_end, coordinator_end, bodies)
        assert network.count > 2 * len(bodies)


def test_an_answer_acknowledges_the_request_so_that_an_exchange_has_two_datagrams() -> None:
    with open_connection(forward_unchanged) as (federate_end, coordinator_end, network):
        federate_end._timer.interval_s = coordinator_end._timer.interval_s = 10.0  # type: ignore[attr-defined]
        count_before = network.count
        exchange(federate_end, coordinator_end, [bytes(700)] * 20)
        assert network.count - count_before <= 40 + 6


def test_datagrams_of_other_programs_are_ignored() -> None:
    with open_connection(forward_unchanged) as (federate_end, coordinator_end, network):
        header = DatagramHeader(DatagramKind.DATA, federate_end._identity[0], 12345, federate_end._number)  # type: ignore[attr-defined]
        forged_datagrams = [pack_datagram(header, b"forged"), b"", b"garbage" * 20, pack_datagram(header)[:30]]
        close = DatagramHeader(DatagramKind.CLOSE, federate_end._identity[0], 0, federate_end._number)  # type: ignore[attr-defined]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            for datagram in (*forged_datagrams, pack_datagram(close)):
                other.sendto(datagram, ("127.0.0.1", network.port))
                other.sendto(datagram, coordinator_end._socket.getsockname())  # type: ignore[attr-defined]
        network._client = federate_end._socket.getsockname()  # type: ignore[attr-defined]
        exchange(federate_end, coordinator_end, [b"8 bytes."])


def test_only_a_program_that_returns_the_cookie_of_its_address_is_accepted() -> None:
    port = free_port()
    with (
        UdpAddress("udp", "127.0.0.1", port, listens=True).listen() as listener,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forger,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        for endpoint in (forger, other):
            endpoint.connect(("127.0.0.1", port))
            endpoint.settimeout(20)
        forger.send(pack_datagram(DatagramHeader(DatagramKind.OPEN, 7)))
        with pytest.raises(DeadlineError, match="no program has connected"):
            listener.accept(deadline_after(0.05))
        cookie = unpack_datagram(forger.recv(2000))
        assert cookie is not None
        assert (cookie.kind, cookie.connection) == (DatagramKind.COOKIE, 7)
        data = pack_datagram(DatagramHeader(DatagramKind.DATA, 7, cookie.cookie))
        other.send(data)  # the cookie of another address
        forger.send(pack_datagram(DatagramHeader(DatagramKind.DATA, 7, cookie.cookie ^ 1)))
        with pytest.raises(DeadlineError):
            listener.accept(deadline_after(0.05))
        forger.send(data)
        listener.accept(deadline_after(20)).close()


def test_a_closed_connection_is_an_error_at_the_other_end() -> None:
    with open_connection(forward_unchanged) as (federate_end, coordinator_end, _):
        coordinator_end.close()
        with pytest.raises(ClosedError):
            federate_end.receive(deadline_after(20))


def test_an_exit_of_the_peer_is_detected_by_the_icmp_error_of_its_host() -> None:
    sender, peer = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    peer.bind(("127.0.0.1", 0))
    sender.connect(peer.getsockname())
    peer.close()
    channel = datagrams.DatagramChannel(sender, 1, 2)
    with pytest.raises(ClosedError, match="the connection was closed"):
        channel.receive(deadline_after(20))
    channel.close()


def test_the_timer_follows_rfc_6298() -> None:
    timer = RetransmissionTimer()
    timer.add_round_trip(0.1)
    assert timer.interval_s == pytest.approx(0.1 + 4 * 0.05)
    timer.add_round_trip(0.2)
    variation_s = 0.05 * 3 / 4 + 0.1 / 4
    assert timer.interval_s == pytest.approx(0.1 * 7 / 8 + 0.2 / 8 + 4 * variation_s)
    for _ in range(10):
        timer.back_off()
    assert timer.interval_s == 2.0
    for _ in range(100):
        timer.add_round_trip(1e-5)
    assert timer.interval_s == 0.02


def test_a_datagram_has_the_documented_layout() -> None:
    frame = encode(MessageKind.BYE, 0, 0)
    datagram = pack_datagram(DatagramHeader(DatagramKind.DATA, 1, 2, 3, 4), frame)
    assert datagram == b"FKUD" + struct.pack("<BBHQQQQ", 1, 3, 0, 1, 2, 3, 4) + frame
    assert unpack_datagram(datagram) == (3, 1, 2, 3, 4)
    assert datagrams._DATA_BYTES + DATAGRAM_HEADER_BYTES == MAX_DATAGRAM_BYTES == 1200
    assert unpack_datagram(datagram[:39]) is None
    assert unpack_datagram(b"FKUD" + struct.pack("<BBHQQQQ", 2, 3, 0, 1, 2, 3, 4)) is None


def test_the_example_of_the_documentation_is_a_datagram() -> None:
    page = (ROOT / "docs" / "reference" / "federate-protocol.md").read_text(encoding="utf-8")
    header = DatagramHeader(DatagramKind.DATA, 0x1122334455667788, 0xA1B2C3D4E5F60718, 5, 4)
    datagram = pack_datagram(header, encode(MessageKind.PING, 3, 0, encode_number(42)))
    assert re.findall(r"^(464b5544[0-9a-f]+)$", page, re.MULTILINE) == [datagram.hex()]
