"""Recordings of `kernel_roaming`: their events, and the times of scans, associations and power save in them."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks import kernel_recordings, kernel_roaming
from benchmarks import roaming_lab as lab

_LONGEST_S: Final = 2400.0  # time limit of a recording
_CHANNEL_CHANGED: Final = 0x40
"""Bit `IEEE80211_CONF_CHANGE_CHANNEL` of a trace event `drv_config`."""
_ASSOCIATION_KINDS: Final = ("authentication", "association", "reassociation", "eapol")

Interval = tuple[float, float]
"""Start and end, in seconds."""


@dataclass(frozen=True)
class AirFrame:
    """A frame of a recording.

    Attributes:
        time_s: Time at which the kernel has passed it to the medium.
        source: Name of its transmitter.
        receiver: Name of its receiver; `*` for a broadcast.
        kind: Kind, as `roaming_lab.frame_kind` returns it.
        size_bytes: Size with FCS.
        sleeps: True if it has the power management bit.
    """

    time_s: float
    source: str
    receiver: str
    kind: str
    size_bytes: int
    sleeps: bool


@dataclass(frozen=True)
class Recording:
    """The events of a recording, or of one of its steps.

    Attributes:
        frames: The frames, in order.
        changes: Time, and channel in MHz, of each change of the robot's channel; 0 at the end of a scan.
        scans_s: Start of each scan.
        marks: Time and text of each step.
    """

    frames: Sequence[AirFrame]
    changes: Sequence[tuple[float, int]]
    scans_s: Sequence[float]
    marks: Sequence[tuple[float, str]]

    def steps(self, text: str) -> "list[Recording]":
        """Return the events of each step with this text."""
        times_s = [time_s for time_s, _ in self.marks] + [float("inf")]
        return [
            self._between(start_s, times_s[number + 1])
            for number, (start_s, mark) in enumerate(self.marks)
            if mark == text
        ]

    def _between(self, start_s: float, end_s: float) -> "Recording":
        return Recording(
            [frame for frame in self.frames if start_s <= frame.time_s < end_s],
            [change for change in self.changes if start_s <= change[0] < end_s],
            [time_s for time_s in self.scans_s if start_s <= time_s < end_s],
            [mark for mark in self.marks if start_s <= mark[0] < end_s],
        )

    def first(self, kind: str, source: str | None = None) -> AirFrame:
        """Return the first frame of a kind, from a transmitter if it is given."""
        return next(frame for frame in self.frames if frame.kind == kind and source in {None, frame.source})


def read(text: str) -> Recording:
    """Return the events of a recording."""
    frames, changes, scans_s, marks = [], [], [], []
    for line in text.splitlines():
        time_us, subject, *fields = line.split(",")
        time_s = int(time_us) / 1e6
        if subject == "air":
            source, receiver, kind, _, size, sleeps = fields
            frames.append(AirFrame(time_s, source, receiver, kind, int(size), sleeps == "1"))
        elif subject == "mark":
            marks.append((time_s, fields[0]))
        elif "phy0" in fields[0]:
            words = fields[0].split()
            if words[0] == "drv_sw_scan_start:":
                scans_s.append(time_s)
            elif words[0] == "drv_sw_scan_complete:":
                changes.append((time_s, 0))
            elif words[0] == "drv_config:" and int(words[2].removeprefix("ch:"), 16) & _CHANNEL_CHANGED:
                changes.append((time_s, round(float(words[3].removeprefix("control:")))))
    return Recording(sorted(frames, key=lambda frame: frame.time_s), sorted(changes), scans_s, marks)


def recording(name: str) -> Path:
    """Return the file of a recording."""
    return kernel_recordings.RECORDINGS / f"roaming-{name}.csv.gz"


def record(name: str) -> str:
    """Return a recording that is made in a new virtual machine."""
    radios = 1 + len(lab.ACCESS_POINTS_M)
    with tempfile.TemporaryDirectory() as folder:
        return kernel_recordings.record(Path(folder), "kernel_roaming", name, radios=radios, limit_s=_LONGEST_S)


def absences(step: Recording) -> list[Interval]:
    """Return the times between the null frames with which the robot leaves its channel and returns."""
    nulls = [frame for frame in step.frames if frame.kind == "null" and frame.source == lab.ROBOT]
    return [(start.time_s, end.time_s) for start, end in pairwise(nulls) if start.sleeps and not end.sleeps]


def visits_s(step: Recording) -> list[float]:
    """Return the time on each channel of the first scan, of a robot without an access point."""
    end = next(number for number, (_, channel) in enumerate(step.changes) if not channel)
    # The last change is the return at the end of the scan.
    return [end_s - start_s for (start_s, _), (end_s, _) in pairwise(step.changes[:end])]


def associations(events: Recording) -> Iterator[list[AirFrame]]:
    """Yield the frames of each complete association, from the robot's first authentication frame."""
    frames: list[AirFrame] = []
    for frame in events.frames:
        if frame.kind == "authentication-1" and frame.source == lab.ROBOT:
            frames = []
        if frame.kind.startswith(_ASSOCIATION_KINDS):
            frames.append(frame)
        if frame.kind == "eapol-4" and frames:
            yield frames
            frames = []


