"""The transport over DDS, with CycloneDDS: two reliable topics that keep all samples. There is no master.

The two sides discover each other at different times. A writer may thus send the first sample before the reader has
discovered it; a volatile reader never receives this sample. The topics are therefore transient local: a reader
receives the last two samples of a writer that it discovers later. Two are needed because a federate that refuses a
run sends an error and then the end of the run. All other samples follow an answer, which proves that the reader has
discovered the writer.

The topics are `fieldkit/NAME/requests` and `fieldkit/NAME/answers`, their type is `fieldkit::Frame` with one member,
`data`, a sequence of octets. Without an address of an interface, only the loopback interface is used.
"""

import queue
import re
import struct
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Final

from fieldkit.agent.messaging.middleware import Middleware, MiddlewareError, Network, Quality, Topic, adapter
from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import ClosedError, DeadlineError
from sim_backends.federates.transports import samples
from sim_backends.federates.transports.contract import ChannelListener, FederateTransport, is_loopback

_LOOPBACK: Final = "127.0.0.1"
_MAX_DOMAIN: Final = 232
"""Largest number of a domain; the ports of the next one would be above 65535."""
_TYPE: Final = "fieldkit/Frame"
_QUALITY: Final = Quality(
    reliability="reliable", history="keep_all", durability="transient_local", late_reader_depth=2
)
_CDR: Final = struct.Struct("<4sI")
_CDR_LITTLE_ENDIAN: Final = b"\0\1\0\0"
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def frame_topic(name: str, part: str) -> Topic:
    """Return a topic of a federate.

    Args:
        name: Name of the federate.
        part: `requests` or `answers`.
    """
    path = f"fieldkit/{name}/{part}"
    return Topic(
        name=path,
        type=_TYPE,
        quality=_QUALITY,
        members={_TYPE: [("data", "uint8", 0)]},
        dds_topic=path,
        dds_types={_TYPE: "fieldkit::Frame"},
    )


class _Participants:
    """The participants of this process; they are shared, because a process has only one configuration per domain."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._participants: dict[tuple[int, str], tuple[Middleware, int]] = {}

    def open(self, address: "DdsAddress") -> Middleware:
        """Return the participant of a domain and interface; start it if necessary.

        Raises:
            MiddlewareError: CycloneDDS is missing or does not start.
        """
        key = address.domain, address.interface
        with self._lock:
            participant, use_count = self._participants.get(key) or (adapter("dds")(address.network), 0)
            self._participants[key] = participant, use_count + 1
        return participant

    def close(self, address: "DdsAddress") -> None:
        """Close the participant after its last use."""
        key = address.domain, address.interface
        with self._lock:
            participant, use_count = self._participants.pop(key)
            if use_count > 1:
                self._participants[key] = participant, use_count - 1
            else:
                participant.close()


_PARTICIPANTS: Final = _Participants()


class DdsBus:
    """A reader of one topic and a writer of another; it implements `SampleBus`.

    Args:
        address: The address.
        read_topic: Topic to read, `requests` or `answers`.
        write_topic: Topic to write.

    Raises:
        ConfigurationError: CycloneDDS is missing or does not start.
    """

    def __init__(self, address: "DdsAddress", read_topic: str, write_topic: str) -> None:
        try:
            participant = _PARTICIPANTS.open(address)
        except MiddlewareError as error:
            raise ConfigurationError(
                f"{address} cannot be used: {error}", remedy="python3 -m pip install 'fieldkit[ros2]'"
            ) from error
        self._address = address
        self._samples: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._writer = participant.publisher(frame_topic(address.name, write_topic))
        self._matched_writers = participant.subscribe(frame_topic(address.name, read_topic), self._deliver)

    def _deliver(self, data: bytes, _at_ns: int) -> None:
        if len(data) >= _CDR.size:
            encoding, size = _CDR.unpack_from(data)
            if encoding == _CDR_LITTLE_ENDIAN and len(data) == _CDR.size + size:
                self._samples.put(data[_CDR.size :])

    def write(self, sample: bytes, deadline_s: float | None) -> None:
        """Implement `SampleBus.write`; the writer returns False if a reader was too slow for a second."""
        data = _CDR.pack(_CDR_LITTLE_ENDIAN, len(sample)) + sample
        while not self._writer.write(data):
            if not self.has_peer():
                raise ClosedError("the connection was closed")
            if deadline_s is not None and time.monotonic() >= deadline_s:
                raise DeadlineError("the wait reached its deadline")

    def receive(self, deadline_s: float | None) -> bytes:
        """Implement `SampleBus.receive`."""
        try:
            return self._samples.get(timeout=None if deadline_s is None else max(deadline_s - time.monotonic(), 0))
        except queue.Empty:
            raise DeadlineError("the wait reached its deadline") from None

    def has_peer(self) -> bool:
        """Implement `SampleBus.has_peer`."""
        return self._writer.matched() > 0 and self._matched_writers() > 0

    def close(self) -> None:
        """Implement `SampleBus.close`; wait up to half a second for acknowledgements of the last samples."""
        self._writer.drain(0.5)
        _PARTICIPANTS.close(self._address)


@dataclass(frozen=True)
class DdsAddress:
    """Name and domain of a federate.

    Attributes:
        name: Its name.
        domain: DDS domain.
        interface: IPv4 address of the network interface to use.
        listens: None: the federate listens and the coordinator connects, with the same address on both sides.
    """

    name: str
    domain: int = 0
    interface: str = _LOOPBACK
    listens: None = None

    def __str__(self) -> str:
        return f"dds:{self.name}:{self.domain}:{self.interface}"

    @property
    def is_loopback(self) -> bool:
        """True if only programs on this machine can use it."""
        return is_loopback(self.interface)

    @property
    def network(self) -> Network:
        """The settings of the participant. Loopback interfaces have no multicast."""
        if self.is_loopback:
            return Network(self.interface, "peers", (self.interface,), domain=self.domain)
        return Network(self.interface, domain=self.domain)

    def connect(self, deadline_s: float) -> samples.SampleChannel:
        """Implement `TransportAddress.connect`."""
        return samples.connected_channel(DdsBus(self, read_topic="answers", write_topic="requests"), self, deadline_s)

    def listen(self) -> AbstractContextManager[ChannelListener]:
        """Implement `TransportAddress.listen`."""
        return samples.listening(lambda: DdsBus(self, read_topic="requests", write_topic="answers"))


def parse(text: str) -> DdsAddress:
    """Return the address of `dds:NAME`, `dds:NAME:DOMAIN` or `dds:NAME:DOMAIN:INTERFACE`.

    Raises:
        ValueError: The address is invalid.
    """
    _, name, *fields = text.split(":")
    domain = fields[0] if fields else "0"
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} is not a name of letters, digits and underscores")
    if not domain.isdecimal() or int(domain) > _MAX_DOMAIN or len(fields) > 2:
        raise ValueError(f"the domain is not a number up to {_MAX_DOMAIN}")
    return DdsAddress(name, int(domain), fields[1] if len(fields) > 1 else _LOOPBACK)


TRANSPORT: Final = FederateTransport(
    ("dds:NAME", "dds:NAME:DOMAIN:INTERFACE"), "dds:carts or dds:carts:7:192.0.2.3", parse
)
