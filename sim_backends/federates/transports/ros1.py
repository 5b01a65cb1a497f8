"""The transport over ROS 1: two topics with `std_msgs/UInt8MultiArray`, whose nodes connect through a ROS master.

The topics are `/fieldkit/NAME/requests` and `/fieldkit/NAME/answers`. The environment variables of ROS apply:
`ROS_MASTER_URI` (http://localhost:11311) and `ROS_IP` or `ROS_HOSTNAME`, the address of this machine for other nodes.
"""

import os
import re
import secrets
import struct
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import urlsplit

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import ClosedError, DeadlineError
from sim_backends.federates.transports import samples
from sim_backends.federates.transports.contract import ChannelListener, FederateTransport, is_loopback
from sim_backends.ros1.node import RosMessageType, RosNode
from sim_backends.ros1.node_calls import MasterError

_DEFAULT_MASTER: Final = "http://localhost:11311"
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_MASTER_TIMEOUT_S: Final = 60.0
"""Longest wait for the master, if a federate listens."""
# Name of the type, MD5 sum of its definition, and its definition.
MESSAGE: Final = RosMessageType(
    "std_msgs/UInt8MultiArray",
    "82373f1612381bb6ee473b5cd6f5d89c",
    "MultiArrayLayout layout\nuint8[] data\n"
    "================================================================================\n"
    "MSG: std_msgs/MultiArrayLayout\nMultiArrayDimension[] dim\nuint32 data_offset\n"
    "================================================================================\n"
    "MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n",
)
_MESSAGE_HEAD: Final = struct.Struct("<III")
"""Head of a message: number of dimensions (0), offset (0), and number of bytes."""


class Ros1Bus:
    """A node with a publisher and a subscriber; it implements `SampleBus`.

    Args:
        address: The address.
        read_topic: Topic to subscribe to, `requests` or `answers`.
        write_topic: Topic to publish.
        deadline_s: Time of `time.monotonic` until which to wait for the master.

    Raises:
        ConfigurationError: No port can be opened, or the master refuses the node.
        DeadlineError: The master does not answer.
    """

    def __init__(self, address: "Ros1Address", read_topic: str, write_topic: str, deadline_s: float) -> None:
        name = f"/fieldkit/{address.name}_{write_topic}_{secrets.token_hex(4)}"
        prefix = f"/fieldkit/{address.name}"
        try:
            self._node = RosNode(name, address.master, address.host)
        except OSError as error:
            raise ConfigurationError(f"{address} cannot be used: {error}", remedy="check ROS_IP") from error
        try:
            self._publisher = self._node.publish(f"{prefix}/{write_topic}", MESSAGE, deadline_s)
            self._subscriber = self._node.subscribe(f"{prefix}/{read_topic}", MESSAGE, deadline_s)
        except TimeoutError as error:
            self._node.close()
            raise DeadlineError(str(error)) from error
        except MasterError as error:
            self._node.close()
            raise ConfigurationError(f"{address} cannot be used: {error}", remedy="check the ROS master") from error

    def write(self, sample: bytes, deadline_s: float | None) -> None:
        """Implement `SampleBus.write`."""
        try:
            count = self._publisher.publish(_MESSAGE_HEAD.pack(0, 0, len(sample)) + sample, deadline_s)
        except TimeoutError as error:
            raise DeadlineError("the wait reached its deadline") from error
        if not count:
            raise ClosedError("the connection was closed")

    def receive(self, deadline_s: float | None) -> bytes:
        """Implement `SampleBus.receive`; messages with another layout are ignored."""
        while True:
            try:
                message = self._subscriber.receive(deadline_s)
            except TimeoutError as error:
                raise DeadlineError("the wait reached its deadline") from error
            if len(message) >= _MESSAGE_HEAD.size:
                dimensions, offset, size = _MESSAGE_HEAD.unpack_from(message)
                if (dimensions, offset, size) == (0, 0, len(message) - _MESSAGE_HEAD.size):
                    return message[_MESSAGE_HEAD.size :]

    def has_peer(self) -> bool:
        """Implement `SampleBus.has_peer`."""
        return self._publisher.connections > 0 and self._subscriber.connections > 0

    def close(self) -> None:
        """Implement `SampleBus.close`."""
        self._node.close()


@dataclass(frozen=True)
class Ros1Address:
    """Name of a federate, and the addresses of the master and of this machine.

    Attributes:
        name: Its name.
        master: URI of the master.
        host: Address of this machine for other nodes; empty for the local address of connections to the master.
        listens: None: the federate listens and the coordinator connects, with the same address on both sides.
    """

    name: str
    master: str = field(default_factory=lambda: os.environ.get("ROS_MASTER_URI", _DEFAULT_MASTER))
    host: str = field(default_factory=lambda: os.environ.get("ROS_IP") or os.environ.get("ROS_HOSTNAME", ""))
    listens: None = None

    def __str__(self) -> str:
        return f"ros1:{self.name} ({self.master})"

    @property
    def is_loopback(self) -> bool:
        """True if only programs on this machine can use it."""
        return is_loopback(urlsplit(self.master).hostname or "") and (not self.host or is_loopback(self.host))

    def connect(self, deadline_s: float) -> samples.SampleChannel:
        """Implement `TransportAddress.connect`."""
        bus = Ros1Bus(self, read_topic="answers", write_topic="requests", deadline_s=deadline_s)
        return samples.connected_channel(bus, self, deadline_s)

    def listen(self) -> AbstractContextManager[ChannelListener]:
        """Implement `TransportAddress.listen`; the master may start later."""
        deadline_s = time.monotonic() + _MASTER_TIMEOUT_S
        return samples.listening(
            lambda: Ros1Bus(self, read_topic="requests", write_topic="answers", deadline_s=deadline_s)
        )


def parse(text: str) -> Ros1Address:
    """Return the address of `ros1:NAME`.

    Raises:
        ValueError: The name is invalid.
    """
    name = text.partition(":")[2]
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} is not a name of letters, digits and underscores")
    return Ros1Address(name)


TRANSPORT: Final = FederateTransport(("ros1:NAME",), "ros1:carts", parse)
