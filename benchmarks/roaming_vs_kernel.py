"""Scans, roaming and power save compared with Linux: `python -m benchmarks.roaming_vs_kernel [--record]`.

A robot is a station of two access points at the ends of a corridor. The events of Linux (mac80211_hwsim, hostapd and
wpa_supplicant) were recorded in a virtual machine (`kernel_roaming`). Its clock counts instructions, so times between
frames contain the time that programs need on an emulated processor, but timers of the kernel and of the programs are
those of real devices. `--record` records the events again, as root. The events of fieldkit are computed here.
"""

import argparse
import gzip
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from random import Random
from statistics import fmean, median
from typing import Final

import numpy as np

from benchmarks import kernel_roaming as kernel
from fieldkit.core.deadline import Deadline
from sim_backends.emulated.linux_wifi import guest
from sim_backends.emulated.linux_wifi.virtual_machine import require_machine, run_in_machine
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.phy.high_throughput import PhyCapability
from sim_backends.radio.radio_options import RadioOptions

ROOT: Final = Path(__file__).resolve().parent.parent
RECORDINGS: Final = ROOT / "tests/data/hwsim/6.1.176"
RUNS: Final = 20
"""Number of link losses of fieldkit, each with another seed."""
PACKETS: Final = 400
"""Number of packets to a sleeping robot, in fieldkit."""

_NOISE_DBM: Final = -92
"""Noise that hwsim reports to wpa_supplicant."""
_LONGEST_S: Final = 2400.0  # time limit of a recording
_SILENT_NS: Final = 100_000_000
"""Time without frames after which a robot sleeps: `dynamic_ps_timeout` of mac80211, if power save is on."""
_PHY: Final = PhyCapability("n", "2.4 GHz", 20, 1, 800, power_save_timeout_ns=_SILENT_NS)
_CHANNEL_CHANGED: Final = 0x40
"""Bit `IEEE80211_CONF_CHANGE_CHANNEL` of a trace event `drv_config`."""
_ASSOCIATION_KINDS: Final = ("authentication", "association", "reassociation", "eapol")
_MS, _S = 10**6, 10**9
_STEP_NS: Final = 20 * _MS  # interval of packets to the robot
_ABSENT_NS: Final = 30 * _MS  # a longer time without packets is an absence of the robot

DESTINATIONS: Final[Mapping[str, str | None]] = {"packet": kernel.ROBOT, "broadcast": None}
"""Destinations of packets to sleeping robots, by kind."""

Interval = tuple[float, float]
"""Start and end, in seconds."""


