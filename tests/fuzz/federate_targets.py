"""Fuzz targets: readers of frames, datagrams and samples from external federates and coordinators."""

import socket
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

from docs.generator.federate_frames import example_frames
from sim_backends.federates.channels import ClosedError
from sim_backends.federates.frames import HEADER_BYTES, MalformedFrameError, read_header
from sim_backends.federates.transports.datagrams import (
    DatagramChannel,
    DatagramHeader,
    DatagramKind,
    pack_datagram,
    unpack_datagram,
)
from sim_backends.federates.transports.samples import SampleListener
from sim_backends.ros1.framing import PacketSplitter, pack, pack_header, unpack_header
from tests.fuzz.harness import Target
from tests.helpers.federate_decoders import DECODERS


def _decode(name: str, data: bytes, _: Path) -> None:
    with suppress(MalformedFrameError):
        if len(data) >= HEADER_BYTES:
            read_header(data)
        DECODERS[name](data[HEADER_BYTES:])


def _handle_datagram(data: bytes, _: Path) -> None:
    unpack_datagram(data)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        DatagramChannel(endpoint, 1, 2).handle(data)


class _OneSampleBus:
    """A bus with one sample."""

    def __init__(self, sample: bytes) -> None:
        self._samples = [sample]

    def receive(self, deadline_s: float | None) -> bytes:
        if not self._samples:
            raise ClosedError("the bus is empty")
        return self._samples.pop()

    def write(self, sample: bytes, deadline_s: float | None) -> None:
        raise ClosedError("the bus has no reader")

    def has_peer(self) -> bool:
        return False

    def close(self) -> None:
        pass


def _accept_sample(data: bytes, _: Path) -> None:
    with suppress(ClosedError, MalformedFrameError):
        SampleListener(_OneSampleBus(data)).accept(None).receive(None)


def _read_ros_header(data: bytes, _: Path) -> None:
    packets = PacketSplitter()
    packets.feed(data)
    with suppress(ValueError):
        for packet in packets:
            unpack_header(packet)


def federate_targets() -> Iterator[Target]:
    """Yield the targets."""
    frames = example_frames()
    for name, frame in frames.items():
        if name in DECODERS:
            yield Target(f"federate {name}", [frame], partial(_decode, name), weight=0.5)
    datagram = pack_datagram(DatagramHeader(DatagramKind.DATA, 1, 2, 0, 0), frames["hello"])
    yield Target("federate datagram", [datagram], _handle_datagram, weight=0.5)
    yield Target("federate sample", [bytes(8) + frames["hello"]], _accept_sample, weight=0.5)
    header = pack(pack_header({"callerid": "/a", "md5sum": "*", "topic": "/b", "type": "c/D"}))
    yield Target("ros1 header", [header], _read_ros_header, weight=0.5)
