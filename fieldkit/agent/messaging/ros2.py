"""ROS 2 with its client library rclpy, over the RMW of the robot's environment. Only this module imports rclpy.

Samples are passed through as bytes: rclpy publishes serialized messages, and a `raw` subscription delivers them.
"""

from __future__ import annotations

import importlib
import os
import threading
import time
from importlib.util import find_spec
from typing import Any, Callable

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from fieldkit.agent.messaging.middleware import Deliver, MiddlewareError, Network, Quality, Topic, version_of

_SPIN_S = 0.1


def start(network: Network) -> Ros2Middleware:
    """Start a node; raises `MiddlewareError` if ROS 2 does not start."""
    return Ros2Middleware(network)


def environment(network: Network) -> dict[str, str]:
    """Return the environment variables for these network settings.

    `Ros2Middleware` also removes `ROS_LOCALHOST_ONLY`, unless the discovery is `environment`. All other variables are
    as on the robot.

    With `LOCALHOST`, nodes do not use multicast on the network, but contact static peers (docs.ros.org, "Improved
    Dynamic Discovery"). This is available since ROS 2 Iron; earlier versions support multicast only.
    """
    variables = {"ROS_DOMAIN_ID": str(network.domain)}
    if network.discovery != "environment":
        variables["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST" if network.discovery == "peers" else "SUBNET"
        variables["ROS_STATIC_PEERS"] = ";".join(network.peers) if network.discovery == "peers" else ""
    return variables


def profile(qos: Quality) -> QoSProfile:
    """Return a quality of service as a profile of rclpy."""
    policies: dict[str, Any] = {
        "reliability": ReliabilityPolicy[qos.reliability.upper()],
        "history": HistoryPolicy[qos.history.upper()],
        "depth": qos.depth,
        "durability": DurabilityPolicy[qos.durability.upper()],
    }
    for name, time_ns in (("deadline", qos.deadline_ns), ("lifespan", qos.lifespan_ns)):
        if time_ns is not None:
            policies[name] = Duration(nanoseconds=time_ns)
    return QoSProfile(**policies)


def message_type(name: str) -> Any:  # noqa: ANN401 (a generated class)
    """Return the class of a message type, for example `std_msgs/msg/UInt8MultiArray`.

    Raises:
        MiddlewareError: This ROS 2 has no such type.
    """
    package, subpackage, class_name = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{subpackage}"), class_name)
    except (ImportError, AttributeError) as error:
        raise MiddlewareError(f"this ROS 2 has no {name}: {error}") from error


class Ros2Middleware:
    """A node without parameter services and without a log on `/rosout`."""

    def __init__(self, network: Network) -> None:
        # Iron introduced static peers and type hashes; `rclpy.type_hash` shows that this is Iron or later.
        if network.discovery == "peers" and find_spec("rclpy.type_hash") is None:
            raise MiddlewareError("ROS 2 has no static peers before Iron: set the peers in the settings of its RMW")
        os.environ.update(environment(network))
        if network.discovery != "environment":
            os.environ.pop("ROS_LOCALHOST_ONLY", None)
        # With a separate context rclpy installs no signal handlers.
        self._context = Context()
        try:
            # Without the second argument, each run leaves a file in the robot's ~/.ros/log.
            rclpy.init(args=["--ros-args", "--disable-external-lib-logs"], context=self._context)
            self._node = rclpy.create_node(
                network.node,
                context=self._context,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self.version = f"{version_of('rclpy')}, {rclpy.get_rmw_implementation_identifier()}"
        except RuntimeError as error:  # the base class of rclpy's errors
            raise MiddlewareError(f"ROS 2 does not start: {error}") from error
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._roles: set[tuple[str, str]] = set()

    def publisher(self, topic: Topic) -> Ros2Publisher:
        """Create a publisher of a topic."""
        self._require_single_role("publish", topic)
        return Ros2Publisher(
            self._node.create_publisher(message_type(topic.type), topic.name, profile(topic.quality))
        )

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """Subscribe to a topic; return a function that returns the number of matched publishers."""
        self._require_single_role("subscribe", topic)

        def on_message(data: bytes) -> None:
            deliver(data, time.time_ns())

        message_class, qos = message_type(topic.type), profile(topic.quality)
        subscription = self._node.create_subscription(message_class, topic.name, on_message, qos, raw=True)
        if self._thread is None:
            self._thread = threading.Thread(target=self._spin, daemon=True)
            self._thread.start()
        if hasattr(subscription, "get_publisher_count"):  # since Jazzy
            return lambda: int(subscription.get_publisher_count())
        return lambda: int(self._node.count_publishers(topic.name))

    def _require_single_role(self, role: str, topic: Topic) -> None:
        """Raise an error if this node publishes and subscribes to one topic: it would receive its own samples."""
        self._roles.add((role, topic.name))
        if {("publish", topic.name), ("subscribe", topic.name)} <= self._roles:
            raise MiddlewareError(f"rclpy would receive its own samples on {topic.name}")

    def _spin(self) -> None:
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=_SPIN_S)

    def other_types(self, topic: Topic) -> set[str]:
        """Return the types that nodes use for the topic, except its type in `topic`."""
        return set(dict(self._node.get_topic_names_and_types()).get(topic.name, ())) - {topic.type}

    def close(self) -> None:
        """Stop the node."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


class Ros2Publisher:
    """A publisher of serialized messages."""

    def __init__(self, publisher: Any) -> None:  # noqa: ANN401 (rclpy declares no types)
        self._publisher = publisher

    def write(self, data: bytes) -> bool:
        """Publish a sample; return False if the RMW does not accept it in time."""
        try:
            self._publisher.publish(data)
        except RuntimeError:  # a timeout of the RMW
            return False
        return True

    def matched(self) -> int:
        """Return the number of matched subscriptions."""
        return int(self._publisher.get_subscription_count())

    def drain(self, limit_s: float) -> None:
        """Wait until all samples are acknowledged, at most for this time. rclpy supports this since Humble."""
        if hasattr(self._publisher, "wait_for_all_acked"):
            self._publisher.wait_for_all_acked(Duration(nanoseconds=int(limit_s * 1e9)))
