"""Record what an autopilot tells over MAVLink, and ask it how often it is to tell what.

The log is a telemetry log (`.tlog`) as QGroundControl, MAVProxy and pymavlink write and read them: each frame as it
came, behind the time in microseconds since 1970 UTC in 8 bytes, big-endian. Nothing is decoded here but what the
recorder must know: heartbeats of autopilots, and their answers.
"""

from __future__ import annotations

import json
import os
import selectors
import struct
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any, Mapping

from fieldkit.agent.mavlink_frames import (
    ACCEPTED,
    COMMAND_ACK,
    HEARTBEAT,
    NO_AUTOPILOT,
    SET_MESSAGE_INTERVAL,
    FrameHead,
    FrameWriter,
    head,
    is_intact,
)
from fieldkit.agent.mavlink_links import FlightLink, opened

MOST_BYTES = 256 << 20
"""A log is no longer, whoever floods the recorder."""

_STAMP = struct.Struct(">Q")
_BEATS_S = 1.0
_ASKS_S = 0.4
_SETTLES_S = 4.0
"""The rates are to be as asked for before anybody counts on them; but a link may lose what is asked."""
_TURN_S = 0.1


@dataclass(frozen=True)
class FlightRecording:
    """What is recorded.

    Attributes:
        connection: Where the autopilot is, as `mavlink_links.opened` takes it.
        intervals_us: Wanted time between two messages of an id, which JSON made a text.
        system: The autopilot's system id; 0 for the first that is heard.
    """

    connection: str
    intervals_us: Mapping[str, int]
    system: int = 0


class FlightRecorder:
    """Talks with an autopilot, and writes down what it says.

    Args:
        recording: What is recorded.
        link: To the autopilot.
        path: The log.
    """

    def __init__(self, recording: FlightRecording, link: FlightLink, path: str) -> None:
        self._link = link
        self._log = open(path, "wb", buffering=0)  # noqa: SIM115, PTH123 (closed by `end`)
        self._system = recording.system
        self._autopilot: tuple[int, int] | None = None
        self._open = {int(kind): interval_us for kind, interval_us in recording.intervals_us.items()}
        self._asked = tuple(self._open)
        self._refused: dict[int, int] = {}
        self._writer = FrameWriter()
        self._frames = self._bytes = self._left_out = 0
        self._begun_s = time.monotonic()
        self._beats_s = self._asks_s = self._begun_s

    @property
    def settled(self) -> bool:
        """Whether an autopilot is there, and has answered all that it was asked, or had the time to."""
        late = time.monotonic() - self._begun_s > _SETTLES_S
        return self._autopilot is not None and (late or not self._open)

    def take(self, within_s: float, waiting: selectors.BaseSelector) -> None:
        """Write down what comes next, if anything does."""
        if not waiting.select(within_s):
            return
        for frame in self._link.receive():
            self._note(frame)
            if is_intact(frame):
                self._read(head(frame))

    def _note(self, frame: bytes) -> None:
        if self._bytes + len(frame) + _STAMP.size > MOST_BYTES:
            self._left_out += 1
            return
        record = _STAMP.pack(time.time_ns() // 1000) + frame
        self._log.write(record)
        self._frames += 1
        self._bytes += len(record)

    def _read(self, found: FrameHead) -> None:
        """Learn from an intact frame who the autopilot is, and what it answers."""
        who = found.system, found.component
        if self._autopilot is None:
            beats = found.kind == HEARTBEAT and len(found.payload) > 5 and found.payload[5] != NO_AUTOPILOT
            if beats and self._system in (0, found.system):
                self._autopilot = who
        elif who == self._autopilot and found.kind == COMMAND_ACK and self._open:
            command, result = struct.unpack("<HB", found.payload[:3].ljust(3, b"\0"))
            if command == SET_MESSAGE_INTERVAL:
                kind = next(iter(self._open))
                del self._open[kind]
                self._asks_s = 0.0
                if result != ACCEPTED:
                    self._refused[kind] = result

    def speak(self) -> None:
        """Say what is due: a heartbeat, and the first question that has no answer."""
        now_s = time.monotonic()
        if now_s >= self._beats_s:
            self._beats_s = now_s + _BEATS_S
            self._link.send(self._writer.heartbeat())
        if self._autopilot and self._open and now_s >= self._asks_s:
            self._asks_s = now_s + _ASKS_S
            kind, interval_us = next(iter(self._open.items()))
            self._link.send(self._writer.command(self._autopilot, SET_MESSAGE_INTERVAL, kind, interval_us))

    def end(self) -> Mapping[str, Any]:
        """Have the messages come as usual again, close the log, and return what it holds."""
        if self._autopilot:
            for kind in self._asked:
                self._link.send(self._writer.command(self._autopilot, SET_MESSAGE_INTERVAL, kind, 0))
        os.fsync(self._log.fileno())
        self._log.close()
        return {
            "frames": self._frames,
            "bytes": self._bytes,
            "left_out": self._left_out,
            "ended_us": time.time_ns() // 1000,
            "refused": {str(kind): result for kind, result in self._refused.items()},
        }


def record(recording: FlightRecording, path: str, over: threading.Event) -> None:
    """Record until `over` is set, and then say on standard output what the log holds.

    Says `up` on standard error when the autopilot has been heard and asked.

    Raises:
        OSError: The connection cannot be opened, or has ended.
    """
    link = opened(recording.connection)
    _say(f"waiting for the heartbeat of an autopilot at {recording.connection}")
    recorder = FlightRecorder(recording, link, path)
    up = False
    with selectors.DefaultSelector() as waiting:
        waiting.register(link.fileno(), selectors.EVENT_READ)
        while not over.is_set():
            recorder.speak()
            recorder.take(_TURN_S, waiting)
            if not up and recorder.settled:
                up = True
                _say("up, MAVLink")
    sys.stdout.write(json.dumps(recorder.end()) + "\n")
    link.close()


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
