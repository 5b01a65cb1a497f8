"""The process in an emulated robot that publishes its sensors, each at its true rate.

Message `n` of a topic is due at `start + n / rate` on the monotonic clock, so rates do not drift. A topic that nobody
hears is not made: a robot at rest costs no time.
"""

import contextlib
import math
import selectors
import socket
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from sim_backends.emulated.ros import tcpros
from sim_backends.emulated.ros.messages import Definition, Sensor, Source
from sim_backends.emulated.ros.own_motion import Odometer

QUEUE_BYTES: Final = 4 << 20
"""What a slow subscriber may leave unread; beyond it messages are dropped for it, as from a ROS publisher's queue."""

_CHUNK_BYTES: Final = 1 << 16


class Subscriber:
    """One subscriber, from its connection to its end.

    Args:
        stream: Its socket.
        header: What it is told of the topic before all messages: a packet.
        selector: Waits for the socket; it is told to call `serve` with the events.

    Attributes:
        hears: Whether it has asked for the topic.
        gone: Whether it has left, which one that breaks off or speaks another protocol has.
    """

    def __init__(self, stream: socket.socket, header: bytes, selector: selectors.BaseSelector) -> None:
        self.hears = False
        self.gone = False
        self._stream = stream
        self._header = header
        self._selector = selector
        self._packets = tcpros.PacketSplitter()
        self._unsent = bytearray()
        stream.setblocking(False)
        selector.register(stream, selectors.EVENT_READ, self.serve)

    def send(self, packet: bytes) -> None:
        """Send a packet as soon as there is room for it; drop it where too much waits already."""
        if not self.gone and len(self._unsent) < QUEUE_BYTES:
            self._unsent += packet
            self._flush()

    def serve(self, events: int) -> None:
        """Do what the socket is ready for."""
        if events & selectors.EVENT_WRITE:
            self._flush()
        if events & selectors.EVENT_READ and not self.gone:
            self._read()

    def _flush(self) -> None:
        try:
            with contextlib.suppress(BlockingIOError):
                del self._unsent[: self._stream.send(self._unsent)]
        except OSError:
            self._leave()
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._unsent else 0)
        if self._selector.get_key(self._stream).events != wanted:
            self._selector.modify(self._stream, wanted, self.serve)

    def _read(self) -> None:
        try:
            data = self._stream.recv(_CHUNK_BYTES)
            if not self.hears:
                self._packets.feed(data)
                self._answer()
        except BlockingIOError:
            return
        except (OSError, ValueError):
            data = b""
        if not data and not self.gone:
            self._leave()

    def _answer(self) -> None:
        """Answer its connection header once that is whole; whatever comes after it says nothing."""
        for packet in self._packets:
            tcpros.unpack_header(packet)
            self.hears = True
            self.send(self._header)
            return

    def _leave(self) -> None:
        self.gone = True
        self._selector.unregister(self._stream)
        self._stream.close()


class Publication:
    """One topic at its socket.

    Args:
        sensor: What is published.
        definition: That of its message type.
        start_s: When message 0 was due, on the monotonic clock.
        odometer: Says how the robot moves.
        selector: Waits for its sockets, each with the function to call with what one is ready for.
    """

    def __init__(
        self,
        sensor: Sensor,
        definition: Definition,
        start_s: float,
        odometer: Odometer,
        selector: selectors.BaseSelector,
    ) -> None:
        self._odometer = odometer
        self._sensor = sensor
        self._source = Source(sensor)
        self._header = tcpros.pack(tcpros.pack_header(_header(sensor, definition)))
        self._start_s = start_s
        self._selector = selector
        self._number: int | None = None
        self._subscribers: list[Subscriber] = []
        path = tcpros.socket_path(sensor.topic)
        path.unlink(missing_ok=True)  # left by sensors that were killed
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(path))
        self._socket.listen()
        selector.register(self._socket, selectors.EVENT_READ, self._welcome)

    def publish(self) -> float:
        """Publish the next message if it is due; return in how many seconds the one after it is, never if unheard."""
        self._subscribers = [one for one in self._subscribers if not one.gone]
        heard = [one for one in self._subscribers if one.hears]
        if not heard:
            self._number = None
            return math.inf
        elapsed_s, rate_hz = time.monotonic() - self._start_s, self._sensor.rate_hz
        if self._number is None:
            self._number = math.ceil(elapsed_s * rate_hz)
        elif self._number <= elapsed_s * rate_hz:
            now = self._odometer.at(time.monotonic_ns())
            packet = tcpros.pack(self._source.message(self._number, time.time_ns(), now))
            for subscriber in heard:
                subscriber.send(packet)
            self._number += 1
        return self._number / rate_hz - elapsed_s

    def _welcome(self, _events: int) -> None:
        stream, _ = self._socket.accept()
        self._subscribers.append(Subscriber(stream, self._header, self._selector))


def publish(
    sensors: Iterable[Sensor], definitions: Mapping[str, Definition], *, motion: Path, steered: Path, ready: Path
) -> None:
    """Publish for ever.

    Args:
        sensors: What is published.
        definitions: Those of its message types.
        motion: The file in which the lab says how the robot moves (`own_motion.say`).
        steered: The file in which the robot says how it steers itself (`helm.Helm`).
        ready: Made when every topic can be subscribed to.

    Raises:
        OSError: A socket cannot be made.
    """
    start_s = time.monotonic()
    Path(tcpros.FOLDER).mkdir(exist_ok=True)
    selector = selectors.DefaultSelector()
    odometer = Odometer(motion, time.monotonic_ns(), steered)
    publications = [Publication(sensor, definitions[sensor.type], start_s, odometer, selector) for sensor in sensors]
    ready.touch()
    while True:
        next_s = min((publication.publish() for publication in publications), default=math.inf)
        for key, events in selector.select(None if next_s == math.inf else next_s):
            key.data(events)


def _header(sensor: Sensor, definition: Definition) -> dict[str, str]:
    return {
        "callerid": tcpros.CALLER,
        "latching": "0",
        "md5sum": definition.md5,
        "message_definition": definition.text,
        "topic": sensor.topic,
        "type": sensor.type,
    }
