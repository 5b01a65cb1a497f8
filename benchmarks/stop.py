"""Time until a moving robot stops: `python -m benchmarks.stop`, as root; needs Debian's ROS 1.

An emulated robot, which fieldkit treats as a real one, drives at 0.6 m/s. Each round runs three commands in sequence,
each in a new process: OpenSSH's `ssh ROBOT true` and `fieldkit stop`, both for another robot that no program moves;
then `fieldkit stop` for the driving robot. Times are from the start of the process. The robot's motion is from the
log of its base with 50 samples per second, independent of fieldkit's report.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.core.model import Role
from tests.helpers.motion_truth import MotionSampler, stopped_s
from tests.helpers.rovers import RoverLab, rover_lab
from tests.helpers.runs import finish, start

_PATH_M: Final = 25.0
_BRAKING_SHARE: Final = 0.9
"""Below this share of its speed a robot counts as braking: it has received a velocity of zero."""
_TIMEOUT_S: Final = 60.0
FIGURES: Final = {
    "ssh": "`ssh box-1 true` (OpenSSH)",
    "idle": "`fieldkit stop box-1`; no program moves the robot",
    "brakes": "`fieldkit stop rover-1`, until the base brakes",
    "stationary": "until the robot is stationary",
    "printed": "until `stopped (stationary)` is printed",
    "ended": "until the command has exited",
}


def measure(lab: RoverLab, out: str) -> dict[str, float]:
    """Return the times of one round, in seconds, by the names of `FIGURES`."""
    lab.place_at("5m")
    with MotionSampler(lab.field_robots.testbed.robots[Role.SENDER].recorded_motion, lab.place_m) as sampler:
        trial = start(lab.folder, "trial", "drive", "5m", "--yes", "--allow-motion", "--out", out)
        try:
            lab.wait_until_it_drives(trial)
            times = {"ssh": _duration_s(ssh_words(lab)), "idle": _duration_s(_stop_words("box-1"))}
            before_m_s = sampler.samples[-1].speed_m_s
            started_s = time.monotonic()
            with subprocess.Popen(_stop_words("rover-1"), stdout=subprocess.PIPE, text=True) as stop:
                assert stop.stdout is not None
                line = stop.stdout.readline()
                times["printed"] = time.monotonic() - started_s
                code = stop.wait(_TIMEOUT_S)
                times["ended"] = time.monotonic() - started_s
            if code != 0 or line != "rover-1: stopped (stationary)\n":
                raise SystemExit(f"fieldkit stop exited with {code}: {line!r}")
            finish(trial)
        finally:
            trial.kill()
            trial.wait()
        samples = list(sampler.samples)
    stationary_s = stopped_s(samples, started_s)
    brakes_s = next(
        sample.at_s - started_s
        for sample in samples
        if sample.at_s > started_s and sample.speed_m_s < _BRAKING_SHARE * before_m_s
    )
    return times | {"brakes": brakes_s, "stationary": stationary_s if stationary_s is not None else float("nan")}


def ssh_words(lab: RoverLab) -> tuple[str, ...]:
    """Return the OpenSSH command to a robot with the key and the pinned host key of the site file."""
    site = (lab.folder / "fieldkit.yaml").read_text(encoding="utf-8")
    entry = re.search(r"box-1: .*port: (\d+), .*key: (\S+), host_key: ([^}]+)}", site)
    assert entry is not None
    port, key, host_key = entry.groups()
    known_hosts = lab.folder / "known_hosts"
    known_hosts.write_text(f"[127.0.0.1]:{port} {host_key}\n", encoding="ascii")
    options = (
        "BatchMode=yes",
        "IdentitiesOnly=yes",
        "StrictHostKeyChecking=yes",
        f"UserKnownHostsFile={known_hosts}",
    )
    words = [word for option in options for word in ("-o", option)]
    return ("ssh", "-F", "none", *words, "-i", key, "-p", port, "root@127.0.0.1", "true")


def _stop_words(robot: str) -> tuple[str, ...]:
    return (sys.executable, "-m", "fieldkit", "stop", robot)


def _duration_s(words: Sequence[str]) -> float:
    started_s = time.monotonic()
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, timeout=_TIMEOUT_S)
    return time.monotonic() - started_s


def main() -> int:
    """Print a table of medians, lowest and highest values."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="fieldkit-stop-") as folder, rover_lab(Path(folder)) as lab:
        os.chdir(lab.folder)  # the folder of the site file
        lab.write_procedure(Role.SENDER, _PATH_M)
        rounds = [measure(lab, f"round-{number}") for number in range(options.rounds)]
        os.chdir("/")
    if options.json:
        print(json.dumps(rounds))
        return 0
    print(f"load {load:.1f} before, {os.getloadavg()[0]:.1f} after, {options.rounds} rounds\n")
    print("| seconds from the start of the command | median | lowest | highest |\n| --- | --- | --- | --- |")
    for name, text in FIGURES.items():
        values = [times[name] for times in rounds]
        print(f"| {text} | {statistics.median(values):.2f} | {min(values):.2f} | {max(values):.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
