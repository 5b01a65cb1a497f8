"""Publishes an emulated robot's sensors over DDS or Zenoh, as nodes of ROS 2 do; or runs a Zenoh router.

The command line is `route ADDRESS` for the router, or `relay ADDRESS NODE VELOCITY_TOPIC VELOCITY_TYPE ROS2 TYPES`.
ADDRESS is the robot's address on the radio. ROS2 (the fields of `Ros2Spec`) and TYPES (the type of each topic) are
JSON. The two words about velocities are empty for a robot without a base.

The sensors process creates each message. The relay converts it to CDR, the serialization of ROS 2, as the robot's
distribution defines the type, and publishes it while a node on the radio subscribes to the topic. It publishes
`/tf_static` even without a subscriber, because later subscribers get the last message of this topic. It also sends
received velocities to the base. Its node logs on `/rosout`.
"""

import contextlib
import json
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from rosbags.convert.converter import migrate_bytes
from rosbags.serde import SerdeError

from fieldkit.agent.messaging import middleware
from fieldkit.agent.messaging.middleware import Network, Publisher, Topic
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES, QosProfile
from fieldkit.ros.interfaces.types import Distribution, MessageTypes
from sim_backends.emulated.robot import base_process, services
from sim_backends.emulated.robot.spec import Ros2Spec
from sim_backends.emulated.ros import offered_qos, static_frames
from sim_backends.emulated.ros.tcpros import Listener

_POLL_S: Final = 0.1
"""Polling interval for subscribers, the same as that of ROS 2's recorder for new publishers."""

_LOG: Final = "rcl_interfaces/msg/Log"
_INFO: Final = 20
"""`rcl_interfaces/msg/Log.INFO`."""


class Ros2Relay:
    """Publishes the messages of the sensors process.

    Args:
        network: Settings of the robot in the ROS 2 network.
        middleware_name: `dds` or `zenoh`.
        distribution: ROS 2 distribution.
        types: ROS 1 type of each topic, by its name.
    """

    def __init__(
        self, network: Network, middleware_name: str, distribution: Distribution, types: Mapping[str, str]
    ) -> None:
        self._types = MessageTypes(distribution)
        self._network = network
        self._listener = Listener()
        self._middleware = middleware.adapter(middleware_name)(network)
        self._publishers: dict[str, Publisher] = {}
        self._conversions: dict[str, Callable[[bytes], bytes]] = {}
        self._endpoints = 0
        self._subscribed_topics: set[str] = set()
        self._rosout = self._middleware.publisher(self._topic("/rosout", _LOG, offered_qos.ROSOUT))
        for topic, kind in types.items():
            description = self._topic(topic, kind, offered_qos.of_topic(topic, kind))
            self._publishers[topic] = self._middleware.publisher(description)
            self._conversions[topic] = self._conversion(description.type)

    def _topic(self, name: str, kind: str, quality: QosProfile) -> Topic:
        """Return the description of a topic for a new publisher or subscriber, which gets the next number."""
        self._endpoints += 1
        domain, node = self._network.domain, self._network.node
        description = topics.describe(
            self._types, name, kind, quality, domain=domain, node=node, number=self._endpoints
        )
        return Topic.from_json(description)

    def log(self, text: str) -> None:
        """Publish a line of level INFO on `/rosout`, as rclcpp and rclpy do; file, function and line are empty."""
        typestore, now_ns = self._types.ros2, time.time_ns()
        stamp = typestore.types["builtin_interfaces/msg/Time"](*divmod(now_ns, 10**9))
        line = typestore.types[_LOG](
            stamp=stamp, level=_INFO, name=self._network.node, msg=text, file="", function="", line=0
        )
        self._rosout.write(bytes(typestore.serialize_cdr(line, _LOG)))

    def _conversion(self, kind: str) -> Callable[[bytes], bytes]:
        """Return the function that converts a serialized ROS 1 message to CDR."""
        defaults: dict[str, Any] = {}
        types = self._types
        return lambda data: bytes(
            migrate_bytes(types.ros1, types.ros2, kind, kind, defaults, data, src_is2=False, dst_is2=True)
        )

    def relay_velocities(self, topic: str, kind: str) -> None:
        """Send each velocity of a topic to the base.

        A message is dropped if it is outdated or has another type, or if the base is restarting.

        Args:
            topic: Name of the topic.
            kind: Its type, `geometry_msgs/Twist` or `geometry_msgs/TwistStamped`.
        """
        channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        description = self._topic(topic, kind, PROFILES["default"])
        types = self._types.ros2

        def send(data: bytes, at_ns: int) -> None:
            with contextlib.suppress(OSError, SerdeError):  # the base restarts, or the message has another type
                message: Any = types.deserialize_cdr(data, description.type)
                if kind == base_process.STAMPED:
                    stamp = message.header.stamp
                    if base_process.is_outdated(stamp.sec * 10**9 + stamp.nanosec, at_ns):
                        return
                    message = message.twist
                channel.sendto(base_process.pack(message), str(base_process.CHANNEL))

        self._middleware.subscribe(description, send)

    def run(self) -> None:
        """Relay messages until a signal stops the process."""
        listener, next_poll_s = self._listener, 0.0
        while listener.stop_signal is None:
            if time.monotonic() >= next_poll_s:
                next_poll_s = time.monotonic() + _POLL_S
                self._update_subscriptions()
            for header, message in listener.events(_POLL_S):
                if message is not None:
                    self._publishers[header["topic"]].write(self._conversions[header["topic"]](message))
        self._middleware.close()

    def _update_subscriptions(self) -> None:
        """Subscribe at the sensors process to the topics that have subscribers, and to `/tf_static`."""
        listener = self._listener
        for topic, publisher in self._publishers.items():
            has_subscriber = publisher.matched() > 0
            if has_subscriber != (topic in self._subscribed_topics):
                self.log(f"{topic} has {'a subscriber' if has_subscriber else 'no subscribers'}")
                self._subscribed_topics ^= {topic}  # adds the topic, or removes it
            if topic == static_frames.TOPIC or has_subscriber:
                listener.wanted_topics.add(topic)
            else:
                listener.wanted_topics.discard(topic)
                listener.unsubscribe(topic)
        listener.subscribe()


