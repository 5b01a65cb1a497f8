"""Many streams over one channel, whose other end is correct, slow or hostile."""

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import TestbedLostError
from sim_backends.emulated.linux_wifi.streams import ChannelStreams

LIMIT_S = 60.0


def echo(stream: socket.socket) -> None:
    with stream:
        while data := stream.recv(1000):
            stream.sendall(data)


def read_all(stream: socket.socket) -> bytes:
    stream.settimeout(LIMIT_S)
    return b"".join(iter(lambda: stream.recv(1 << 16), b""))


@contextmanager
def running_channel(streams: ChannelStreams, end: socket.socket) -> Iterator[None]:
    thread = threading.Thread(target=streams.run)
    thread.start()
    try:
        yield
    finally:
        end.shutdown(socket.SHUT_RDWR)
        thread.join(LIMIT_S)
        assert not thread.is_alive()


def test_streams_do_not_mix_their_bytes_and_end_separately() -> None:
    host, guest = socket.socketpair()
    with host, guest, running_channel(ChannelStreams(guest.fileno(), echo), guest):
        streams = ChannelStreams(host.fileno())
        with running_channel(streams, host):
            open_streams = [streams.open() for _ in range(20)]
            contents = [os.urandom(200_000) if not number % 7 else bytes((number,)) * number for number in range(20)]
            threads = []
            for stream, content in zip(open_streams, contents, strict=True):

                def write(stream: socket.socket = stream, content: bytes = content) -> None:
                    stream.sendall(content)
                    stream.shutdown(socket.SHUT_WR)

                threads.append(threading.Thread(target=write))
                threads[-1].start()
            assert [read_all(stream) for stream in reversed(open_streams)] == contents[::-1]
            for thread in threads:
                thread.join(LIMIT_S)
            for stream in open_streams:
                stream.close()


def test_a_stream_that_is_not_read_is_cut_and_the_others_continue() -> None:
    host, guest = socket.socketpair()
    with host, guest:
        streams = ChannelStreams(host.fileno())
        with running_channel(streams, host):
            unread_stream, read_stream = streams.open(), streams.open()
            frame = b"\x00\x00\x00\x00\x01\x80\x00" + bytes(1 << 15)
            for _ in range(2100):
                guest.sendall(frame)
            guest.sendall(b"\x00\x00\x00\x01\x01\x00\x02ok\x00\x00\x00\x01\x02\x00\x00")
            assert read_all(read_stream) == b"ok"
            assert len(read_all(unread_stream)) < 1 << 20
            unread_stream.close()
            read_stream.close()


def test_the_end_of_a_channel_closes_all_streams() -> None:
    host, guest = socket.socketpair()
    with host:
        streams = ChannelStreams(host.fileno())
        with running_channel(streams, host):
            stream = streams.open()
            guest.close()
            assert read_all(stream) == b""
            stream.close()
    with pytest.raises(TestbedLostError, match="has ended"):
        streams.open()


@given(st.binary(max_size=300))
def test_hostile_frames_end_the_channel_or_are_ignored(data: bytes) -> None:
    host, guest = socket.socketpair()
    with host:
        streams = ChannelStreams(host.fileno())
        thread = threading.Thread(target=streams.run)
        thread.start()
        stream = streams.open()
        with guest:
            guest.sendall(data)
        assert len(read_all(stream)) <= len(data)
        stream.close()
        thread.join(LIMIT_S)
        assert streams.has_ended