@dataclass(frozen=True)
class AirFrame:
    """A frame of a recording.

    Attributes:
        time_s: Time at which the kernel has passed it to the medium.
        source: Name of its transmitter.
        receiver: Name of its receiver; `*` for a broadcast.
        kind: Kind, as `kernel_roaming.frame_kind` returns it.
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
    return RECORDINGS / f"roaming-{name}.csv.gz"


def record(name: str) -> str:
    """Return a recording that is made in a new virtual machine."""
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        python = shlex.join((sys.executable, "-m", "benchmarks.kernel_roaming", name))
        script = f"{guest.prologue(ROOT)}{python} >{shlex.quote(str(folder / 'events'))}\n"
        radios = 1 + len(kernel.ACCESS_POINTS_M)
        result = run_in_machine(require_machine(), script, Deadline.after(_LONGEST_S), radios=radios, results=folder)
        if result.code:
            sys.exit(result.output)
        return (folder / "events").read_text(encoding="ascii")


# Linux


def absences(step: Recording) -> list[Interval]:
    """Return the times between the null frames with which the robot leaves its channel and returns."""
    nulls = [frame for frame in step.frames if frame.kind == "null" and frame.source == kernel.ROBOT]
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
        if frame.kind == "authentication-1" and frame.source == kernel.ROBOT:
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
    packets = [frame for frame in step.frames if frame.kind == "data" and frame.receiver == kernel.ROBOT]
    moves = []
    for frame in step.frames:
        if frame.kind == "authentication-1" and frame.source == kernel.ROBOT:
            last_s = max(packet.time_s for packet in packets if packet.time_s < frame.time_s)
            first_s = min(f.time_s for f in packets if f.source == frame.receiver and f.time_s > frame.time_s)
            position_m = (frame.time_s - step.marks[0][0]) * kernel.SPEED_M_S
            moves.append((position_m, frame.receiver, first_s - last_s))
    return moves


def delays_s(events: Recording, kind: str) -> list[float]:
    """Return the times from the arrival of each packet at the access point until it is sent to the robot."""
    receiver = "*" if kind == "broadcast" else kernel.ROBOT
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
        if packet.kind == "data" and packet.receiver == kernel.ROBOT and sleep.kind == "null" and sleep.sleeps
    ]


# fieldkit


class Corridor:
    """The same corridor in fieldkit: the robot, and a robot `base` near the left access point that sends packets.

    Args:
        seed: Seed of all random draws.
        has_power_save: True if the robots sleep.
        roaming: Options of roaming.
    """

    def __init__(self, seed: int, *, has_power_save: bool = False, **roaming: object) -> None:
        access_points = {
            name: {"at_m": [east_m, north_m], "height": f"{up_m}m", "tx_power_dbm": kernel.ACCESS_POINT_DBM}
            for name, (east_m, north_m, up_m) in kernel.ACCESS_POINTS_M.items()
        }
        options = {
            "fading": False,
            "access_points": access_points,
            "roaming": {"noise_dbm": _NOISE_DBM, "channels": kernel.CHANNELS, **roaming},
        }
        antenna = Antenna("802.11n", kernel.ROBOT_DBM, kernel.SENSITIVITY_DBM, _PHY if has_power_save else None)
        self.model: WifiInWorld[int] = WifiInWorld(
            seed, RadioOptions.model_validate(options), {"base": antenna, kernel.ROBOT: antenna}, None
        )
        self.model.use_meter()
        self.sent_ns: list[int] = []
        self.arrived_ns: dict[int, int] = {}
        self.cells: list[tuple[int, str | None]] = []

    def place(self, now_ns: int, east_m: float) -> None:
        """Place the robot in the corridor."""
        places_m = {"base": (0.0, 2.0, kernel.HEIGHT_M), kernel.ROBOT: (east_m, 0.0, kernel.HEIGHT_M)}
        self.model.place(now_ns, places_m, None)

    def send(self, now_ns: int, destination: str | None = kernel.ROBOT) -> None:
        """Send a packet, and receive those that have arrived."""
        self.model.send(now_ns, "base", len(self.sent_ns), 100, destination)
        self.sent_ns.append(now_ns)
        self.receive(now_ns)

    def receive(self, now_ns: int) -> None:
        """Receive packets, and examine with which access point the robot is associated."""
        for at_ns, receiver, packet, _, _ in self.model.deliveries(now_ns):
            if receiver == kernel.ROBOT:
                self.arrived_ns[packet] = at_ns
        cell = self.model.sample(now_ns, now_ns)[kernel.ROBOT].cell
        if not self.cells or self.cells[-1][1] != cell:
            self.cells.append((now_ns, cell))


def model_absences(dwell: str) -> list[Interval]:
    """Return the absences of a scan: the times without packets from `base`, which does not scan."""
    corridor = Corridor(1, short="4s", long="300s", threshold_dbm=-45, dwell=dwell)
    corridor.place(0, 20.0)
    for now_ns in range(4 * _S, 8 * _S, 2 * _MS):  # from the first scan to the second one
        corridor.place(now_ns, 20.0)
        corridor.send(now_ns)
    times_s = sorted(at_ns / 1e9 for at_ns in corridor.arrived_ns.values())
    return [(start_s, end_s) for start_s, end_s in pairwise(times_s) if end_s - start_s > _ABSENT_NS / 1e9]


def model_association_s(*, sae: bool) -> float:
    """Return the time without an access point in a handover without other traffic."""
    corridor = Corridor(1, short="2s", long="2s", channels=1, sae=sae)
    corridor.place(0, 1.0)
    corridor.receive(_S)
    for now_ns in range(_S, 3 * _S, _MS // 4):
        corridor.place(now_ns, 90.0)
        corridor.receive(now_ns)
    (leave_ns, _), (enter_ns, _) = corridor.cells[-2:]
    return (enter_ns - leave_ns) / 1e9


def model_link_loss_s(seed: int) -> float:
    """Return the time from leaving the range until the link is lost."""
    corridor = Corridor(seed, channels=1)
    leave_ns = 2 * _S + Random(seed).randrange(_S)
    for now_ns in range(0, leave_ns + 3 * _S, 10 * _MS):
        corridor.place(now_ns, kernel.NEAR_M if now_ns < leave_ns else kernel.FAR_M)
        corridor.receive(now_ns)
    return next((at_ns - leave_ns) / 1e9 for at_ns, cell in corridor.cells if cell is None and at_ns > leave_ns)


def model_walk(name: str, seed: int) -> list[tuple[float, str, float]]:
    """Return position, new access point, and gap in s of the packets to the robot, of each handover of a walk."""
    _, short, threshold, long = kernel.SCANS[name].split(":")
    corridor = Corridor(seed, short=f"{short}s", long=f"{long}s", threshold_dbm=int(threshold))
    wait_ns = 3 * _S  # time of Linux from the association to the start of the walk
    for now_ns in range(0, wait_ns + round(kernel.WALK_M / kernel.SPEED_M_S * _S), _STEP_NS):
        corridor.place(now_ns, max(0.0, (now_ns - wait_ns) / _S * kernel.SPEED_M_S))
        corridor.send(now_ns)
    cells = [(at_ns, cell) for at_ns, cell in corridor.cells if cell is not None]
    arrivals_ns = sorted(corridor.arrived_ns.values())
    return [
        ((at_ns - wait_ns) / _S * kernel.SPEED_M_S, new, longest_gap_ns(arrivals_ns, at_ns - 60 * _MS) / 1e9)
        for (_, old), (at_ns, new) in pairwise(cells)
        if new != old
    ]


def longest_gap_ns(arrivals_ns: Sequence[int], start_ns: int, span_ns: int = 80 * _MS) -> int:
    """Return the longest time between two arrivals, of which the first is within a time span."""
    return max(end - start for start, end in pairwise(arrivals_ns) if start_ns <= start < start_ns + span_ns)


def model_delays_s(destination: str | None) -> list[float]:
    """Return the delays of packets to a sleeping robot."""
    corridor = Corridor(1, has_power_save=True, short="300s", long="300s")
    random, now_ns = Random(2), _S
    corridor.place(0, kernel.NEAR_M)
    for _ in range(PACKETS):
        now_ns += round(random.uniform(0.5, 0.9) * _S)
        corridor.send(now_ns, destination)
    corridor.receive(now_ns + _S)
    return [(corridor.arrived_ns[packet] - sent_ns) / 1e9 for packet, sent_ns in enumerate(corridor.sent_ns)]


def distance(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the largest difference of two empirical distribution functions (Kolmogorov and Smirnov)."""
    values = np.sort(np.concatenate((first, second)))
    shares = [np.searchsorted(np.sort(sample), values, side="right") / len(sample) for sample in (first, second)]
    return float(np.max(np.abs(shares[0] - shares[1])))


