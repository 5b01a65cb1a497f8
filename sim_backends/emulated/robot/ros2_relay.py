"""Publishes an emulated robot's sensors over DDS or Zenoh, as nodes of ROS 2 do; or routes for those of Zenoh.

Its words are `route` and the robot's address; or `relay`, that, the node's name, the topic of velocities that its
base listens to, which may be empty, and as JSON how it takes part, and the type of each topic. The sensors process
makes each message; here it is turned into CDR as the robot's distribution defines the type, and published while it
has subscribers anywhere on the radio; `/tf_static` always, for those that come later. Velocities
go the other way. The node logs on `/rosout`.
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

from fieldkit.agent import middleware
from fieldkit.agent.middleware import Network, Publisher, Topic
from fieldkit.ros import topics
from fieldkit.ros.qos import PROFILES, QosProfile
from fieldkit.ros.types import Distribution, MessageTypes
from sim_backends.emulated.robot import services, twists
from sim_backends.emulated.robot.spec import Ros2Spec
from sim_backends.emulated.ros import offered_qos, static_frames
from sim_backends.emulated.ros.listener import Listener

_LOOKS_S: Final = 0.1
"""How often the relay looks who subscribes; ROS 2's own recorder looks as often for new publishers."""


_LOG: Final = "rcl_interfaces/msg/Log"
_INFO: Final = 20
"""`rcl_interfaces/msg/Log.INFO`."""


class Ros2Relay:
    """Hands on what the sensors say.

    Args:
        network: How the robot takes part.
        over: `dds` or `zenoh`.
        distribution: Of ROS 2.
        types: ROS 1 type of each topic, by its name.
    """

    def __init__(self, network: Network, over: str, distribution: Distribution, types: Mapping[str, str]) -> None:
        self._known = MessageTypes(distribution)
        self._network = network
        self._listener = Listener()
        self._middleware = middleware.adapter(over)(network)
        self._publishers: dict[str, Publisher] = {}
        self._conversions: dict[str, Callable[[bytes], bytes]] = {}
        self._ends = 0
        self._heard: set[str] = set()
        self._rosout = self._middleware.publisher(self._topic("/rosout", _LOG, offered_qos.ROSOUT))
        for topic, kind in types.items():
            described = self._topic(topic, kind, offered_qos.of_topic(topic, kind))
            self._publishers[topic] = self._middleware.publisher(described)
            self._conversions[topic] = self._conversion(described.type)

    def _topic(self, name: str, kind: str, quality: QosProfile) -> Topic:
        """Return a topic by all its names, with the number of its end."""
        self._ends += 1
        domain, node = self._network.domain, self._network.node
        described = topics.describe(self._known, name, kind, quality, domain=domain, node=node, number=self._ends)
        return Topic.from_json(described)

    def log(self, text: str) -> None:
        """Publish a line of level INFO on `/rosout`, as rclcpp and rclpy do; file, function and line are empty."""
        known, now_ns = self._known.ros2, time.time_ns()
        stamp = known.types["builtin_interfaces/msg/Time"](*divmod(now_ns, 10**9))
        line = known.types[_LOG](
            stamp=stamp, level=_INFO, name=self._network.node, msg=text, file="", function="", line=0
        )
        self._rosout.write(bytes(known.serialize_cdr(line, _LOG)))

    def _conversion(self, kind: str) -> Callable[[bytes], bytes]:
        defaults: dict[str, Any] = {}
        known = self._known
        return lambda data: bytes(
            migrate_bytes(known.ros1, known.ros2, kind, kind, defaults, data, src_is2=False, dst_is2=True)
        )

    def hear_velocities(self, topic: str) -> None:
        """Hand each `geometry_msgs/Twist` of a topic on to the base, which may be on its way back."""
        kind, channel = "geometry_msgs/msg/Twist", socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        known = self._known

        def hand_on(data: bytes, _: int) -> None:
            with contextlib.suppress(OSError, SerdeError):  # nobody listens; or it is none
                channel.sendto(bytes(known.ros2.cdr_to_ros1(data, kind)), str(twists.CHANNEL))

        self._middleware.subscribe(self._topic(topic, kind, PROFILES["default"]), hand_on)

    def run(self) -> None:
        """Hand on until a signal ends it."""
        listener, next_look_s = self._listener, 0.0
        while listener.stopped_by is None:
            if time.monotonic() >= next_look_s:
                next_look_s = time.monotonic() + _LOOKS_S
                self._look()
            for header, message in listener.events(_LOOKS_S):
                if message is not None:
                    self._publishers[header["topic"]].write(self._conversions[header["topic"]](message))
        self._middleware.close()

    def _look(self) -> None:
        """Receive the topics that have subscribers, and `/tf_static`; the others are not made."""
        listener = self._listener
        for topic, publisher in self._publishers.items():
            heard = publisher.matched() > 0
            if heard != (topic in self._heard):
                self.log(f"{topic} has {'a subscriber' if heard else 'no subscriber any more'}")
                self._heard ^= {topic}
            if topic == static_frames.TOPIC or heard:
                listener.wanted.add(topic)
            else:
                listener.wanted.discard(topic)
                listener.leave(topic)
        listener.subscribe()


def _network(address: str, node: str, how: Ros2Spec) -> Network:
    """Return how a node of a robot takes part."""
    # With peers its port is known to the others; else another program of the robot's may have it.
    own = {"listen/endpoints": json.dumps([f"tcp/{address}:0"])} if how.over == "zenoh" and not how.peers else {}
    return Network(
        address,
        discovery=how.discovery,
        peers=how.peers,
        server=how.router,
        domain=how.domain,
        node=node,
        gid_bytes=Distribution.of(how.distribution).gid_bytes,
        settings=own,
    )


def _route(address: str) -> None:
    from fieldkit.agent import zenoh  # noqa: PLC0415 (only where it is asked for)

    services.name_process(services.ZENOH_ROUTER)
    running = zenoh.route(Network(address, discovery="none"))
    services.ready_file(services.ZENOH_ROUTER).touch()
    signal.pause()
    running.close()


def _relay(address: str, node: str, velocities: str, *told: str) -> None:
    services.name_process(services.ROS2_RELAY)
    how, types = map(json.loads, told)
    spec = Ros2Spec.from_json(how)
    relay = Ros2Relay(_network(address, node, spec), spec.over, Distribution.of(spec.distribution), types)
    if velocities:
        relay.hear_velocities(velocities)
    relay.log(f"publishing {', '.join(types)}" + (f"; driven by {velocities}" if velocities else ""))
    services.ready_file(services.ROS2_RELAY).touch()
    relay.run()


def main(argv: Sequence[str]) -> None:
    """Route at an address, or relay topics; for ever."""
    verb, *words = argv
    if verb == "route":
        _route(*words)
    else:
        _relay(*words)


if __name__ == "__main__":
    main(sys.argv[1:])
