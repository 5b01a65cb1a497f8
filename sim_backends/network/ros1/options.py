"""Flows and options of ROS 1, with the sizes and times of the real one.

Sizes are those of rospy and rosmaster 1.15.15 for a `sensor_msgs/LaserScan` on `/scan`, captured between `/talker`
and `/listener`: HTTP with its headers for calls, and connection headers with the definition of the type.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from sim_backends.network.ros1.calls import CallRetry
from sim_backends.network.tcp.options import TcpOptions

_MS: Final = 1_000_000
_SECOND: Final = 1000 * _MS

REGISTER_PUBLISHER_BYTES: Final = 513
PUBLISHER_REGISTERED_BYTES: Final = 425
REGISTER_SUBSCRIBER_BYTES: Final = 516
SUBSCRIBER_REGISTERED_BYTES: Final = 402
"""With no publisher; captured with one."""
PUBLISHER_UPDATE_BYTES: Final = 425
"""With no publisher, as captured."""
PUBLISHER_UPDATED_BYTES: Final = 364
GET_KEEPALIVE_BYTES: Final = 370
KEEPALIVE_BYTES: Final = 402
"""A call of `getParam`, and its answer that there is no parameter of this name."""
PUBLISHER_BYTES: Final = 56
"""Of a publisher's address in either of these."""
REQUEST_TOPIC_BYTES: Final = 508
TOPIC_REQUESTED_BYTES: Final = 518
REQUEST_UDPROS_BYTES: Final = 508 + 288
UDPROS_REQUESTED_BYTES: Final = 518 + 246
"""Worked out from those for TCPROS: the connection header of 110 bytes in base 64, address, and datagram size."""

_REGISTER: Final = CallRetry(50 * _MS, 50 * _MS)
_REQUEST: Final = CallRetry(500 * _MS, 32 * _SECOND)
_RECONNECT: Final = CallRetry(100 * _MS, 20 * _SECOND)

LENGTH_BYTES: Final = 4
"""What goes before every message (wiki.ros.org/ROS/TCPROS)."""


@dataclass(frozen=True, slots=True)
class Ros1Flow:
    """A topic from one publisher to one subscriber.

    Attributes:
        publisher: Agent with the publisher.
        subscriber: Agent with the subscriber.
        protocol: What its messages go by.
        header_bytes: Of TCPROS's connection header each way.
    """

    publisher: str
    subscriber: str
    protocol: Literal["tcpros", "udpros"] = "tcpros"
    header_bytes: int = 2327


@dataclass(frozen=True)
class Ros1Options:
    """Options of nodes and their TCP.

    Attributes:
        tcp: Of every connection.
        starts_ns: When the nodes of an agent start, by its name; others start at 0.
        register: When a call to the master is tried again (roscpp, `master.cpp`).
        update: When the master's call to a subscriber is; None for never, as in rosmaster (`master_api.py`): a
            subscriber that this call does not reach is not told of its publisher at all.
        request: When a call to a publisher is, or one for what a connection to it needs (rospy, `tcpros_pubsub.py`).
        reconnect: When a lost connection to a publisher is opened again (roscpp, `transport_publisher_link.cpp`).
        silence_ns: After how long without a message a subscriber asks whether the connection is alive.
        probe_ns: From one such question to the next.
        probes: After how many without an answer it gives the connection up (all three: `setKeepAlive(60, 10, 9)`).
        datagram_bytes: The most in a datagram of UDPROS, its header of 8 bytes included (`transport_udp.cpp`).
    """

    tcp: TcpOptions = field(default_factory=TcpOptions)
    starts_ns: Mapping[str, int] = field(default_factory=dict)
    register: CallRetry = _REGISTER
    update: CallRetry | None = None
    request: CallRetry = _REQUEST
    reconnect: CallRetry = _RECONNECT
    silence_ns: int = 60 * _SECOND
    probe_ns: int = 10 * _SECOND
    probes: int = 9
    datagram_bytes: int = 1500