def repetition_s(step: Recording) -> float:
    """Return the time from a lost frame until another frame of the association is sent."""
    lost_s = step.marks[0][0]
    frames = (f for f in step.frames if f.kind.startswith(_ASSOCIATION_KINDS) and f.time_s > lost_s)
    return next(frames).time_s - lost_s


def link_losses_s(events: Recording) -> list[tuple[float, int, float]]:
    """Return for each loss: time from the last beacon to a null frame, null frames, time from the end to a scan."""
    losses = []
    for step in events.steps("out of range"):
        start_s = step.marks[0][0]
        nulls = [frame for frame in step.frames if frame.kind == "null"]
        beacons_s = [f.time_s for f in events.frames if f.kind == "beacon" and f.source == nulls[0].receiver]
        scan_s = next(time_s for time_s in events.scans_s if time_s > nulls[-1].time_s)
        disconnect_s = max(time_s for time_s, _ in events.changes if time_s < scan_s)
        last_s = max(time_s for time_s in beacons_s if time_s < start_s)
        losses.append((nulls[0].time_s - last_s, len(nulls), scan_s - disconnect_s))
    return losses


def handovers(step: Recording) -> list[tuple[float, str, float]]:
    """Return position, new access point, and gap in s of the packets to the robot, of each handover of a walk."""
    packets = [frame for frame in step.frames if frame.kind == "data" and frame.receiver == lab.ROBOT]
    moves = []
    for frame in step.frames:
        if frame.kind == "authentication-1" and frame.source == lab.ROBOT:
            last_s = max(packet.time_s for packet in packets if packet.time_s < frame.time_s)
            first_s = min(f.time_s for f in packets if f.source == frame.receiver and f.time_s > frame.time_s)
            position_m = (frame.time_s - step.marks[0][0]) * kernel_roaming.SPEED_M_S
            moves.append((position_m, frame.receiver, first_s - last_s))
    return moves


def delays_s(events: Recording, kind: str) -> list[float]:
    """Return the times from the arrival of each packet at the access point until it is sent to the robot."""
    receiver = "*" if kind == "broadcast" else lab.ROBOT
    frames_s = np.array(
        [f.time_s for f in events.frames if f.kind == "data" and f.source == "left" and f.receiver == receiver]
    )
    sent_s = [time_s for time_s, text in events.marks if text == kind]
    return [float(frames_s[np.searchsorted(frames_s, time_s)] - time_s) for time_s in sent_s]


def awake_times_s(events: Recording) -> list[float]:
    """Return the times from a packet to the robot until it announces that it sleeps, without other frames between."""
    frames = [f for f in events.frames if f.kind != "beacon"]
    return [
        sleep.time_s - packet.time_s
        for packet, sleep in pairwise(frames)
        if packet.kind == "data" and packet.receiver == lab.ROBOT and sleep.kind == "null" and sleep.sleeps
    ]
