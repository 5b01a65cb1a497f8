"""Process of an emulated robot that publishes its sensors, each at its rate.

Message `n` of a topic is due at `start + n / rate` on the monotonic clock, so rates do not drift. A topic without
subscribers is not generated, so that an idle robot uses no processor time.
"""

import contextlib
import math
import selectors
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from sim_backends.emulated.ros import static_frames, tcpros
from sim_backends.emulated.ros.messages import Source
from sim_backends.emulated.ros.robot_motion import Odometer
from sim_backends.emulated.ros.sensor_specs import Definition, LaserTarget, Sensor
from sim_backends.ros1 import framing

QUEUE_BYTES: Final = 4 << 20
"""Amount of unsent data from which on further messages are dropped for a slow subscriber."""

_CHUNK_BYTES: Final = 1 << 16


class Subscriber:
    """One subscriber, from its connection until it disconnects.

    Args:
        stream: Its socket.
        greeting: First packets for every subscriber: the connection header, and the message of a latched topic.
        selector: Selector of the process; the key's data is the function to call with the events, `serve`.

    Attributes:
        is_subscribed: True if it has requested the topic.
        is_disconnected: True if it has disconnected, or was disconnected because it violates the protocol.
    """

    def __init__(self, stream: socket.socket, greeting: bytes, selector: selectors.BaseSelector) -> None:
        self.is_subscribed = False
        self.is_disconnected = False
        self._stream = stream
        self._greeting = greeting
        self._selector = selector
        self._packets = framing.PacketSplitter()
        self._unsent = bytearray()
        stream.setblocking(False)
        selector.register(stream, selectors.EVENT_READ, self.serve)

    def send(self, packet: bytes) -> None:
        """Send a packet as soon as the socket is writable; drop it if too much data is unsent."""
        if not self.is_disconnected and len(self._unsent) < QUEUE_BYTES:
            self._unsent += packet
            self._flush()

    def serve(self, events: int) -> None:
        """Handle the events of the socket."""
        if events & selectors.EVENT_WRITE:
            self._flush()
        if events & selectors.EVENT_READ and not self.is_disconnected:
            self._read()

    def _flush(self) -> None:
        """Send as much as the socket accepts; the remaining data are sent when the socket is writable again."""
        try:
            with contextlib.suppress(BlockingIOError):
                del self._unsent[: self._stream.send(self._unsent)]
        except OSError:
            self._disconnect()
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._unsent else 0)
        if self._selector.get_key(self._stream).events != events:
            self._selector.modify(self._stream, events, self.serve)

    def _read(self) -> None:
        """Receive data. A subscriber that has closed its socket, or violates the protocol, is disconnected."""
        try:
            data = self._stream.recv(_CHUNK_BYTES)
            if not self.is_subscribed:
                self._packets.feed(data)
                self._send_greeting()
        except BlockingIOError:
            return
        except (OSError, ValueError):
            data = b""
        if not data and not self.is_disconnected:
            self._disconnect()

    def _send_greeting(self) -> None:
        """Send the greeting once the subscriber's connection header is complete; later data are ignored."""
        for packet in self._packets:
            framing.unpack_header(packet)
            self.is_subscribed = True
            self.send(self._greeting)
            return

    def _disconnect(self) -> None:
        self.is_disconnected = True
        self._selector.unregister(self._stream)
        self._stream.close()


class TopicSocket:
    """The socket of one topic, and its subscribers.

    Args:
        topic: Name of the topic.
        header: Fields of the connection header.
        selector: Selector of the process; each key's data is the function to call with the events.
        latched_message: The message for each new subscriber; empty for a topic that is not latched.

    Raises:
        OSError: The socket cannot be created.
    """

    def __init__(
        self, topic: str, header: Mapping[str, str], selector: selectors.BaseSelector, latched_message: bytes = b""
    ) -> None:
        self._greeting = framing.pack(framing.pack_header(header))
        if latched_message:
            self._greeting += framing.pack(latched_message)
        self._selector = selector
        self._subscribers: list[Subscriber] = []
        path = tcpros.socket_path(topic)
        path.unlink(missing_ok=True)  # the file remains if an earlier process was killed
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(path))
        self._socket.listen()
        selector.register(self._socket, selectors.EVENT_READ, self._accept)

    def subscribers(self) -> list[Subscriber]:
        """Return the subscribers that have requested the topic and are still connected."""
        self._subscribers = [subscriber for subscriber in self._subscribers if not subscriber.is_disconnected]
        return [subscriber for subscriber in self._subscribers if subscriber.is_subscribed]

    def _accept(self, _events: int) -> None:
        stream, _ = self._socket.accept()
        self._subscribers = [subscriber for subscriber in self._subscribers if not subscriber.is_disconnected]
        self._subscribers.append(Subscriber(stream, self._greeting, self._selector))


