"""Publishes an emulated robot's sensors over DDS or Zenoh, as nodes of ROS 2 do; or routes for those of Zenoh.

Its words are `route` and the robot's address; or `relay`, that, the node's name, the topic of velocities that its
base listens to, which may be empty, and as JSON how it takes part, the type of each topic, and which frames lie in
which. The sensors process makes each message; here it is turned into CDR as the robot's distribution defines the
type, and published while somebody subscribes, wherever on the radio. Velocities go the other way.
"""

import contextlib
import json
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from rosbags.convert.converter import migrate_bytes
from rosbags.serde import SerdeError

from fieldkit.agent import middleware
from fieldkit.agent.middleware import Network, Publisher, Topic
from fieldkit.ros import topics
from fieldkit.ros.qos import PROFILES, Durability, QosProfile
from fieldkit.ros.types import Distribution, MessageTypes
from sim_backends.emulated.robot import services, twists
from sim_backends.emulated.robot.spec import Ros2Spec
from sim_backends.emulated.ros import static_frames
from sim_backends.emulated.ros.listener import Listener

QOS: Final[Mapping[str, QosProfile]] = {
    f"sensor_msgs/{name}": PROFILES["sensor_data"]
    for name in ("LaserScan", "Image", "CompressedImage", "PointCloud2")
}
"""Quality of service by type where it is not ROS 2's default: as drivers publish large messages."""

LATCHED: Final = replace(PROFILES["default"], depth=1, durability=Durability.TRANSIENT_LOCAL)
"""As tf2 says what does not change (tf2_ros, qos.hpp, StaticBroadcasterQoS)."""

_LOOKS_S: Final = 0.1
"""How often the relay looks who subscribes; ROS 2's own recorder looks as often for new publishers."""


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
        self._frames: Publisher | None = None
        for topic, kind in types.items():
            described = self._topic(topic, kind, QOS.get(kind, PROFILES["default"]))
            self._publishers[topic] = self._middleware.publisher(described)
            self._conversions[topic] = self._conversion(described.type)

    def _topic(self, name: str, kind: str, quality: QosProfile) -> Topic:
        """Return a topic by all its names, with the number of its end."""
        self._ends += 1
        domain, node = self._network.domain, self._network.node
        described = topics.describe(self._known, name, kind, quality, domain=domain, node=node, number=self._ends)
        return Topic.from_json(described)

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

    def say_frames(self, found: Sequence[static_frames.Link]) -> None:
        """Say which frames lie in which, once for all who come."""
        described = self._topic(static_frames.TOPIC, static_frames.TYPE, LATCHED)
        self._frames = self._middleware.publisher(described)
        self._frames.write(self._conversion(described.type)(static_frames.message(found, time.time_ns())))

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
        """Hear the topics that somebody subscribes to, and no others: those are not made."""
        listener = self._listener
        for topic, publisher in self._publishers.items():
            if publisher.matched():
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
    how, types, frames = map(json.loads, told)
    spec = Ros2Spec.from_json(how)
    relay = Ros2Relay(_network(address, node, spec), spec.over, Distribution.of(spec.distribution), types)
    if velocities:
        relay.hear_velocities(velocities)
    if frames:
        relay.say_frames(frames)
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
