"""The process in an emulated robot that publishes its sensors, each at its true rate.

Message `n` of a topic is due at `start + n / rate` on the monotonic clock, so rates do not drift. A topic that nobody
hears is not made: a robot at rest costs no time.
"""

import asyncio
import contextlib
import json
import math
import time
from pathlib import Path
from typing import Final

from sim_backends.emulated import services, tcpros
from sim_backends.emulated.messages import Source
from sim_backends.emulated.spec import Sensor

# What a slow subscriber may leave unread; beyond it, messages are dropped for it, as from any ROS publisher's queue.
QUEUE_BYTES: Final = 4 << 20


class Publication:
    """One topic at its socket.

    Args:
        sensor: What is published.
        start_s: When message 0 was due, on the monotonic clock.
    """

    def __init__(self, sensor: Sensor, start_s: float) -> None:
        self._sensor = sensor
        self._source = Source(sensor)
        self._start_s = start_s
        self._subscribers: set[asyncio.StreamWriter] = set()
        self._heard = asyncio.Event()

    async def listen(self) -> None:
        """Open the socket."""
        await asyncio.start_unix_server(self._welcome, tcpros.socket_path(self._sensor.topic))

    async def publish(self) -> None:
        """Publish for ever."""
        while True:
            await self._heard.wait()
            number = math.ceil((time.monotonic() - self._start_s) * self._sensor.rate_hz)
            while self._subscribers:
                due_s = self._start_s + number / self._sensor.rate_hz
                await asyncio.sleep(due_s - time.monotonic())
                packet = tcpros.pack(self._source.message(number, time.time_ns()))
                for subscriber in self._subscribers:
                    if subscriber.transport.get_write_buffer_size() < QUEUE_BYTES:
                        subscriber.write(packet)
                number += 1
            self._heard.clear()

    async def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # A subscriber that broke off or spoke another protocol has left.
        with contextlib.suppress(OSError, ValueError, asyncio.IncompleteReadError), contextlib.closing(writer):
            length = tcpros.unpack_length(await reader.readexactly(tcpros.LENGTH_BYTES))
            tcpros.unpack_header(await reader.readexactly(length))
            writer.write(tcpros.pack(tcpros.pack_header(self._header())))
            self._subscribers.add(writer)
            self._heard.set()
            await reader.read()  # it says nothing more until it leaves
        self._subscribers.discard(writer)

    def _header(self) -> dict[str, str]:
        return {
            "callerid": tcpros.CALLER,
            "latching": "0",
            "md5sum": self._source.md5,
            "message_definition": self._source.definition,
            "topic": self._sensor.topic,
            "type": self._sensor.type,
        }


async def run(sensors: list[Sensor]) -> None:
    """Publish `sensors` for ever."""
    start_s = time.monotonic()
    publications = [Publication(sensor, start_s) for sensor in sensors]
    Path(tcpros.FOLDER).mkdir(exist_ok=True)
    for publication in publications:
        await publication.listen()
    services.ready_file("sensors").touch()
    async with asyncio.TaskGroup() as tasks:
        for publication in publications:
            tasks.create_task(publication.publish())
        tasks.create_task(asyncio.Event().wait())  # a robot without sensors lives, too


def main() -> None:
    """Publish what the robot's init process wrote down."""
    services.call_me("sensors")
    written = json.loads(Path(services.SENSORS_FILE).read_text(encoding="utf-8"))
    asyncio.run(run([Sensor(**sensor) for sensor in written]))


if __name__ == "__main__":
    main()
