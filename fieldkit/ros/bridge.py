"""Carry topics from one middleware to another, as bytes: ROS 1 to DDS or Zenoh and back.

Between the two generations of ROS rosbags converts them, without making messages of them; `seq` of a header, which
ROS 2 does not have, is lost on the way there and 0 on the way back. No sample goes in circles: each end passes over
what it published itself, told by caller id (ROS 1), participant (DDS) or session (Zenoh).
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

from fieldkit.agent import middleware
from fieldkit.agent.middleware import Middleware, MiddlewareError, Network, Publisher, Topic
from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.ros import counterparts, topics
from fieldkit.ros.counterparts import Counterparts
from fieldkit.ros.crossings import Crossed, Crossing, CrossingTally
from fieldkit.ros.types import MessageTypes

Convert = Callable[[bytes], bytes]

_PACKAGES: Final = "python3 -m pip install 'fieldkit[ros2]', and give an address of this machine"
_REMEDIES: Final = {
    "ros1": "start roscore or say where it is; what it takes here: apt-get install python3-rospy",
    "dds": _PACKAGES,
    "zenoh": _PACKAGES,
}


@dataclass(frozen=True)
class Side:
    """A middleware that a bridge stands in.

    Attributes:
        over: One of `middleware.ADAPTERS`.
        network: How it takes part there.
    """

    over: str
    network: Network


class Carrier:
    """Carries a topic one way.

    Args:
        crossing: Which.
        source: Where it comes from, started.
        target: Where it goes to, started.
        described: It by all its names, for either end.
        convert: Makes a message of the target's of one of the source's; raises `SerdeError` of what is none.
    """

    def __init__(
        self, crossing: Crossing, source: "_End", target: "_End", described: tuple[Topic, Topic], convert: Convert
    ) -> None:
        self._crossing, self._source, self._target, self._described = crossing, source, target, described
        self._convert = convert
        self._tally = CrossingTally()
        self._lock = threading.Lock()
        self._ended = False
        self._publisher: Publisher = target.running.publisher(described[1])
        source.running.subscribe(described[0], self._carry)

    def _carry(self, data: bytes, arrived_ns: int) -> None:
        """Take a sample, and hand it on: in threads of the source, one sample at a time, in their order."""
        with self._lock:
            if self._ended:
                return
            try:
                converted = self._convert(data)
            except SerdeError:
                self._tally.unreadable += 1
                return
            if self._publisher.write(converted):
                self._tally.carried(len(data), arrived_ns, time.time_ns())
            else:
                self._tally.refused += 1

    def end(self) -> None:
        """Carry nothing any more; a sample on its way is first handed on."""
        with self._lock:
            self._ended = True

    def other_types(self) -> Sequence[str]:
        """Return sentences about others that have the topic with another type, in which nothing is carried."""
        ends = zip((self._source, self._target), self._described, strict=True)
        return [sentence for end, topic in ends for sentence in end.other_types(topic)]

    def told(self) -> Crossed:
        """Return what was carried so far."""
        with self._lock:
            return self._tally.told(self._crossing, self._source.over, self._target.over)


@dataclass(frozen=True)
class _End:
    """A side whose middleware runs."""

    over: str
    network: Network
    running: Middleware

    def other_types(self, topic: Topic) -> Sequence[str]:
        """Return a sentence about each other type that the topic has there."""
        others = sorted(self.running.other_types(topic))
        return [f"{topic.name} is of type {other} in {self.over}, not {topic.type}" for other in others]


@contextmanager
def bridged(near: Side, far: Side, crossings: Sequence[Crossing], types: MessageTypes) -> Iterator[Sequence[Carrier]]:
    """Bridge two sides while the body runs.

    Args:
        near: What topics come from; those that go back go there.
        far: The other.
        crossings: What is carried.
        types: Where the types are known.

    Yields:
        What carries each of them.

    Raises:
        ConfigurationError: A topic cannot be carried so, or has another type there.
        LinkError: A middleware does not start: no ROS master answers, or it is not installed.
    """
    check(near, far, crossings, types)
    with ExitStack() as stack:
        ends = [stack.enter_context(_started(side)) for side in (near, far)]
        made: list[Carrier] = []
        for number, crossing in enumerate(crossings, 1):
            source, target = reversed(ends) if crossing.back else ends
            made.append(_carrier(crossing, source, target, types, number))
            stack.callback(made[-1].end)
        yield made


def check(near: Side, far: Side, crossings: Sequence[Crossing], types: MessageTypes) -> None:
    """See that everything can be carried, before anything starts.

    Raises:
        ConfigurationError: It cannot.
    """
    if near.over == far.over:
        # Nobody could tell what came by the bridge: both ends are the same node or share a network.
        raise ConfigurationError(f"a bridge from {near.over} to {far.over} is none", remedy="name two middlewares")
    ways = [(crossing.topic, crossing.back) for crossing in crossings]
    for one in crossings:
        if ways.count((one.topic, one.back)) > 1:
            raise ConfigurationError(f"{one.topic} is named twice for the same way", remedy="name it once")
        same = counterparts.of_type(types, one.type_name) if _is_ros1(near, far) else types.get(one.type_name).rihs01
        if not same:
            raise ConfigurationError(
                f"{one.topic}: {one.type_name} is not the same in ROS 1 and ROS 2, or there in one of them alone",
                remedy="carry a topic of another type",
            )


def _is_ros1(*sides: "Side | _End") -> bool:
    return any(side.over == "ros1" for side in sides)


@contextmanager
def _started(side: Side) -> Iterator[_End]:
    """Run a side's middleware while the body runs."""
    with ExitStack() as stack:
        if _is_ros1(side):
            # Where rospy writes its log, which nobody reads.
            os.environ["ROS_LOG_DIR"] = stack.enter_context(tempfile.TemporaryDirectory(prefix="fieldkit-"))
        try:
            running = middleware.adapter(side.over)(side.network)
        except MiddlewareError as error:
            raise LinkError(f"the bridge does not start: {error}", remedy=_REMEDIES[side.over]) from error
        stack.callback(running.close)
        yield _End(side.over, side.network, running)


def _carrier(crossing: Crossing, source: _End, target: _End, types: MessageTypes, number: int) -> Carrier:
    ends = (source, target)
    pair = counterparts.of_type(types, crossing.type_name) if _is_ros1(*ends) else None
    described = [
        Topic.from_json(
            topics.describe(
                types,
                crossing.topic,
                _type_at(end, crossing, pair),
                crossing.qos,
                domain=end.network.domain,
                node=end.network.node,
                number=number,
            )
        )
        for end in ends
    ]
    for end, topic in zip(ends, described, strict=True):
        # Where ends are found by and by, it is not known yet.
        for sentence in end.other_types(topic):
            raise ConfigurationError(sentence, remedy="name the topic with its own type")
    convert = _conversion(_is_ros1(source), pair, types)
    return Carrier(crossing, source, target, (described[0], described[1]), convert)


def _type_at(end: _End, crossing: Crossing, pair: Counterparts | None) -> str:
    """Return the name that the type of a crossing has at one of its ends."""
    if pair is None:
        return crossing.type_name
    return pair.ros1 if _is_ros1(end) else pair.ros2


def _conversion(from_ros1: bool, pair: Counterparts | None, types: MessageTypes) -> Convert:
    if pair is None:
        return lambda data: data
    return partial(pair.to_ros2 if from_ros1 else pair.to_ros1, types)
