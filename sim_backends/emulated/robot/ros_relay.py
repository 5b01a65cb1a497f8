"""Publishes an emulated robot's sensors to its ROS master; runs under Debian's own Python, which has rospy.

Its words are the node's name, the topic of velocities that its base listens to, which may be empty, and the topics
that it publishes. The master may be another robot's, over the radio. The sensors process makes and serializes each
message; here it is handed on as it is, while somebody subscribes. So are velocities, to the base.
"""

import contextlib
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Final
from urllib.parse import urlsplit

import roslib.message  # type: ignore[import-not-found]
import rospy

from fieldkit.core.deadline import Deadline
from sim_backends.emulated.robot import services, twists
from sim_backends.emulated.ros import tcpros

_MASTER_S: Final = 20.0
_CONNECT_S: Final = 5.0
_SENSORS_S: Final = 20.0
_QUEUE_MESSAGES: Final = 100
_CHUNK: Final = 1 << 16


class Relay(rospy.SubscribeListener):  # type: ignore[misc]  # rospy has no types
    """Publishes one topic of the sensors process: while it has subscribers, or always where it is latched.

    Args:
        topic: Its name.
    """

    def __init__(self, topic: str) -> None:
        super().__init__()
        self._topic = topic
        self._stream: socket.socket | None = None
        # A subscriber that waits for the topic comes while the publisher is being made.
        self._busy = threading.Lock()
        stream, packets = _subscribe(topic)
        with stream:
            header = tcpros.unpack_header(_next(stream, packets))
        self._message = _message_class(header)
        self._latched = header["latching"] == "1"
        with self._busy:
            self._publisher = rospy.Publisher(
                topic, self._message, subscriber_listener=self, queue_size=_QUEUE_MESSAGES, latch=self._latched
            )
        if self._latched:
            self._start()

    def peer_subscribe(self, *_: object) -> None:
        """Begin with the first subscriber."""
        self._start()

    def _start(self) -> None:
        with self._busy:
            if self._stream is None:
                self._stream, packets = _subscribe(self._topic)
                threading.Thread(target=self._hand_on_for_ever, args=(self._stream, packets), daemon=True).start()

    def peer_unsubscribe(self, _topic: str, subscribers: int) -> None:
        """End with the last; rospy keeps the message of a latched topic, whose subscribers come and go."""
        with self._busy:
            if subscribers == 0 and self._stream is not None and not self._latched:
                with contextlib.suppress(OSError):  # the sensors ended
                    self._stream.shutdown(socket.SHUT_RDWR)
                self._stream = None

    def _hand_on_for_ever(self, stream: socket.socket, packets: tcpros.PacketSplitter) -> None:
        """Hand on until nobody listens; sensors that ended come back."""
        while True:
            self._hand_on(stream, packets)
            with self._busy:
                if self._stream is not stream:
                    return
                stream, packets = _subscribe(self._topic)
                self._stream = stream

    def _hand_on(self, stream: socket.socket, packets: tcpros.PacketSplitter) -> None:
        with stream:
            _next(stream, packets)  # the connection header
            while payload := _next(stream, packets):
                message = self._message()
                message.deserialize(payload)
                self._publisher.publish(message)


def _hand_velocities_on(topic: str) -> None:
    """Hand each `geometry_msgs/Twist` on to the base, which may be on its way back."""
    channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def hand_on(message: Any) -> None:  # noqa: ANN401 (rospy has no types)
        linear, angular = message.linear, message.angular
        words = twists.pack(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
        with contextlib.suppress(OSError):
            channel.sendto(words, str(twists.CHANNEL))

    rospy.Subscriber(topic, roslib.message.get_message_class("geometry_msgs/Twist"), hand_on, queue_size=1)


def _subscribe(topic: str) -> tuple[socket.socket, tcpros.PacketSplitter]:
    stream = _connect(str(tcpros.socket_path(topic)))
    stream.sendall(tcpros.request("/ros_relay", topic))
    return stream, tcpros.PacketSplitter()


def _connect(path: str) -> socket.socket:
    """Connect to the sensors, which may be on their way back."""
    deadline = Deadline.after(_SENSORS_S)
    while True:
        stream = socket.socket(socket.AF_UNIX)
        try:
            stream.connect(path)
        except (ConnectionRefusedError, FileNotFoundError):
            stream.close()
            if deadline.expired:
                raise
            time.sleep(0.01)
        else:
            return stream


def _next(stream: socket.socket, packets: tcpros.PacketSplitter) -> bytes:
    """Return the next packet, empty at the end."""
    while True:
        for payload in packets:
            return payload
        try:
            data = stream.recv(_CHUNK)
        except ConnectionResetError:
            data = b""
        if not data:
            return b""
        packets.feed(data)


def _message_class(header: dict[str, str]) -> Any:  # noqa: ANN401 (rospy has no types)
    """Return a message type whose content stays serialized.

    Where ROS's own class is installed, its definition is announced: it carries the comments, as on a real robot.
    """
    known = roslib.message.get_message_class(header["type"])
    attributes = {
        "_type": header["type"],
        "_md5sum": header["md5sum"],
        "_full_text": known._full_text if known else header["message_definition"],  # noqa: SLF001 (ROS's own name)
    }
    return type("Relayed", (rospy.AnyMsg,), attributes)


def _wait(what: str, condition: Callable[[], bool]) -> None:
    deadline = Deadline.after(_MASTER_S)
    while not condition():
        if deadline.expired:
            raise TimeoutError(what)
        time.sleep(0.01)


def master_answers() -> bool:
    """Return whether somebody listens where the robot's master is to be."""
    uri = urlsplit(os.environ["ROS_MASTER_URI"])
    with contextlib.suppress(OSError), socket.create_connection((uri.hostname, uri.port), timeout=_CONNECT_S):
        return True
    return False


def main() -> None:
    """Relay topics of the robot for ever."""
    services.name_process("ros_relay")
    node, velocities, *topics = sys.argv[1:]
    _wait("the sensors do not publish", services.ready_file("sensors").exists)
    _wait("no ROS master", master_answers)
    rospy.init_node(node, disable_signals=True)
    relays = [Relay(topic) for topic in topics]
    if velocities:
        _hand_velocities_on(velocities)
    services.ready_file("ros_relay").touch()
    rospy.spin()
    del relays


if __name__ == "__main__":
    main()