class Publication:
    """One published topic.

    Args:
        sensor: The sensor.
        definition: Definition of its message type.
        start_s: Time at which message 0 was due, on the monotonic clock.
        odometer: Source of the robot's motion.
        selector: Selector of the process; each key's data is the function to call with the events.
        targets: Laser targets in the robot's world.
        moving_targets: Returns the laser targets that move: the other robots at their current positions.
    """

    def __init__(
        self,
        sensor: Sensor,
        definition: Definition,
        start_s: float,
        odometer: Odometer,
        selector: selectors.BaseSelector,
        *,
        targets: Sequence[LaserTarget] = (),
        moving_targets: Callable[[], Sequence[LaserTarget]] = tuple,
    ) -> None:
        self._odometer = odometer
        self._sensor = sensor
        self._source = Source(sensor, targets, moving_targets)
        self._start_s = start_s
        # Number of the next message; None while there is no subscriber.
        self._number: int | None = None
        self._topic_socket = TopicSocket(sensor.topic, _header(sensor.topic, sensor.type, definition), selector)

    def publish(self) -> float:
        """Publish the next message if it is due; return the seconds until the next (infinite without subscribers)."""
        subscribers = self._topic_socket.subscribers()
        if not subscribers:
            self._number = None
            return math.inf
        elapsed_s, rate_hz = time.monotonic() - self._start_s, self._sensor.rate_hz
        if self._number is None:
            self._number = math.ceil(elapsed_s * rate_hz)
        elif self._number <= elapsed_s * rate_hz:
            current_motion = self._odometer.at(time.monotonic_ns())
            packet = framing.pack(self._source.message(self._number, time.time_ns(), current_motion))
            for subscriber in subscribers:
                subscriber.send(packet)
            self._number += 1
        return self._number / rate_hz - elapsed_s


def publish(
    sensors: Sequence[Sensor],
    definitions: Mapping[str, Definition],
    *,
    frames: Sequence[static_frames.Link],
    targets: Sequence[LaserTarget] = (),
    moving_targets: Callable[[], Sequence[LaserTarget]] = tuple,
    assigned_paths: Path,
    motion_record: Path,
    ready: Path,
) -> None:
    """Publish until the process is killed.

    Args:
        sensors: The sensors.
        definitions: Definitions of their message types, and of `static_frames.TYPE` if there are frames.
        frames: Links in `/tf_static`, which is published once and latched; empty for a robot without it.
        targets: Laser targets in the robot's world.
        moving_targets: Returns the laser targets that move: the other robots at their current positions.
        assigned_paths: The file of the paths that the lab assigns (`assigned_path.append_path`).
        motion_record: The file in which a robot that steers itself records its motion
            (`robot_motion.MotionReporter`).
        ready: File that is created when every topic can be subscribed to.

    Raises:
        ConfigurationError: The error of `messages.Source`.
        OSError: A socket cannot be created.
    """
    start_s = time.monotonic()
    Path(tcpros.FOLDER).mkdir(exist_ok=True)
    selector = selectors.DefaultSelector()
    odometer = Odometer(assigned_paths, time.monotonic_ns(), motion_record)
    publications = [
        Publication(
            sensor,
            definitions[sensor.type],
            start_s,
            odometer,
            selector,
            targets=targets,
            moving_targets=moving_targets,
        )
        for sensor in sensors
    ]
    if frames:
        header = _header(static_frames.TOPIC, static_frames.TYPE, definitions[static_frames.TYPE], latching=True)
        TopicSocket(static_frames.TOPIC, header, selector, static_frames.message(frames, time.time_ns()))
    ready.touch()
    while True:
        next_s = min((publication.publish() for publication in publications), default=math.inf)
        for key, events in selector.select(None if next_s == math.inf else next_s):
            key.data(events)


def _header(topic: str, kind: str, definition: Definition, *, latching: bool = False) -> dict[str, str]:
    return {
        "callerid": tcpros.CALLER,
        "latching": str(int(latching)),
        "md5sum": definition.md5,
        "message_definition": definition.text,
        "topic": topic,
        "type": kind,
    }
