"""ROS 1 with rospy, over TCPROS. This is the only module that imports rospy.

Samples are passed through as bytes, in messages of a type that is created here with the MD5 sum of the real type.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any, Callable
from xmlrpc.client import Error as XmlRpcError

try:
    import rospy
except ImportError:
    # Debian installs its ROS packages for Debian's Python only.
    sys.path.append("/usr/lib/python3/dist-packages")
    import rospy
from rosgraph import Master, MasterException

from fieldkit.agent.messaging.middleware import Deliver, MiddlewareError, Network, Topic, version_of

MASTER_PORT = 11311
PORTS = ("xmlrpc_port", "tcpros_port")
"""Settings for the ports of a node; without them, any free port is used."""

_MAX_QUEUE = 1000
"""Queue length if the quality of service gives no depth, or keeps all samples."""
_RETRY_S = 0.05
_MASTER_TIMEOUT_S = 10.0


def start(network: Network) -> Ros1Middleware:
    """Register a node with the master; raises `MiddlewareError` if no master answers or rospy does not start."""
    return Ros1Middleware(network)


class Ros1Middleware:
    """A node. rospy supports one node per process."""

    def __init__(self, network: Network) -> None:
        self.version = version_of("rospy")
        if network.server:  # otherwise the setup files of the robot select the master
            os.environ["ROS_MASTER_URI"] = f"http://{network.server}:{network.port or MASTER_PORT}"
            os.environ["ROS_IP"] = network.address
            os.environ.pop("ROS_HOSTNAME", None)
        os.environ.setdefault("ROS_MASTER_URI", f"http://localhost:{MASTER_PORT}")
        _wait_for_master(float(network.settings.get("patience_s", _MASTER_TIMEOUT_S)))
        ports = {name: int(network.settings.get(name, 0)) for name in PORTS}
        self._tcp_nodelay = network.settings.get("tcp_nodelay", "0") == "1"
        try:
            rospy.init_node(network.node, disable_signals=True, **ports)
        except rospy.ROSException as error:
            raise MiddlewareError(f"rospy does not start: {error}") from error

    def publisher(self, topic: Topic) -> Ros1Publisher:
        """Create a publisher of a topic; `transient_local` latches the last sample."""
        message_class = _message_class(topic)
        latch = topic.quality.durability == "transient_local"
        endpoint = rospy.Publisher(
            topic.name, message_class, queue_size=_queue_size(topic), latch=latch, tcp_nodelay=self._tcp_nodelay
        )
        return Ros1Publisher(endpoint, message_class)

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """Subscribe to a topic; return a function that returns the number of connected publishers."""
        own_name = rospy.get_name()

        def on_message(message: Any) -> None:  # noqa: ANN401 (rospy declares no types)
            at_ns = time.time_ns()
            if message._connection_header["callerid"] != own_name:
                deliver(bytes(message._buff), at_ns)

        # The MD5 sum of the type makes publishers of another type refuse the connection. The buffer has rospy's
        # default size of 64 KiB. It is allocated for each read, and a larger one would slow small messages down.
        endpoint = rospy.Subscriber(
            topic.name,
            _message_class(topic),
            on_message,
            queue_size=_queue_size(topic),
            tcp_nodelay=self._tcp_nodelay,
        )
        return lambda: int(endpoint.get_num_connections())

    def other_types(self, topic: Topic) -> set[str]:
        """Return the topic's type at the master if it differs. The master stores only the last publisher's type."""
        own_name = rospy.get_name()
        try:
            master = Master(own_name)
            types = dict(master.getTopicTypes())
            publishers, subscribers, _ = master.getSystemState()
        except (OSError, MasterException, XmlRpcError):
            return set()
        # The master keeps the type of a topic after its nodes have stopped.
        if not any(name == topic.name and set(nodes) - {own_name} for name, nodes in publishers + subscribers):
            return set()
        return {types.get(topic.name, "*")} - {"*", _ros1_type(topic)}

    def close(self) -> None:
        """Shut the node down."""
        rospy.signal_shutdown("done")


def _wait_for_master(timeout_s: float) -> None:
    """Wait until the master answers; rospy would wait without a limit.

    Raises:
        MiddlewareError: The master does not answer in time.
    """
    deadline_s = time.monotonic() + timeout_s
    while not _master_answers():
        if time.monotonic() > deadline_s:
            raise MiddlewareError(f"no ROS master answers at {os.environ['ROS_MASTER_URI']}")
        time.sleep(_RETRY_S)


def _master_answers() -> bool:
    try:
        Master("/fieldkit").getPid()
    except (OSError, MasterException, XmlRpcError):
        return False
    return True


def _ros1_type(topic: Topic) -> str:
    return topic.type.replace("/msg/", "/")


def _message_class(topic: Topic) -> type:
    """Return a class for serialized messages, with the name, MD5 sum and definition of the topic's type."""
    attributes = {
        "_type": _ros1_type(topic),
        "_md5sum": topic.md5,
        "_full_text": topic.definition,
        "_has_header": False,
        "__slots__": ["_buff"],
    }
    return type(topic.type.rpartition("/")[2], (rospy.AnyMsg,), attributes)


def _queue_size(topic: Topic) -> int:
    return topic.quality.depth if topic.quality.history == "keep_last" and topic.quality.depth else _MAX_QUEUE


class Ros1Publisher:
    """A publisher of serialized messages of one type."""

    def __init__(self, publisher: Any, message_class: type) -> None:  # noqa: ANN401 (rospy declares no types)
        self._publisher = publisher
        self._message_class = message_class

    def write(self, data: bytes) -> bool:
        """Publish a sample; return True, because rospy does not report whether it was accepted."""
        message = self._message_class()
        message._buff = data
        self._publisher.publish(message)
        return True

    def matched(self) -> int:
        """Return the number of connected subscriptions."""
        return int(self._publisher.get_num_connections())

    def drain(self, limit_s: float) -> None:
        """Do nothing: TCPROS has no acknowledgements."""
