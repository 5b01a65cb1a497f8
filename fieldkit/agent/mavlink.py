"""Record what an autopilot sends over MAVLink, and request messages of it.

The log is a telemetry log (`.tlog`) as QGroundControl, MAVProxy and pymavlink write and read them: each frame as it
came, behind the time in microseconds since 1970 UTC in 8 bytes, big-endian. Nothing is decoded here but heartbeats of
autopilots.
"""

from __future__ import annotations

import json
import os
import selectors
import struct
import sys
import threading
import time
import zlib
from dataclasses import dataclass
from typing import Any, Mapping

from fieldkit.agent.links.client import SharedLink
from fieldkit.agent.links.intervals import LATER
from fieldkit.agent.mavlink_frames import (
    ACCEPTED,
    HEARTBEAT,
    NO_AUTOPILOT,
    SET_MESSAGE_INTERVAL,
    FrameHead,
    FrameWriter,
    head,
    is_intact,
)
from fieldkit.agent.mavlink_links import opened

MOST_BYTES = 256 << 20
"""A log is no longer, whoever floods the recorder."""

_STAMP = struct.Struct(">Q")
_BEATS_S = 1.0
_ASKS_S = 0.4
_LATEST_S = 60.0
"""An ArduCopter sends LOCAL_POSITION_NED about 30 s after its boot, when its estimate has an origin."""
_ENOUGH = 0.7
"""Share of a requested rate below which it is not met, as for the link server."""
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


class MissingMessageError(Exception):
    """What was requested does not come."""


class FlightRecorder:
    """Records what an autopilot sends.

    Args:
        recording: What is recorded.
        link: To the autopilot.
        path: The log.
    """

    def __init__(self, recording: FlightRecording, link: SharedLink, path: str) -> None:
        self._link = link
        self._log = open(path, "wb", buffering=0)  # noqa: SIM115, PTH123 (closed by `end`)
        self._system = recording.system
        self._autopilot: tuple[int, int] | None = None
        self._requested = {int(kind): interval_us for kind, interval_us in recording.intervals_us.items()}
        self._missing = {kind for kind, interval_us in self._requested.items() if interval_us > 0}
        self._refused: dict[int, int] = {}
        self._slow_s = dict.fromkeys(self._missing, 0.0)
        self._writer = FrameWriter()
        self._frames = self._bytes = self._left_out = self._sum = 0
        self._beats_s = self._asks_s = 0.0
        self._judged_s = self._heard_s = time.monotonic()
        self._was_ready = False

    @property
    def ready(self) -> bool:
        """Whether each requested message was received, or denied by the autopilot."""
        self._was_ready |= self._autopilot is not None and self._missing <= set(self._refused)
        return self._was_ready

    def check(self) -> None:
        """Check that what was requested comes in time.

        Raises:
            MissingMessageError: It does not.
        """
        if not self.ready and self._autopilot is not None and time.monotonic() - self._heard_s > _LATEST_S:
            missing = ", ".join(str(kind) for kind in sorted(self._missing - set(self._refused)))
            raise MissingMessageError(
                f"the autopilot has sent no message {missing} in {_LATEST_S:g} s, which was requested "
                "(ids of https://mavlink.io/en/messages/common.html)"
            )

    def take(self, within_s: float, waiting: selectors.BaseSelector) -> None:
        """Record what comes next, if anything does."""
        if not waiting.select(within_s):
            return
        for frame in self._link.receive():
            self._note(frame)
            self._read(head(frame), intact=is_intact(frame))

    def _note(self, frame: bytes) -> None:
        if self._bytes + len(frame) + _STAMP.size > MOST_BYTES:
            self._left_out += 1
            return
        record = _STAMP.pack(time.time_ns() // 1000) + frame
        self._log.write(record)
        self._sum = zlib.crc32(record, self._sum)
        self._frames += 1
        self._bytes += len(record)

    def _read(self, message: FrameHead, *, intact: bool) -> None:
        """Note which autopilot it is, and which requested message has come."""
        source = message.system, message.component
        if self._autopilot is None:
            beats = message.kind == HEARTBEAT and len(message.payload) > 5 and message.payload[5] != NO_AUTOPILOT
            if intact and beats and self._system in (0, message.system):
                self._autopilot, self._heard_s = source, time.monotonic()
        elif source == self._autopilot:
            self._missing.discard(message.kind)

    def speak(self) -> None:
        """Send what is due: a heartbeat, and the requests for messages until the link server has them."""
        now_s = time.monotonic()
        if now_s >= self._beats_s:
            self._beats_s = now_s + _BEATS_S
            self._link.send(self._writer.heartbeat())
        if self._autopilot and now_s >= self._asks_s:
            self._asks_s = now_s + _ASKS_S
            for kind, interval_us in self._requested.items():
                if kind not in self._link.messages:
                    self._link.send(self._writer.command(self._autopilot, SET_MESSAGE_INTERVAL, kind, interval_us))
        self._judge(now_s)

    def _judge(self, now_s: float) -> None:
        """Note refusals, and for how long each message came slower than requested since the recorder was ready."""
        lasted_s, self._judged_s = now_s - self._judged_s, now_s
        for kind, rate in self._link.messages.items():
            if rate.result not in (None, ACCEPTED, *LATER):
                self._refused[kind] = rate.result
            elif self.ready and kind in self._slow_s and rate.hz * self._requested[kind] < _ENOUGH * 1e6:
                self._slow_s[kind] += lasted_s

    def end(self) -> Mapping[str, Any]:
        """Close the log, and return what it holds."""
        os.fsync(self._log.fileno())
        self._log.close()
        return {
            "frames": self._frames,
            "bytes": self._bytes,
            "crc32": self._sum,
            "left_out": self._left_out + self._link.left_out,
            "ended_us": time.time_ns() // 1000,
            "refused": {str(kind): result for kind, result in self._refused.items()},
            "slow_s": {str(kind): round(slow_s, 3) for kind, slow_s in self._slow_s.items()},
        }


def record(recording: FlightRecording, path: str, over: threading.Event) -> None:
    """Record until `over` is set, then write on standard output as JSON what the log holds.

    Writes `up` on standard error when the autopilot was heard and each requested message was received or denied.

    Raises:
        OSError: The connection cannot be opened.
        MissingMessageError: A requested message did not come.
    """
    link = opened(recording.connection)
    _say(f"waiting for the heartbeat of an autopilot at {recording.connection}")
    recorder = FlightRecorder(recording, link, path)
    up = False
    try:
        with selectors.DefaultSelector() as waiting:
            waiting.register(link.fileno(), selectors.EVENT_READ)
            while not over.is_set():
                recorder.speak()
                recorder.take(_TURN_S, waiting)
                recorder.check()
                if not up and recorder.ready:
                    up = True
                    _say("up, MAVLink")
    finally:
        sys.stdout.write(json.dumps(recorder.end()) + "\n")
        link.close()


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
