"""Scans, roaming and power save compared with Linux: `python -m benchmarks.roaming_vs_kernel [--record]`.

A robot is a station of two access points at the ends of a corridor. The events of Linux (mac80211_hwsim, hostapd and
wpa_supplicant) were recorded in a virtual machine (`kernel_roaming`). Its clock counts instructions, so times between
frames contain the time that programs need on an emulated processor, but timers of the kernel and of the programs are
those of real devices. `--record` records the events again, as root. The events of fieldkit are computed here.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from random import Random
from statistics import fmean, median
from typing import Final

import numpy as np

from benchmarks import kernel_recordings
from benchmarks import kernel_roaming as kernel
from benchmarks import roaming_lab as lab
from benchmarks.roaming_recordings import (
    Interval,
    Recording,
    absences,
    associations,
    awake_times_s,
    delays_s,
    handovers,
    link_losses_s,
    read,
    record,
    recording,
    repetition_s,
    visits_s,
)
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.phy.high_throughput import PhyCapability
from sim_backends.radio.radio_options import RadioOptions

RUNS: Final = 20
"""Number of link losses of fieldkit, each with another seed."""
PACKETS: Final = 400
"""Number of packets to a sleeping robot, in fieldkit."""

_NOISE_DBM: Final = -92
"""Noise that hwsim reports to wpa_supplicant."""
_SILENT_NS: Final = 100_000_000
"""Time without frames after which a robot sleeps: `dynamic_ps_timeout` of mac80211, if power save is on."""
_PHY: Final = PhyCapability("n", "2.4 GHz", 20, 1, 800, power_save_timeout_ns=_SILENT_NS)
_MS, _S = 10**6, 10**9
_STEP_NS: Final = 20 * _MS  # interval of packets to the robot
_ABSENT_NS: Final = 30 * _MS  # a longer time without packets is an absence of the robot

DESTINATIONS: Final[Mapping[str, str | None]] = {"packet": lab.ROBOT, "broadcast": None}
"""Destinations of packets to sleeping robots, by kind."""


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
            name: {"at_m": [east_m, north_m], "height": f"{up_m}m", "tx_power_dbm": lab.ACCESS_POINT_DBM}
            for name, (east_m, north_m, up_m) in lab.ACCESS_POINTS_M.items()
        }
        options = {
            "fading": False,
            "access_points": access_points,
            "roaming": {"noise_dbm": _NOISE_DBM, "channels": kernel.CHANNELS, **roaming},
        }
        antenna = Antenna("802.11n", lab.ROBOT_DBM, lab.SENSITIVITY_DBM, _PHY if has_power_save else None)
        self.model: WifiInWorld[int] = WifiInWorld(
            seed, RadioOptions.model_validate(options), {"base": antenna, lab.ROBOT: antenna}, None
        )
        self.model.use_meter()
        self.sent_ns: list[int] = []
        self.arrived_ns: dict[int, int] = {}
        self.cells: list[tuple[int, str | None]] = []

    def place(self, now_ns: int, east_m: float) -> None:
        """Place the robot in the corridor."""
        places_m = {"base": (0.0, 2.0, lab.HEIGHT_M), lab.ROBOT: (east_m, 0.0, lab.HEIGHT_M)}
        self.model.place(now_ns, places_m, None)

    def send(self, now_ns: int, destination: str | None = lab.ROBOT) -> None:
        """Send a packet, and receive those that have arrived."""
        self.model.send(now_ns, "base", len(self.sent_ns), 100, destination)
        self.sent_ns.append(now_ns)
        self.receive(now_ns)

    def receive(self, now_ns: int) -> None:
        """Receive packets, and examine with which access point the robot is associated."""
        for at_ns, receiver, packet, _, _ in self.model.deliveries(now_ns):
            if receiver == lab.ROBOT:
                self.arrived_ns[packet] = at_ns
        cell = self.model.sample(now_ns, now_ns)[lab.ROBOT].cell
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
        corridor.place(now_ns, lab.NEAR_M if now_ns < leave_ns else kernel.FAR_M)
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
    corridor.place(0, lab.NEAR_M)
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
            kernel_recordings.save(recording(name), record(name))
        sys.stdout.write(f"{name}: Linux; fieldkit\n")
        events = read(kernel_recordings.load(recording(name)))
        sys.stdout.writelines(f"{line}\n" for line in table(events))


if __name__ == "__main__":
    main()