# Tables


def _row(label: str, linux: str, model: str = "-") -> str:
    return f"  {label}: {linux}; {model}"


def _ms(values_s: Sequence[float]) -> str:
    return f"{1e3 * median(values_s):.0f} ({1e3 * min(values_s):.0f} to {1e3 * max(values_s):.0f})"


def _absence_rows(label: str, linux: Sequence[Interval], model: Sequence[Interval]) -> Iterator[str]:
    parts = [linux, model] if model else [linux]
    away_s = [[end_s - start_s for start_s, end_s in part] for part in parts]
    returns_s = [[start_s - end_s for (_, end_s), (start_s, _) in pairwise(part)] for part in parts]
    yield _row(f"{label}, away (ms)", *map(_ms, away_s))
    yield _row(f"{label}, on its channel in between (ms)", *map(_ms, returns_s))
    yield _row(f"{label}, absences, total (s)", *(f"{len(part)}, {part[-1][1] - part[0][0]:.2f}" for part in parts))


def scan_lines(events: Recording) -> Iterator[str]:
    """Yield the rows of scans."""
    for words, dwell in (("", "64ms"), ("passive", "112ms")):
        (step,) = events.steps(f"scan {words}")
        yield _row(f"{words or 'active'} scan, channel (ms)", _ms(visits_s(step)), dwell.removesuffix("ms"))
        (step,) = events.steps(f"associated scan {words}")
        yield from _absence_rows(f"{words or 'active'} scan of a station", absences(step), model_absences(dwell))
    for text in ("with packets to the robot", "with packets from the robot"):
        (step,) = events.steps(f"associated scan {text}")
        yield from _absence_rows(f"scan {text}", absences(step), [])


