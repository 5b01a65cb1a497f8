"""minstrel_ht of fieldkit compared with Linux: `python -m benchmarks.minstrel_vs_kernel [--record] [--figure FILE]`.

A sender moves away from its receiver and back, on open ground, without and with fading. Both algorithms send the same
frames at the same times. The probability that a try fails is the packet error rate of its mode at the signal-to-noise
ratio of the frame; both algorithms use the same random draws. The kernel's choices were recorded in a virtual machine
(`kernel_minstrel`). The virtual machine's clock counts instructions, so a busy host does not change the choices.
`--record` records them again, as root. The choices of fieldkit are computed here, for several seeds of its sampling.
"""

import argparse
import json
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from statistics import fmean
from typing import Any, Final

import numpy as np

from benchmarks import kernel_recordings
from benchmarks.kernel_minstrel import MAX_TRIES, is_received, mode_name
from sim_backends.emulated.linux_wifi.hwsim_messages import RateStage
from sim_backends.radio.core.random_streams import PacketDraws
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import PhyCapability, format_modes, mode_groups
from sim_backends.radio.phy.modes import WifiMode, ack_ns
from sim_backends.radio.rate_control.minstrel_ht import MinstrelHt

TRACES: Final = {"walk": False, "walk with fading": True}
"""Traces by name; True if the trace has fading."""
SEEDS: Final = 20

FRAMES: Final = 6_000
STEP_NS: Final = 5_000_000
"""Time between two frames."""
PAYLOAD_BYTES: Final = 1_000
_FRAME_BYTES: Final = 1_036
"""Size for which packet errors are computed: the payload with the headers of 802.11 and LLC, and the FCS."""
_NEAR_M, _FAR_M, _EXPONENT, _NEAR_DB = 5.0, 80.0, 3.0, 40.0
"""Smallest and largest distance, exponent of the path loss, and signal-to-noise ratio at the smallest distance."""
_LEVEL_DB, _LOWEST_DB, _LEVELS = 0.25, -10.0, 240
"""Step, lowest value and number of the signal-to-noise ratios for which a trace has packet errors."""
_FADING_PATHS, _DOPPLER_HZ = 16, 8.0
_LONGEST_S: Final = 1800.0  # time limit of a recording
_PHY: Final = PhyCapability("n", "2.4 GHz", 20, 2, 400)

MODES: Final = {
    f"{mcs + 8 * (streams - 1)} {guard_ns}": mode
    for streams in (1, 2)
    for guard_ns in (400, 800)
    for mcs, mode in enumerate(format_modes("HT", "2.4 GHz", 20, streams, guard_ns))
}
"""The modes of 802.11n with one or two streams in 20 MHz, by MCS and guard interval."""
_NAMES: Final = {mode: name for name, mode in MODES.items()}


@dataclass(frozen=True)
class SelectedFrame:
    """A frame and the modes that were selected for it.

    Attributes:
        time_ns: Time at which it was sent.
        modes: Mode of each try; None for a rate of 802.11b.
        is_received: True if the last try succeeded.
        is_sample: True if the first try was a sample, with which minstrel tests another mode.
    """

    time_ns: int
    modes: tuple[WifiMode | None, ...]
    is_received: bool
    is_sample: bool


def signal_to_noise_db(frames: int, *, fading: bool) -> list[float]:
    """Return the signal-to-noise ratio of each frame: 40 dB at 5 m, inverse to the third power of the distance.

    The distance increases linearly to 80 m and decreases again. Fading is a sum of paths with random directions and
    phases (Clarke's model) with a Doppler shift of 8 Hz: 1 m/s at 2.4 GHz.
    """
    random = Random(1)
    paths = [(random.uniform(0, 2 * math.pi), random.uniform(0, 2 * math.pi)) for _ in range(_FADING_PATHS)]
    ratios_db = []
    for number in range(frames):
        share = 1 - abs(2 * number / frames - 1)  # 0 at the ends of the trace, 1 in its middle
        distance_m = _NEAR_M + (_FAR_M - _NEAR_M) * share
        ratio_db = _NEAR_DB - 10 * _EXPONENT * math.log10(distance_m / _NEAR_M)
        if fading:
            doppler_rad = 2 * math.pi * _DOPPLER_HZ * number * STEP_NS / 1e9
            field = sum(np.exp(1j * (doppler_rad * math.cos(angle) + phase)) for angle, phase in paths)
            ratio_db += 10 * math.log10(max(abs(field) ** 2 / _FADING_PATHS, 1e-3))
        ratios_db.append(ratio_db)
    return ratios_db


