"""Bridge topics between two middlewares as serialized messages: ROS 1, DDS and Zenoh.

Between ROS 1 and ROS 2, rosbags converts the bytes without deserializing them. Headers of ROS 2 have no `seq`: it is
omitted in messages to ROS 2, and is 0 in messages to ROS 1. Samples do not loop: each side ignores the samples that
it has published, identified by caller id (ROS 1), participant (DDS) or session (Zenoh).
"""

import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final

from rosbags.serde import SerdeError

from fieldkit.agent.messaging import middleware
from fieldkit.agent.messaging.middleware import Middleware, MiddlewareError, Network, Publisher, Topic
from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.ros.bridging import counterparts
from fieldkit.ros.bridging.counterparts import Counterparts
from fieldkit.ros.bridging.crossings import Crossing, CrossingCounts, CrossingTally
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.types import MessageTypes

Convert = Callable[[bytes], bytes]

_PACKAGES_REMEDY: Final = "python3 -m pip install 'fieldkit[ros2]', and give an address of this machine"
_REMEDIES: Final = {
    "ros1": "start roscore, or give its address; if rospy is missing here: apt-get install python3-rospy",
    "dds": _PACKAGES_REMEDY,
    "zenoh": _PACKAGES_REMEDY,
}


@dataclass(frozen=True)
class Side:
    """One side of a bridge.

    Attributes:
        middleware_name: Name of the middleware, one of `middleware.ADAPTERS`.
        network: Its network settings.
    """

    middleware_name: str
    network: Network


class Forwarder:
    """Forwards a topic in one direction.

    Args:
        crossing: The topic and its direction.
        source: The side whose nodes publish it.
        target: The side that it is forwarded to.
        topic_pair: The topic as the source and as the target describe it.
        convert: Converts a message of the source to one of the target; raises `SerdeError` for an invalid message.
    """

    def __init__(
        self,
        crossing: Crossing,
        source: "_RunningSide",
        target: "_RunningSide",
        topic_pair: tuple[Topic, Topic],
        convert: Convert,
    ) -> None:
        self._crossing, self._source, self._target, self._topic_pair = crossing, source, target, topic_pair
        self._convert = convert
        self._tally = CrossingTally()
        self._lock = threading.Lock()
        self._is_stopped = False
        self._publisher: Publisher = target.middleware.publisher(topic_pair[1])
        source.middleware.subscribe(topic_pair[0], self._forward)

    def _forward(self, data: bytes, arrived_ns: int) -> None:
        """Forward a sample. Called in threads of the source; samples are forwarded in sequence."""
        with self._lock:
            if self._is_stopped:
                return
            try:
                converted = self._convert(data)
            except SerdeError:
                self._tally.unreadable += 1
                return
            if self._publisher.write(converted):
                self._tally.count(len(data), arrived_ns, time.time_ns())
            else:
                self._tally.refused += 1

    def stop(self) -> None:
        """Wait until the current sample is forwarded; later samples are not forwarded."""
        with self._lock:
            self._is_stopped = True

    def type_conflicts(self) -> Sequence[str]:
        """Return an error message for each other type with which a node on either side uses the topic.

        Messages of these types are not forwarded.
        """
        sides = zip((self._source, self._target), self._topic_pair, strict=True)
        return [message for side, topic in sides for message in side.type_conflicts(topic)]

    def counts(self) -> CrossingCounts:
        """Return the counters of the forwarded, refused and unreadable samples."""
        with self._lock:
            return self._tally.counts(self._crossing, self._source.middleware_name, self._target.middleware_name)


@dataclass(frozen=True)
class _RunningSide:
    """A side of a bridge with its running middleware."""

    middleware_name: str
    network: Network
    middleware: Middleware

    def type_conflicts(self, topic: Topic) -> Sequence[str]:
        """Return an error message for each other type with which a node on this side uses the topic."""
        types = sorted(self.middleware.other_types(topic))
        return [
            f"{topic.name} is of type {other_type} in {self.middleware_name}, not {topic.type}"
            for other_type in types
        ]


