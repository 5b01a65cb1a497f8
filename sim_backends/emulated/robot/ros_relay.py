"""Publishes an emulated robot's sensors to its ROS master; runs under Debian's Python, which has rospy.

The command line is `NODE VELOCITY_TOPIC VELOCITY_TYPE TOPIC...`; the two words about velocities are empty for a robot
without a base. The master may run on another robot, over the radio. The sensors process creates and serializes each
message; the relay publishes it unchanged while the topic has subscribers, or always if the topic is latched. It also
sends received velocities to the base.
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
from sim_backends.emulated.robot import base_process, services
from sim_backends.emulated.ros import tcpros
from sim_backends.ros1 import framing

_STARTUP_S: Final = 20.0
"""Timeout for the start of the sensors process, and of the ROS master."""
_CONNECT_S: Final = 5.0
"""Timeout of one connection attempt to the master."""
_SENSORS_S: Final = 20.0
"""Timeout for the restart of the sensors process."""
_QUEUE_MESSAGES: Final = 100
"""Length of the queue of a topic's publisher; if it is full, a slow subscriber loses the oldest messages."""
_CHUNK_BYTES: Final = 1 << 16


class Relay(rospy.SubscribeListener):  # type: ignore[misc]  # rospy has no types
    """Publishes one topic of the sensors process while the topic has subscribers, or always if it is latched.

    Args:
        topic: Name of the topic.
    """

    def __init__(self, topic: str) -> None:
        super().__init__()
        self._topic = topic
        self._stream: socket.socket | None = None
        # rospy calls `peer_subscribe` in other threads, possibly before the publisher has been assigned.
        self._lock = threading.Lock()
        stream, packets = _subscribe(topic)
        with stream:
            header = framing.unpack_header(_next_packet(stream, packets))
        self._message = _message_class(header)
        self._is_latched = header["latching"] == "1"
        with self._lock:
            self._publisher = rospy.Publisher(
                topic, self._message, subscriber_listener=self, queue_size=_QUEUE_MESSAGES, latch=self._is_latched
            )
        if self._is_latched:
            self._start()

    def peer_subscribe(self, *_: object) -> None:
        """Start when the first subscriber connects; called by rospy."""
        self._start()

    def _start(self) -> None:
        with self._lock:
            if self._stream is None:
                self._stream, packets = _subscribe(self._topic)
                threading.Thread(
                    target=self._relay_until_unsubscribed, args=(self._stream, packets), daemon=True
                ).start()

    def peer_unsubscribe(self, _topic: str, subscribers: int) -> None:
        """Stop when the last subscriber disconnects, unless the topic is latched; called by rospy."""
        with self._lock:
            if subscribers == 0 and self._stream is not None and not self._is_latched:
                with contextlib.suppress(OSError):  # the sensors process has exited
                    self._stream.shutdown(socket.SHUT_RDWR)
                self._stream = None

    def _relay_until_unsubscribed(self, stream: socket.socket, packets: framing.PacketSplitter) -> None:
        """Relay messages until the last subscriber leaves; reconnect if the sensors process restarts."""
        while True:
            self._relay(stream, packets)
            with self._lock:
                if self._stream is not stream:
                    return
                stream, packets = _subscribe(self._topic)
                self._stream = stream

    def _relay(self, stream: socket.socket, packets: framing.PacketSplitter) -> None:
        with stream:
            _next_packet(stream, packets)  # the connection header
            while payload := _next_packet(stream, packets):
                message = self._message()
                message.deserialize(payload)
                self._publisher.publish(message)


def _relay_velocities(topic: str, kind: str) -> None:
    """Send each velocity to the base; outdated messages, and all messages while the base restarts, are dropped.

    Args:
        topic: Name of the topic.
        kind: Its type, `geometry_msgs/Twist` or `geometry_msgs/TwistStamped`.
    """
    channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def send(message: Any) -> None:  # noqa: ANN401 (rospy has no types)
        if kind == base_process.STAMPED:
            if base_process.is_outdated(message.header.stamp.to_nsec(), time.time_ns()):
                return
            message = message.twist
        with contextlib.suppress(OSError):
            channel.sendto(base_process.pack(message), str(base_process.CHANNEL))

    rospy.Subscriber(topic, roslib.message.get_message_class(kind), send, queue_size=1)


def _subscribe(topic: str) -> tuple[socket.socket, framing.PacketSplitter]:
    stream = _connect(str(tcpros.socket_path(topic)))
    stream.sendall(tcpros.request("/ros_relay", topic))
    return stream, framing.PacketSplitter()


def _connect(path: str) -> socket.socket:
    """Connect to the sensors process; wait if it is restarting."""
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


def _next_packet(stream: socket.socket, packets: framing.PacketSplitter) -> bytes:
    """Return the next packet, or b"" at the end of the stream."""
    while True:
        for payload in packets:  # returns the first complete packet, if there is one
            return payload
        try:
            data = stream.recv(_CHUNK_BYTES)
        except ConnectionResetError:
            data = b""
        if not data:
            return b""
        packets.feed(data)


def _message_class(header: dict[str, str]) -> Any:  # noqa: ANN401 (rospy has no types)
    """Return a message class whose content stays serialized.

    If the class of ROS for that type is installed, its definition is announced, with comments, as on a real robot.
    """
    installed_class = roslib.message.get_message_class(header["type"])
    attributes = {
        "_type": header["type"],
        "_md5sum": header["md5sum"],
        "_full_text": installed_class._full_text if installed_class else header["message_definition"],  # noqa: SLF001 (ROS's own name)
    }
    return type("Relayed", (rospy.AnyMsg,), attributes)


def _wait(error_text: str, condition: Callable[[], bool]) -> None:
    deadline = Deadline.after(_STARTUP_S)
    while not condition():
        if deadline.expired:
            raise TimeoutError(error_text)
        time.sleep(0.01)


def master_answers() -> bool:
    """Return True if a process listens at the address of the robot's master."""
    uri = urlsplit(os.environ["ROS_MASTER_URI"])
    with contextlib.suppress(OSError), socket.create_connection((uri.hostname, uri.port), timeout=_CONNECT_S):
        return True
    return False


def main() -> None:
    """Relay the robot's topics; does not return."""
    services.name_process("ros_relay")
    node, velocities, velocity_type, *topics = sys.argv[1:]
    _wait("the sensors do not publish", services.ready_file("sensors").exists)
    _wait("the ROS master does not answer", master_answers)
    rospy.init_node(node, disable_signals=True)
    relays = [Relay(topic) for topic in topics]
    if velocities:
        _relay_velocities(velocities, velocity_type)
    services.ready_file("ros_relay").touch()
    rospy.spin()
    del relays  # rospy has finished; until now, this list prevented the garbage collection of the relays


if __name__ == "__main__":
    main()
