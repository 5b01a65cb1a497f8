"""The process in an emulated robot that publishes its sensors, each at its true rate.

Message `n` of a topic is due at `start + n / rate` on the monotonic clock, so rates do not drift. A topic that nobody
hears is not made: a robot at rest costs no time.
"""

import math
import selectors
import socket
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from sim_backends.emulated.robot.spec import Definition, Sensor
from sim_backends.emulated.ros import tcpros
from sim_backends.emulated.ros.messages import Source
from sim_backends.emulated.ros.subscriber import Subscriber


class Publication:
    """One topic at its socket.

    Args:
        sensor: What is published.
        definition: That of its message type.
        start_s: When message 0 was due, on the monotonic clock.
        selector: Waits for its sockets, each with the function to call with what one is ready for.
    """

    def __init__(
        self, sensor: Sensor, definition: Definition, start_s: float, selector: selectors.BaseSelector
    ) -> None:
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
            packet = tcpros.pack(self._source.message(self._number, time.time_ns()))
            for subscriber in heard:
                subscriber.send(packet)
            self._number += 1
        return self._number / rate_hz - elapsed_s

    def _welcome(self, _events: int) -> None:
        stream, _ = self._socket.accept()
        self._subscribers.append(Subscriber(stream, self._header, self._selector))


def publish(sensors: Iterable[Sensor], definitions: Mapping[str, Definition], *, ready: Path) -> None:
    """Publish for ever.

    Args:
        sensors: What is published.
        definitions: Those of its message types.
        ready: Made when every topic can be subscribed to.

    Raises:
        OSError: A socket cannot be made.
    """
    start_s = time.monotonic()
    Path(tcpros.FOLDER).mkdir(exist_ok=True)
    selector = selectors.DefaultSelector()
    publications = [Publication(sensor, definitions[sensor.type], start_s, selector) for sensor in sensors]
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