def _network(address: str, node: str, spec: Ros2Spec) -> Network:
    """Return the settings of a robot's node in the ROS 2 network."""
    # With peers, the node must use the default port, to which the peers connect. Otherwise it uses any free port,
    # because another program of the robot may use the default port.
    settings = (
        {"listen/endpoints": json.dumps([f"tcp/{address}:0"])}
        if spec.middleware == "zenoh" and not spec.peers
        else {}
    )
    return Network(
        address,
        discovery=spec.discovery,
        peers=spec.peers,
        server=spec.router,
        domain=spec.domain,
        node=node,
        gid_bytes=Distribution.of(spec.distribution).gid_bytes,
        settings=settings,
    )


def _run_router(address: str) -> None:
    from fieldkit.agent.messaging import zenoh  # noqa: PLC0415 (only this command needs it)

    services.name_process(services.ZENOH_ROUTER)
    router = zenoh.route(Network(address, discovery="none"))
    services.ready_file(services.ZENOH_ROUTER).touch()
    signal.pause()
    router.close()


def _run_relay(  # noqa: PLR0917 (the words of the command line)
    address: str, node: str, velocities: str, velocity_type: str, ros2_json: str, types_json: str
) -> None:
    services.name_process(services.ROS2_RELAY)
    types = json.loads(types_json)
    spec = Ros2Spec.from_json(json.loads(ros2_json))
    relay = Ros2Relay(_network(address, node, spec), spec.middleware, Distribution.of(spec.distribution), types)
    if velocities:
        relay.relay_velocities(velocities, velocity_type)
    relay.log(f"publishing {', '.join(types)}" + (f"; driven by {velocities}" if velocities else ""))
    services.ready_file(services.ROS2_RELAY).touch()
    relay.run()


def main(argv: Sequence[str]) -> None:
    """Run a Zenoh router, or relay topics; returns only after a signal."""
    command, *words = argv
    if command == "route":
        _run_router(*words)
    else:
        _run_relay(*words)


if __name__ == "__main__":
    main(sys.argv[1:])
