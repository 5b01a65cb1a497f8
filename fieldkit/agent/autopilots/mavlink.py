"""Record the MAVLink messages of an autopilot, and request messages from it.

The log is a telemetry log (`.tlog`) in the format of QGroundControl, MAVProxy and pymavlink: each received frame
is preceded by its time of arrival in microseconds since 1970 UTC, 8 bytes, big-endian. Only heartbeats are decoded
here.
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

from fieldkit.agent.autopilots.mavlink_frames import (
    ACCEPTED,
    HEARTBEAT,
    NO_AUTOPILOT,
    SET_MESSAGE_INTERVAL,
    FrameWriter,
    ParsedFrame,
    is_intact,
    parse_frame,
)
from fieldkit.agent.autopilots.mavlink_links import open_link
from fieldkit.agent.links.client import SharedLink
from fieldkit.agent.links.intervals import RETRY_RESULTS

MAX_BYTES = 256 << 20
"""Maximum size of a log, for example if another program floods the recorder."""

_STAMP = struct.Struct(">Q")
_HEARTBEAT_INTERVAL_S = 1.0
_REQUEST_INTERVAL_S = 0.4
_TIMEOUT_S = 60.0
"""Timeout for requested messages. ArduCopter sends LOCAL_POSITION_NED about 30 s after its boot, when its position
estimate has an origin."""
_MIN_FRACTION = 0.7
"""A message with less than this fraction of its requested rate is too slow. The link server uses the same value."""
_POLL_S = 0.1


@dataclass(frozen=True)
class FlightRecording:
    """Parameters of a recording.

    Attributes:
        connection: Name of the connection to the autopilot; see `mavlink_links.open_link`.
        intervals_us: Requested interval by message id, which is a string because keys of JSON objects are strings.
            The recorder waits only for messages whose interval is positive.
        system: System id of the autopilot; 0 for the autopilot whose heartbeat arrives first.
    """

    connection: str
    intervals_us: Mapping[str, int]
    system: int = 0


class MissingMessageError(Exception):
    """A requested message does not arrive."""


class FlightRecorder:
    """Records the messages of an autopilot.

    Args:
        recording: Parameters of the recording.
        link: The connection to the autopilot.
        path: The log file.

    Raises:
        OSError: The log file cannot be created.
    """

    def __init__(self, recording: FlightRecording, link: SharedLink, path: str) -> None:
        self._link = link
        self._log = open(path, "wb", buffering=0)  # noqa: SIM115, PTH123 (closed by `end`)
        self._system = recording.system
        self._autopilot: tuple[int, int] | None = None
        self._requested_us = {int(kind): interval_us for kind, interval_us in recording.intervals_us.items()}
        self._missing_kinds = {kind for kind, interval_us in self._requested_us.items() if interval_us > 0}
        self._refusals: dict[int, int] = {}
        # Time during which each message was too slow, and the time of the last update of these values.
        self._slow_s = dict.fromkeys(self._missing_kinds, 0.0)
        self._rates_s = time.monotonic()
        self._writer = FrameWriter()
        self._frames = self._bytes = self._dropped_frames = self._checksum = 0
        self._next_heartbeat_s = self._next_request_s = 0.0
        self._first_heartbeat_s = time.monotonic()
        self._was_ready = False

    @property
    def ready(self) -> bool:
        """Whether each message with a positive interval was received, or refused by the autopilot.

        Once True, it stays True.
        """
        self._was_ready |= self._autopilot is not None and self._missing_kinds <= set(self._refusals)
        return self._was_ready

    def check(self) -> None:
        """Check that the recorder is `ready` within `_TIMEOUT_S` after the first heartbeat of the autopilot.

        Raises:
            MissingMessageError: A message was neither received nor refused in this time.
        """
        if not self.ready and self._autopilot is not None and time.monotonic() - self._first_heartbeat_s > _TIMEOUT_S:
            missing_ids = ", ".join(str(kind) for kind in sorted(self._missing_kinds - set(self._refusals)))
            raise MissingMessageError(
                f"the autopilot has not sent all requested messages in {_TIMEOUT_S:g} s; missing: {missing_ids} "
                "(ids of https://mavlink.io/en/messages/common.html)"
            )

    def receive(self, timeout_s: float, selector: selectors.BaseSelector) -> None:
        """Record the next frames that arrive within this time."""
        if not selector.select(timeout_s):
            return
        for frame in self._link.receive():
            self._write(frame)
            self._process(parse_frame(frame), intact=is_intact(frame))

    def _write(self, frame: bytes) -> None:
        if self._bytes + len(frame) + _STAMP.size > MAX_BYTES:
            self._dropped_frames += 1
            return
        record = _STAMP.pack(time.time_ns() // 1000) + frame
        self._log.write(record)
        self._checksum = zlib.crc32(record, self._checksum)
        self._frames += 1
        self._bytes += len(record)

    def _process(self, message: ParsedFrame, *, intact: bool) -> None:
        """Identify the autopilot by its heartbeat, and register the arrival of requested messages."""
        source = message.system, message.component
        if self._autopilot is None:
            is_heartbeat = (
                message.kind == HEARTBEAT and len(message.payload) > 5 and message.payload[5] != NO_AUTOPILOT
            )
            if intact and is_heartbeat and self._system in (0, message.system):
                self._autopilot, self._first_heartbeat_s = source, time.monotonic()
        elif source == self._autopilot:
            self._missing_kinds.discard(message.kind)

    def send(self) -> None:
        """Send heartbeats, repeat each request for a message until the link server has registered it, update rates.

        Must be called periodically.
        """
        now_s = time.monotonic()
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + _HEARTBEAT_INTERVAL_S
            self._link.send(self._writer.heartbeat())
        if self._autopilot and now_s >= self._next_request_s:
            self._next_request_s = now_s + _REQUEST_INTERVAL_S
            for kind, interval_us in self._requested_us.items():
                if kind not in self._link.messages:
                    self._link.send(self._writer.command(self._autopilot, SET_MESSAGE_INTERVAL, kind, interval_us))
        self._update_rates(now_s)

    def _update_rates(self, now_s: float) -> None:
        """Update the refusals, and the time during which the rate of each message was too low after `ready`."""
        elapsed_s, self._rates_s = now_s - self._rates_s, now_s
        for kind, rate in self._link.messages.items():
            if rate.result not in (None, ACCEPTED, *RETRY_RESULTS):
                self._refusals[kind] = rate.result
            # The product of rate in Hz and interval in us is 1e6 if the message has its requested rate.
            elif self.ready and kind in self._slow_s and rate.hz * self._requested_us[kind] < _MIN_FRACTION * 1e6:
                self._slow_s[kind] += elapsed_s

    def end(self) -> Mapping[str, Any]:
        """Close the log, and return a summary of its content."""
        os.fsync(self._log.fileno())
        self._log.close()
        return {
            "frames": self._frames,
            "bytes": self._bytes,
            "crc32": self._checksum,
            "left_out": self._dropped_frames + self._link.dropped_frames,
            "ended_us": time.time_ns() // 1000,
            "refused": {str(kind): result for kind, result in self._refusals.items()},
            "slow_s": {str(kind): round(slow_s, 3) for kind, slow_s in self._slow_s.items()},
        }


def record(recording: FlightRecording, path: str, stop_event: threading.Event) -> None:
    """Record until `stop_event` is set, then write a summary of the log as JSON to standard output.

    Writes `up` to standard error when a heartbeat arrived and each requested message was received or refused.

    Raises:
        OSError: The connection cannot be opened, or the log cannot be written.
        ValueError: The name of the connection is invalid.
        MissingMessageError: A requested message did not arrive.
    """
    link = open_link(recording.connection)
    _report(f"waiting for the heartbeat of an autopilot at {recording.connection}")
    recorder = FlightRecorder(recording, link, path)
    is_ready = False
    try:
        with selectors.DefaultSelector() as selector:
            selector.register(link.fileno(), selectors.EVENT_READ)
            while not stop_event.is_set():
                recorder.send()
                recorder.receive(_POLL_S, selector)
                recorder.check()
                if not is_ready and recorder.ready:
                    is_ready = True
                    _report("up, MAVLink")
    finally:
        sys.stdout.write(json.dumps(recorder.end()) + "\n")
        link.close()


def _report(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