def trace(frames: int, *, fading: bool) -> dict[str, Any]:
    """Return the trace for `kernel_minstrel`: errors by signal-to-noise level, and the level of each frame."""
    levels_db = [_LOWEST_DB + number * _LEVEL_DB for number in range(_LEVELS)]
    levels = [
        min(max(round((ratio_db - _LOWEST_DB) / _LEVEL_DB), 0), _LEVELS - 1)
        for ratio_db in signal_to_noise_db(frames, fading=fading)
    ]
    errors = {
        name: [packet_error(mode, level_db, _FRAME_BYTES) for level_db in levels_db] for name, mode in MODES.items()
    }
    return {"levels": levels, "errors": errors, "step_ns": STEP_NS, "payload_bytes": PAYLOAD_BYTES}


def recording(name: str) -> Path:
    """Return the file of the recording of a trace."""
    return kernel_recordings.RECORDINGS / f"minstrel-{name.replace(' ', '-')}.csv.gz"


def record(content: dict[str, Any]) -> str:
    """Return the recording of a trace in a new virtual machine."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "trace"
        file.write_text(json.dumps(content), encoding="ascii")
        return kernel_recordings.record(folder, "kernel_minstrel", str(file), radios=2, limit_s=_LONGEST_S)


def read(text: str) -> list[tuple[int, tuple[RateStage, ...], int, bool]]:
    """Return time (ns), stages, number of tries and success of each frame of a recording."""
    frames = []
    for line in text.splitlines():
        time_us, stages, tries = line.split(",")
        fields = (tuple(map(int, stage.split(":"))) for stage in stages.split())
        chain = tuple(RateStage(index, count, flags) for index, count, flags in fields)
        frames.append((int(time_us) * 1000, chain, int(tries.rstrip("+")), tries.endswith("+")))
    return frames


def kernel_frames(text: str) -> list[SelectedFrame]:
    """Return the kernel's frames of a recording. A chain whose first stage has one try is a sample."""
    frames = []
    for time_ns, stages, tries, is_acknowledged in read(text):
        names = [mode_name(stage) for stage in stages for _ in range(stage.tries)][:tries]
        modes = tuple(None if name is None else MODES[name] for name in names)
        frames.append(SelectedFrame(time_ns, modes, is_acknowledged, stages[0].tries == 1))
    return frames


def fieldkit_frames(content: dict[str, Any], times_ns: Sequence[int], seed: int) -> list[SelectedFrame]:
    """Return the frames of fieldkit's minstrel_ht, sent at `times_ns`."""
    control = MinstrelHt(mode_groups(_PHY, _PHY), PacketDraws(seed, "sender", "receiver"))
    frames = []
    for number, time_ns in enumerate(times_ns):
        modes: list[WifiMode] = []
        is_acknowledged = is_sample = False
        while len(modes) < MAX_TRIES and not is_acknowledged:
            modes.append(control.choose(time_ns, ("sender", number), len(modes) + 1))
            is_sample = is_sample or (len(modes) == 1 and control.is_probing)
            is_acknowledged = is_received(content, number, len(modes), _NAMES[modes[-1]])
            control.report(modes[-1], acknowledged=int(is_acknowledged))
        frames.append(SelectedFrame(time_ns, tuple(modes), is_acknowledged, is_sample))
    return frames


def goodput_bit_s(frames: Sequence[SelectedFrame]) -> float:
    """Return the received payload per time on the air, in bit/s.

    The time includes ACKs and interframe spaces, but no MAC headers, no backoffs, and no tries in 802.11b.
    """
    air_ns = 0
    for frame in frames:
        for mode in frame.modes:
            if mode is not None:
                air_ns += mode.band.difs_ns + mode.airtime_ns(PAYLOAD_BYTES + 8) + mode.band.sifs_ns + ack_ns(mode)
    return 8 * PAYLOAD_BYTES * sum(frame.is_received for frame in frames) / air_ns * 1e9


def frames_per_mcs(frames: Sequence[SelectedFrame]) -> Counter[str]:
    """Return the number of received frames per MCS, both guard intervals together."""
    return Counter(_NAMES[mode].split()[0] for frame in frames if frame.is_received and (mode := frame.modes[-1]))