@contextmanager
def bridge_topics(
    near: Side, far: Side, crossings: Sequence[Crossing], types: MessageTypes
) -> Iterator[Sequence[Forwarder]]:
    """Bridge topics between two sides while the body runs.

    Args:
        near: The first side, which is the source of the topics without `Crossing.back`, and the target of the others.
        far: The second side.
        crossings: The topics.
        types: The message types.

    Yields:
        A forwarder for each crossing.

    Raises:
        ConfigurationError: A topic cannot be bridged, or has a different type on one side.
        LinkError: A middleware does not start, because no ROS master answers or the middleware is not installed.
    """
    check(near, far, crossings, types)
    with ExitStack() as stack:
        sides = [stack.enter_context(_running_side(side)) for side in (near, far)]
        forwarders: list[Forwarder] = []
        for number, crossing in enumerate(crossings, 1):
            source, target = reversed(sides) if crossing.back else sides
            forwarders.append(_create_forwarder(crossing, source, target, types, number))
            stack.callback(forwarders[-1].stop)
        yield forwarders


def check(near: Side, far: Side, crossings: Sequence[Crossing], types: MessageTypes) -> None:
    """Check that all topics can be bridged, before any middleware starts.

    Raises:
        ConfigurationError: A topic cannot be bridged.
    """
    if near.middleware_name == far.middleware_name:
        # Both sides would be the same node, or share a network, so forwarded samples could not be recognized.
        raise ConfigurationError(
            f"a bridge cannot connect {near.middleware_name} with {far.middleware_name}",
            remedy="name two different middlewares",
        )
    directions = [(crossing.topic, crossing.back) for crossing in crossings]
    for crossing in crossings:
        topic, type_name = crossing.topic, crossing.type_name
        if directions.count((topic, crossing.back)) > 1:
            raise ConfigurationError(f"{topic} is named twice for the same direction", remedy="name it once")
        if _uses_ros1(near, far):
            can_be_bridged = counterparts.of_type(types, type_name) is not None
        else:
            can_be_bridged = bool(types.get(type_name).rihs01)  # the type exists in ROS 2
        if not can_be_bridged:
            raise ConfigurationError(
                f"{topic}: {type_name} differs between ROS 1 and ROS 2, or exists in one of them only",
                remedy="bridge a topic of another type",
            )


def _uses_ros1(*sides: "Side | _RunningSide") -> bool:
    return any(side.middleware_name == "ros1" for side in sides)


@contextmanager
def _running_side(side: Side) -> Iterator[_RunningSide]:
    """Start the middleware of a side, and stop it after the body."""
    with ExitStack() as stack:
        if _uses_ros1(side):
            # rospy always writes a log. It is not needed, so it is deleted with the folder.
            os.environ["ROS_LOG_DIR"] = stack.enter_context(tempfile.TemporaryDirectory(prefix="fieldkit-"))
        try:
            running = middleware.adapter(side.middleware_name)(side.network)
        except MiddlewareError as error:
            raise LinkError(f"the bridge does not start: {error}", remedy=_REMEDIES[side.middleware_name]) from error
        stack.callback(running.close)
        yield _RunningSide(side.middleware_name, side.network, running)


def _create_forwarder(
    crossing: Crossing, source: _RunningSide, target: _RunningSide, types: MessageTypes, number: int
) -> Forwarder:
    """Describe the topic for both sides, check its type there, and start to forward it."""
    sides = (source, target)
    pair = counterparts.of_type(types, crossing.type_name) if _uses_ros1(*sides) else None
    topic_pair = [
        Topic.from_json(
            topics.describe(
                types,
                crossing.topic,
                _type_at(side, crossing, pair),
                crossing.qos,
                domain=side.network.domain,
                node=side.network.node,
                number=number,
            )
        )
        for side in sides
    ]
    for side, topic in zip(sides, topic_pair, strict=True):
        # This finds only the endpoints that are already discovered; `Forwarder.type_conflicts` reports later ones.
        for message in side.type_conflicts(topic):
            raise ConfigurationError(message, remedy="name the topic with that type")
    convert = _conversion(_uses_ros1(source), pair, types)
    return Forwarder(crossing, source, target, (topic_pair[0], topic_pair[1]), convert)


def _type_at(side: _RunningSide, crossing: Crossing, pair: Counterparts | None) -> str:
    """Return the name of a crossing's type on one side."""
    if pair is None:
        return crossing.type_name
    return pair.ros1 if _uses_ros1(side) else pair.ros2


def _conversion(from_ros1: bool, pair: Counterparts | None, types: MessageTypes) -> Convert:
    if pair is None:
        return lambda data: data
    return partial(pair.to_ros2 if from_ros1 else pair.to_ros1, types)
