"""Channels over a sample bus: a pair of DDS or ROS 1 topics.

The coordinator writes `requests` and reads `answers`; the federate does the reverse. A sample consists of the `run`,
a random u64 that the coordinator draws, and one frame. The first frame is `hello`; a sample without a frame ends the
run.

DDS: the topics are `fieldkit/NAME/requests` and `fieldkit/NAME/answers`. Their type is the final type
`fieldkit::Frame { sequence<octet> data; }` in plain CDR. Their quality of service is reliable, keep all and transient
local; the durability service of a writer keeps the last two samples. A volatile writer does not match. A volatile
reader matches, but misses `hello` if it discovers the writer too late.

ROS 1: the topics are `/fieldkit/NAME/requests` and `/fieldkit/NAME/answers`. Their type is `std_msgs/UInt8MultiArray`
without dimensions.
"""

import secrets
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Final, Protocol

from sim_backends.federates.channels import ClosedError, DeadlineError
from sim_backends.federates.frames import (
    HEADER_BYTES,
    KIND_POSITION,
    MAX_FRAME_BYTES,
    MalformedFrameError,
    MessageKind,
    ProtocolFrame,
    read_header,
)
from sim_backends.federates.transports.contract import ChannelListener

_RUN: Final = struct.Struct("<Q")
_KIND_OFFSET: Final = _RUN.size + KIND_POSITION
"""Offset of the kind of message in a sample."""
_CHECK_S: Final = 0.5
"""Interval at which a channel that waits checks that the other side exists."""
_PEER_S: Final = 10.0
"""Longest wait of the accepting side until its peer is discovered. An answer that is sent before may be lost."""
_MAX_WAITING: Final = 16
"""Largest number of runs that wait for the end of the current run."""
_POLL_S: Final = 0.01
"""Interval of checks whether the peer was discovered."""


class SampleBus(Protocol):
    """Reads samples from one topic and writes samples to another."""

    def write(self, sample: bytes, deadline_s: float | None) -> None:
        """Write a sample.

        Raises:
            ClosedError: There is no reader.
            DeadlineError: The sample was not accepted in time.
        """
        ...

    def receive(self, deadline_s: float | None) -> bytes:
        """Return the next sample.

        Raises:
            DeadlineError: No sample arrived in time.
        """
        ...

    def has_peer(self) -> bool:
        """Return True if the other side currently has a reader and a writer."""
        ...

    def close(self) -> None:
        """Close the bus."""
        ...


class SampleChannel:
    """A channel over a bus.

    Args:
        bus: The bus.
        run: Number of the run.
        first_sample: The first sample, if it was received already.
        owns_bus: True if `close` must close the bus.

    Attributes:
        other_hellos: Samples with the `hello` of other runs that arrived during this run.
    """

    def __init__(self, bus: SampleBus, run: int, *, first_sample: bytes = b"", owns_bus: bool = False) -> None:
        self._bus = bus
        self._run = _RUN.pack(run)
        self._first_sample = first_sample
        self._owns_bus = owns_bus
        self._is_closed = self._is_closed_by_peer = False
        self.other_hellos: deque[bytes] = deque(maxlen=_MAX_WAITING)

    def send(self, frame: bytes, deadline_s: float | None) -> None:
        """Implement `FrameChannel.send`."""
        if self._is_closed_by_peer:
            raise ClosedError("the connection was closed")
        self._bus.write(self._run + frame, deadline_s)

    def receive(self, deadline_s: float | None, max_bytes: int = MAX_FRAME_BYTES) -> ProtocolFrame:
        """Implement `FrameChannel.receive`."""
        sample = self._next_sample(deadline_s)
        body_offset = _RUN.size + HEADER_BYTES
        if len(sample) < body_offset:
            raise MalformedFrameError(len(sample) - _RUN.size, "the sample ends within a header")
        header = read_header(sample[_RUN.size : body_offset], max_bytes)
        if len(sample) != body_offset + header.size:
            received_bytes = len(sample) - body_offset
            raise MalformedFrameError(0, f"the body has {received_bytes} bytes, but its header states {header.size}")
        return ProtocolFrame(header, sample[body_offset:])

    def _next_sample(self, deadline_s: float | None) -> bytes:
        """Return the next sample of this run.

        Raises:
            ClosedError: One side has ended the run, or the other side has disappeared.
            DeadlineError: No sample arrived in time.
        """
        if self._first_sample:
            first_sample, self._first_sample = self._first_sample, b""
            return first_sample
        while not self._is_closed and not self._is_closed_by_peer:
            check_s = time.monotonic() + _CHECK_S
            try:
                sample = self._bus.receive(check_s if deadline_s is None else min(check_s, deadline_s))
            except DeadlineError:
                if deadline_s is not None and time.monotonic() >= deadline_s:
                    raise
                if not self._bus.has_peer():
                    break
                continue
            if sample.startswith(self._run):
                if len(sample) > _RUN.size:
                    return sample
                self._is_closed_by_peer = True
            elif _is_hello(sample):
                self.other_hellos.append(sample)
        raise ClosedError("the connection was closed")

    def close(self) -> None:
        """Implement `FrameChannel.close`."""
        if self._is_closed:
            return
        self._is_closed = True
        with suppress(ClosedError, DeadlineError):
            self._bus.write(self._run, time.monotonic() + _CHECK_S)
        if self._owns_bus:
            self._bus.close()


def _is_hello(sample: bytes) -> bool:
    return sample[_KIND_OFFSET : _KIND_OFFSET + 2] == int(MessageKind.HELLO).to_bytes(2, "little")


class SampleListener:
    """Accepts runs in the order of their `hello`; a `hello` that arrives during another run waits.

    Args:
        bus: The bus.
    """

    def __init__(self, bus: SampleBus) -> None:
        self._bus = bus
        self._waiting_hellos: deque[bytes] = deque(maxlen=_MAX_WAITING)

    def accept(self, deadline_s: float | None) -> SampleChannel:
        """Implement `ChannelListener.accept`."""
        while not self._waiting_hellos:
            sample = self._bus.receive(deadline_s)
            if _is_hello(sample):
                self._waiting_hellos.append(sample)
        first_sample = self._waiting_hellos.popleft()
        _wait_for_peer(self._bus, time.monotonic() + _PEER_S)
        channel = SampleChannel(self._bus, _RUN.unpack_from(first_sample)[0], first_sample=first_sample)
        channel.other_hellos = self._waiting_hellos
        return channel


def connected_channel(bus: SampleBus, address: object, deadline_s: float) -> SampleChannel:
    """Return the channel of a new run, as soon as a federate reads and writes.

    Raises:
        DeadlineError: No federate was discovered in time.
    """
    if not _wait_for_peer(bus, deadline_s):
        bus.close()
        raise DeadlineError(f"no federate has been discovered at {address}")
    return SampleChannel(bus, secrets.randbits(64), owns_bus=True)


def _wait_for_peer(bus: SampleBus, deadline_s: float) -> bool:
    """Return True as soon as the bus has a peer, or False at the deadline."""
    while not bus.has_peer():
        if time.monotonic() >= deadline_s:
            return False
        time.sleep(_POLL_S)
    return True


def listening(make_bus: Callable[[], SampleBus]) -> AbstractContextManager[ChannelListener]:
    """Return a context manager for a listener on a bus; it closes the bus at the end."""

    @contextmanager
    def listen() -> Iterator[SampleListener]:
        bus = make_bus()
        try:
            yield SampleListener(bus)
        finally:
            bus.close()

    return listen()