def association_lines(events: Recording) -> Iterator[str]:
    """Yield the rows of associations, losses of their frames, and losses of the link."""
    for security, count, first_bytes in (("wpa2", 8, 34), ("wpa3", 10, 132)):
        complete = [f for f in associations(events) if (len(f), f[0].size_bytes) == (count, first_bytes)]
        times_s = [frames[-1].time_s - frames[0].time_s for frames in complete]
        model_s = model_association_s(sae=security == "wpa3")
        yield _row(f"{security}, {len(complete)} associations (ms)", _ms(times_s), f"{1e3 * model_s:.1f}")
        yield _row("frames", ", ".join(f"{frame.kind} {frame.size_bytes}" for frame in complete[-1]))
    for text in dict.fromkeys(text for _, text in events.marks if text.startswith("lost ")):
        yield _row(f"{text}, next frame after (ms)", f"{1e3 * repetition_s(*events.steps(text)):.0f}")
    losses = link_losses_s(events)
    parts_s = [loss[0] for loss in losses], [model_link_loss_s(seed) for seed in range(RUNS)]
    texts = [f"{fmean(part):.2f} ({min(part):.2f} to {max(part):.2f})" for part in parts_s]
    yield _row("loss of the link (s)", *texts)
    yield _row("null frames", str({loss[1] for loss in losses}))
    yield _row("from the end of the association to a scan (ms)", _ms([loss[2] for loss in losses]))


def walk_lines(events: Recording) -> Iterator[str]:
    """Yield the rows of walks."""
    for name in kernel.SCANS:
        (step,) = events.steps(f"walk {name}")
        linux, model = (
            ", ".join(f"{position_m:.1f} m to {new}, gap {1e3 * gap_s:.0f} ms" for position_m, new, gap_s in moves)
            for moves in (handovers(step), model_walk(name, 1))
        )
        yield _row(f"{name} scans, handovers", linux, model)


def power_save_lines(events: Recording) -> Iterator[str]:
    """Yield the rows of power save."""
    yield _row(
        "time from a packet until the robot sleeps (ms)", _ms(awake_times_s(events)), f"{_SILENT_NS / _MS:.0f}"
    )
    for kind, destination in DESTINATIONS.items():
        linux, model = delays_s(events, kind), model_delays_s(destination)
        yield _row(f"delay of a {kind} (ms)", _ms(linux), _ms(model))
        yield _row("distance of the distributions", f"{distance(linux, model):.3f}")
    yield _row("delay of packets every 50 ms (ms)", _ms(delays_s(events, "frequent packet")[3:]))


TABLES: Final[Mapping[str, Callable[[Recording], Iterator[str]]]] = {
    "scans": scan_lines,
    "associations": association_lines,
    "walks": walk_lines,
    "power-save": power_save_lines,
}
"""The rows by recording."""


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description="Compare roaming and power save of Linux with fieldkit's.")
    parser.add_argument("--record", action="store_true", help="record the events of Linux again, as root")
    options = parser.parse_args()
    for name, table in TABLES.items():
        if options.record:
            recording(name).write_bytes(gzip.compress(record(name).encode(), mtime=0))
        sys.stdout.write(f"{name}: Linux; fieldkit\n")
        events = read(gzip.decompress(recording(name).read_bytes()).decode())
        sys.stdout.writelines(f"{line}\n" for line in table(events))


if __name__ == "__main__":
    main()
