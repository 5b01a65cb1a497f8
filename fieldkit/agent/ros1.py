"""ROS 1 by rospy, over TCPROS. Its only importer.

Samples go through as bytes: in messages of a type made here, with the sum of the real one.
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
    # Debian's ROS is there for Debian's own Python.
    sys.path.append("/usr/lib/python3/dist-packages")
    import rospy
from rosgraph import Master, MasterException

from fieldkit.agent.middleware import Deliver, MiddlewareError, Network, Topic, version_of

MASTER_PORT = 11311
PORTS = ("xmlrpc_port", "tcpros_port")
"""Of a node, as settings name them; without, any."""

_LONG = 1000
_TRIES_S = 0.05
_PATIENCE_S = 10.0


def start(network: Network) -> Ros1Middleware:
    """Register a node with the master; see `middleware.start`."""
    return Ros1Middleware(network)


class Ros1Middleware:
    """A node. rospy knows one per process."""

    def __init__(self, network: Network) -> None:
        self.version = version_of("rospy")
        if network.server:  # else what its setup files say
            os.environ["ROS_MASTER_URI"] = f"http://{network.server}:{network.port or MASTER_PORT}"
            os.environ["ROS_IP"] = network.address
            os.environ.pop("ROS_HOSTNAME", None)
        os.environ.setdefault("ROS_MASTER_URI", f"http://localhost:{MASTER_PORT}")
        _wait_for_master(float(network.settings.get("patience_s", _PATIENCE_S)))
        ports = {name: int(network.settings.get(name, 0)) for name in PORTS}
        self._at_once = network.settings.get("tcp_nodelay", "0") == "1"
        try:
            rospy.init_node(network.node, disable_signals=True, **ports)
        except rospy.ROSException as error:
            raise MiddlewareError(f"rospy does not start: {error}") from error

    def publisher(self, topic: Topic) -> Ros1Publisher:
        """See `Middleware.publisher`."""
        kind = _kind(topic)
        latch = topic.quality.durability == "transient_local"
        made = rospy.Publisher(topic.name, kind, queue_size=_queue(topic), latch=latch, tcp_nodelay=self._at_once)
        return Ros1Publisher(made, kind)

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """See `Middleware.subscribe`."""
        own = rospy.get_name()

        def take(message: Any) -> None:  # noqa: ANN401 (untyped)
            at_ns = time.time_ns()
            if message._connection_header["callerid"] != own:
                deliver(bytes(message._buff), at_ns)

        # By the sum of the type, so that publishers of another one refuse. The buffer is rospy's own, of 64 KiB: it
        # is made anew for each read, and larger ones, of the kernel, cost more than a small message does.
        made = rospy.Subscriber(topic.name, _kind(topic), take, queue_size=_queue(topic), tcp_nodelay=self._at_once)
        return lambda: int(made.get_num_connections())

    def other_types(self, topic: Topic) -> set[str]:
        """See `Middleware.other_types`: the master knows one, that of the last publisher."""
        own = rospy.get_name()
        try:
            master = Master(own)
            known = dict(master.getTopicTypes())
            publishers, subscribers, _ = master.getSystemState()
        except (OSError, MasterException, XmlRpcError):
            return set()
        # The type of a topic stays known when its nodes are gone.
        if not any(name == topic.name and set(nodes) - {own} for name, nodes in publishers + subscribers):
            return set()
        return {known.get(topic.name, "*")} - {"*", _ros1_type(topic)}

    def close(self) -> None:
        """See `Middleware.close`."""
        rospy.signal_shutdown("done")


def _wait_for_master(patience_s: float) -> None:
    """Wait until the master answers; rospy itself would wait without end.

    Raises:
        MiddlewareError: It does not.
    """
    deadline_s = time.monotonic() + patience_s
    while not _master_answers():
        if time.monotonic() > deadline_s:
            raise MiddlewareError(f"no ROS master answers at {os.environ['ROS_MASTER_URI']}")
        time.sleep(_TRIES_S)


def _master_answers() -> bool:
    try:
        Master("/fieldkit").getPid()
    except (OSError, MasterException, XmlRpcError):
        return False
    return True


def _ros1_type(topic: Topic) -> str:
    return topic.type.replace("/msg/", "/")


def _kind(topic: Topic) -> type:
    """Return a class of messages that are bytes, with the name, the sum and the text of the topic's type."""
    attributes = {
        "_type": _ros1_type(topic),
        "_md5sum": topic.md5,
        "_full_text": topic.definition,
        "_has_header": False,
        "__slots__": ["_buff"],
    }
    return type(topic.type.rpartition("/")[2], (rospy.AnyMsg,), attributes)


def _queue(topic: Topic) -> int:
    return topic.quality.depth if topic.quality.history == "keep_last" and topic.quality.depth else _LONG


class Ros1Publisher:
    """A publisher of one type."""

    def __init__(self, publisher: Any, kind: type) -> None:  # noqa: ANN401 (untyped)
        self._publisher = publisher
        self._kind = kind

    def write(self, data: bytes) -> bool:
        """See `Publisher.write`."""
        message = self._kind()
        message._buff = data
        self._publisher.publish(message)
        return True

    def matched(self) -> int:
        """See `Publisher.matched`."""
        return int(self._publisher.get_num_connections())

    def drain(self, limit_s: float) -> None:
        """See `Publisher.drain`: TCPROS tells nobody."""