def rates_bit_s(frames: Sequence[SelectedFrame], window_ns: int = 1_000_000_000) -> list[float]:
    """Return the mean rate of the first tries that are not samples, per window of time with such tries."""
    windows: dict[int, list[int]] = {}
    for frame in frames:
        if not frame.is_sample and (mode := frame.modes[0]) is not None:
            windows.setdefault(frame.time_ns // window_ns, []).append(mode.rate_bit_s)
    return [fmean(rates) for _, rates in sorted(windows.items())]


def difference(first: Counter[str], second: Counter[str]) -> float:
    """Return the total variation distance of two distributions: 0 if they are equal, at most 1."""
    names = first.keys() | second.keys()
    return sum(abs(first[name] / first.total() - second[name] / second.total()) for name in names) / 2


ROWS: Final[Mapping[str, Callable[[Sequence[SelectedFrame]], float]]] = {
    "frames received (%)": lambda frames: 100 * fmean(frame.is_received for frame in frames),
    "tries per frame": lambda frames: fmean(len(frame.modes) for frame in frames),
    "samples (%)": lambda frames: 100 * fmean(frame.is_sample for frame in frames),
    "goodput on the air (Mbit/s)": lambda frames: goodput_bit_s(frames) / 1e6,
}
"""Figures of a run, by their labels."""


def lines(
    name: str, kernel: Sequence[SelectedFrame], fieldkit_runs: Sequence[Sequence[SelectedFrame]]
) -> Iterator[str]:
    """Yield the table of a trace."""
    yield f"{name}, {len(kernel)} frames: kernel; fieldkit, smallest to largest of {len(fieldkit_runs)} seeds"
    for label, compute in ROWS.items():
        values = [compute(frames) for frames in fieldkit_runs]
        yield f"  {label}: {compute(kernel):.2f}; {min(values):.2f} to {max(values):.2f}"
    counts = [frames_per_mcs(frames) for frames in fieldkit_runs]
    kernel_counts = frames_per_mcs(kernel)
    for mcs in map(str, range(16)):
        values = [count[mcs] for count in counts]
        yield f"  frames in MCS {mcs}: {kernel_counts[mcs]}; {min(values)} to {max(values)}"
    distances = [difference(kernel_counts, count) for count in counts]
    yield f"  frames in another MCS than the kernel's: {100 * min(distances):.1f} to {100 * max(distances):.1f} %"


def draw(path: Path, results: dict[str, tuple[list[SelectedFrame], list[SelectedFrame]]]) -> None:
    """Draw the mean rate of each half second: of the kernel as a line, of fieldkit as marks."""
    import matplotlib as mpl  # noqa: PLC0415 (needed only for the figure)
    from matplotlib.figure import Figure  # noqa: PLC0415

    mpl.rcParams["svg.hashsalt"] = "minstrel_vs_kernel"
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    for axes, (name, frames) in zip(figure.subplots(1, len(results), squeeze=False)[0], results.items(), strict=True):
        for style, label, selected in zip(("-", "."), ("Linux 6.1", "fieldkit"), frames, strict=True):
            rates = np.array(rates_bit_s(selected, 500_000_000)) / 1e6
            axes.plot(np.arange(len(rates)) / 2, rates, style, label=label)
        axes.set(title=name, xlabel="time (s)", ylabel="rate of first tries (Mbit/s)")
        axes.legend(fontsize="small")
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description="Compare minstrel_ht of Linux with fieldkit's.")
    parser.add_argument("--record", action="store_true", help="record the kernel's choices again, as root")
    parser.add_argument("--figure", type=Path, help="write a figure to this file")
    options = parser.parse_args()
    results = {}
    for name, fading in TRACES.items():
        content = trace(FRAMES, fading=fading)
        if options.record:
            kernel_recordings.save(recording(name), record(content))
        kernel = kernel_frames(kernel_recordings.load(recording(name)))
        times_ns = [frame.time_ns for frame in kernel]
        fieldkit_runs = [fieldkit_frames(content, times_ns, seed) for seed in range(SEEDS)]
        results[name] = kernel, fieldkit_runs[0]
        sys.stdout.write("\n".join(lines(name, kernel, fieldkit_runs)) + "\n")
    if options.figure:
        draw(options.figure, results)


if __name__ == "__main__":
    main()
