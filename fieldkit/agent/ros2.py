"""ROS 2 by its own client library, rclpy, over whatever RMW the robot's environment selects. Its only importer.

Samples go through as bytes: rclpy publishes what is serialized, and hands it on so where a subscription is `raw`.
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

from fieldkit.agent.middleware import Deliver, MiddlewareError, Network, Quality, Topic, version_of

_WAKES_S = 0.1


def start(network: Network) -> Ros2Middleware:
    """Start a node; see `middleware.start`."""
    return Ros2Middleware(network)


def environment(network: Network) -> dict[str, str]:
    """Return the variables by which ROS 2 takes part as it is told; all others are the robot's own.

    docs.ros.org, "Improved Dynamic Discovery": with `LOCALHOST` nobody is asked by multicast, and static peers are
    asked all the same. Since ROS 2 Iron; earlier ones know multicast alone.
    """
    found = {"ROS_DOMAIN_ID": str(network.domain)}
    if network.discovery != "environment":
        found["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST" if network.discovery == "peers" else "SUBNET"
        found["ROS_STATIC_PEERS"] = ";".join(network.peers) if network.discovery == "peers" else ""
    return found


def profile(wanted: Quality) -> QoSProfile:
    """Return a quality of service as rclpy has it, which has ROS 2's own names."""
    policies: dict[str, Any] = {
        "reliability": ReliabilityPolicy[wanted.reliability.upper()],
        "history": HistoryPolicy[wanted.history.upper()],
        "depth": wanted.depth,
        "durability": DurabilityPolicy[wanted.durability.upper()],
    }
    for name, time_ns in (("deadline", wanted.deadline_ns), ("lifespan", wanted.lifespan_ns)):
        if time_ns is not None:
            policies[name] = Duration(nanoseconds=time_ns)
    return QoSProfile(**policies)


def message_type(name: str) -> Any:  # noqa: ANN401 (generated)
    """Return the class of a message type, `std_msgs/msg/UInt8MultiArray`.

    Raises:
        MiddlewareError: This ROS 2 has no such type.
    """
    package, kind, short = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), short)
    except (ImportError, AttributeError) as error:
        raise MiddlewareError(f"this ROS 2 has no {name}: {error}") from error


class Ros2Middleware:
    """A node with nothing but the topics that it is asked for: no parameters, no log on `/rosout`."""

    def __init__(self, network: Network) -> None:
        # Both came with Iron.
        if network.discovery == "peers" and find_spec("rclpy.type_hash") is None:
            raise MiddlewareError("ROS 2 knows no static peers before Iron: name them in the settings of its RMW")
        os.environ.update(environment(network))
        if network.discovery != "environment":
            os.environ.pop("ROS_LOCALHOST_ONLY", None)
        # One of our own: rclpy leaves the handling of signals alone then.
        self._context = Context()
        try:
            # Else a file per run stays in the robot's ~/.ros/log.
            rclpy.init(args=["--ros-args", "--disable-external-lib-logs"], context=self._context)
            self._node = rclpy.create_node(
                network.node,
                context=self._context,
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self.version = f"{version_of('rclpy')}, {rclpy.get_rmw_implementation_identifier()}"
        except RuntimeError as error:  # which rclpy's own errors are
            raise MiddlewareError(f"ROS 2 does not start: {error}") from error
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._own: set[tuple[str, str]] = set()

    def publisher(self, topic: Topic) -> Ros2Publisher:
        """See `Middleware.publisher`."""
        self._claim("publish", topic)
        return Ros2Publisher(
            self._node.create_publisher(message_type(topic.type), topic.name, profile(topic.quality))
        )

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """See `Middleware.subscribe`."""
        self._claim("subscribe", topic)

        def take(data: bytes) -> None:
            deliver(data, time.time_ns())

        kind, wanted = message_type(topic.type), profile(topic.quality)
        made = self._node.create_subscription(kind, topic.name, take, wanted, raw=True)
        if self._thread is None:
            self._thread = threading.Thread(target=self._spin, daemon=True)
            self._thread.start()
        if hasattr(made, "get_publisher_count"):  # since Jazzy
            return lambda: int(made.get_publisher_count())
        return lambda: int(self._node.count_publishers(topic.name))

    def _claim(self, verb: str, topic: Topic) -> None:
        """Refuse both ends of one topic: rclpy cannot keep from a subscription what its own node publishes."""
        self._own.add((verb, topic.name))
        if {("publish", topic.name), ("subscribe", topic.name)} <= self._own:
            raise MiddlewareError(f"rclpy would hear itself on {topic.name}")

    def _spin(self) -> None:
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=_WAKES_S)

    def other_types(self, topic: Topic) -> set[str]:
        """See `Middleware.other_types`."""
        return set(dict(self._node.get_topic_names_and_types()).get(topic.name, ())) - {topic.type}

    def close(self) -> None:
        """See `Middleware.close`."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


class Ros2Publisher:
    """A publisher of serialized messages."""

    def __init__(self, publisher: Any) -> None:  # noqa: ANN401 (untyped)
        self._publisher = publisher

    def write(self, data: bytes) -> bool:
        """See `Publisher.write`."""
        try:
            self._publisher.publish(data)
        except RuntimeError:  # the RMW did not take it in its time
            return False
        return True

    def matched(self) -> int:
        """See `Publisher.matched`."""
        return int(self._publisher.get_subscription_count())

    def drain(self, limit_s: float) -> None:
        """See `Publisher.drain`: since Humble, where it is told."""
        if hasattr(self._publisher, "wait_for_all_acked"):
            self._publisher.wait_for_all_acked(Duration(nanoseconds=int(limit_s * 1e9)))
