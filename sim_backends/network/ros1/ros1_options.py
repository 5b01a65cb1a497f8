"""Flows and options of ROS 1, with the sizes and times of the ROS 1 libraries.

Sizes were captured with rospy and rosmaster 1.15.15 for a `sensor_msgs/LaserScan` on `/scan` between `/talker` and
`/listener`. Calls include the HTTP headers; connection headers include the definition of the type.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from sim_backends.network.ros1.streams import CallRetry
from sim_backends.network.tcp.tcp_options import TcpOptions

_MS: Final = 1_000_000
_SECOND: Final = 1000 * _MS

REGISTER_PUBLISHER_BYTES: Final = 513
PUBLISHER_REGISTERED_BYTES: Final = 425
REGISTER_SUBSCRIBER_BYTES: Final = 516
SUBSCRIBER_REGISTERED_BYTES: Final = 402
"""Size without the address of a publisher, which the captured response contained."""
PUBLISHER_UPDATE_BYTES: Final = 425
"""Size without the address of a publisher; the captured call contained no address."""
PUBLISHER_UPDATED_BYTES: Final = 364
GET_KEEPALIVE_BYTES: Final = 370
KEEPALIVE_BYTES: Final = 402
"""Sizes of a call of `getParam`, and of the response that the parameter does not exist."""
PUBLISHER_BYTES: Final = 56
"""Size of a publisher's address in the response to a subscriber and in a publisher update."""
REQUEST_TOPIC_BYTES: Final = 508
TOPIC_REQUESTED_BYTES: Final = 518
REQUEST_UDPROS_BYTES: Final = 508 + 288
UDPROS_REQUESTED_BYTES: Final = 518 + 246
"""Sizes of request and response for UDPROS: the sizes for TCPROS, plus the connection header of 110 bytes in base 64,
the address, and the datagram size."""

_REGISTER: Final = CallRetry(50 * _MS, 50 * _MS)
_REQUEST: Final = CallRetry(500 * _MS, 32 * _SECOND)
_RECONNECT: Final = CallRetry(100 * _MS, 20 * _SECOND)

LENGTH_BYTES: Final = 4
"""Length field before every message (wiki.ros.org/ROS/TCPROS)."""


@dataclass(frozen=True, slots=True)
class Ros1Flow:
    """A topic from one publisher to one subscriber.

    Attributes:
        publisher: Agent with the publisher.
        subscriber: Agent with the subscriber.
        protocol: Transport protocol of its messages.
        header_bytes: Size of TCPROS's connection header in each direction.
    """

    publisher: str
    subscriber: str
    protocol: Literal["tcpros", "udpros"] = "tcpros"
    header_bytes: int = 2327


@dataclass(frozen=True)
class Ros1Options:
    """Options of nodes and their TCP.

    Attributes:
        tcp: Options of every TCP connection.
        starts_ns: Start time of the nodes of an agent, by name of the agent; the nodes of other agents start at 0.
        register: Retries of calls to the master (roscpp, `master.cpp`).
        update: Retries of the master's calls to a subscriber; None for no retry, as in rosmaster (`master_api.py`): a
            subscriber that such a call does not reach never receives the address of its publisher.
        request: Retries of calls to a publisher, and of calls needed for a connection to it (rospy,
            `tcpros_pubsub.py`).
        reconnect: Times for reopening a lost connection to a publisher (roscpp, `transport_publisher_link.cpp`).
        silence_ns: Time without a message after which a subscriber probes the connection.
        probe_ns: Interval of these probes.
        probes: Number of unanswered probes after which the subscriber gives up the connection. The defaults of
            `silence_ns`, `probe_ns` and `probes` are those of ROS: `setKeepAlive(60, 10, 9)`.
        datagram_bytes: Maximum size of a UDPROS datagram with its header of 8 bytes (`transport_udp.cpp`).
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
