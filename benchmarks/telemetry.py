"""What the sampler of a robot's link costs: `python -m benchmarks.telemetry [--json] [--seconds N]`, needs no root.

The sampler runs as on a robot, by each shell that is here, with the real `iw` (`apt-get install iw`). Where the
kernel has no Wi-Fi, `iw` ends when it has found out, and the sampler is given a station's text in its place; a kernel
that has one adds what its driver takes. The yardstick is a loop of the same shell that calls `iw` three times, sleeps
0.2 s, and does it again. Processor time is the kernel's count of the shell and all that it ran, per second.

A slower computer is played by an `iw` that runs so many times: the sampler then calls it less often, and keeps to its
share.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.remote.script import SCRIPT

SHELLS: Final = {"bash": ("bash",), "dash": ("dash",), "busybox ash": ("busybox", "sh")}
SLOWER: Final = (1, 4, 8)

_STATION: Final = """\
Station f0:99:bf:0e:86:98 (on wlan0)
\tinactive time:\t8 ms
\trx bytes:\t4746300
\trx packets:\t25943
\ttx bytes:\t212945
\ttx packets:\t1263
\ttx failed:\t2
\tsignal:  \t-65 dBm
\ttx bitrate:\t65.0 MBit/s
\trx bitrate:\t58.5 MBit/s
\tauthorized:\tyes
\tauthenticated:\tyes
\tassociated:\tyes
\tconnected time:\t233 seconds
"""
# Defined before the script's own functions: where these say `iw`, the real one runs, so many times.
_IW: Final = """\
iw() {
    times=0
    while [ $((times += 1)) -le SLOWER ]; do command iw "$@" 2>/dev/null; done
    case $3 in link) echo 'Not connected.' ;; station) echo "$STATION" ;; esac
}
"""
_LOOP: Final = """\
while :; do
    iw dev wlan0 link; iw dev wlan0 station dump; iw dev wlan0 survey dump
    sleep 0.2
done
"""


def measure(shell: Sequence[str], text: str, words: Sequence[str], seconds: float) -> tuple[float, int]:
    """Run a script in a folder as an attempt's; return processor time in ms per second, and the number of samples."""
    with tempfile.TemporaryDirectory() as folder:
        jobs = Path(folder, ".jobs", "link")
        jobs.mkdir(parents=True)
        os.mkfifo(jobs / "end")
        Path(folder, ".began").write_text("- benchmark\n", encoding="ascii")
        script, told = Path(folder, "script.sh"), Path(folder, "told")
        script.write_text(text, encoding="utf-8")
        path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
        environment = os.environ | {"STATION": _STATION, "PATH": path}
        before, began_s = _children_s(), time.monotonic()
        with told.open("wb") as out:
            running = subprocess.Popen(
                (*shell, str(script), *words), cwd=folder, stdout=out, stderr=subprocess.DEVNULL, env=environment
            )
            time.sleep(seconds)
            running.terminate()
            running.wait()
        used_s, lasted_s = _children_s() - before, time.monotonic() - began_s
        return 1e3 * used_s / lasted_s, told.read_bytes().count(b"signal:")


def _children_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> int:
    """Print a line per shell and slowness."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="single values")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each run")
    options = parser.parse_args()
    if shutil.which("iw", path=f"{os.environ['PATH']}:/usr/sbin:/sbin") is None:
        print("there is no iw: apt-get install iw", file=sys.stderr)
        return 2
    found: list[dict[str, float | str | int]] = []
    for name, shell in SHELLS.items():
        if shutil.which(shell[0]) is None:
            continue
        loop = measure(shell, _IW.replace("SLOWER", "1") + _LOOP, (), options.seconds)
        found.append({"shell": name, "what": "loop of iw", "slower": 1, "ms_per_s": loop[0], "samples": loop[1]})
        for slower in SLOWER:
            text = _IW.replace("SLOWER", str(slower)) + SCRIPT.decode()
            used = measure(shell, text, ("sample", "wlan0", "-"), options.seconds)
            found.append(
                {"shell": name, "what": "sampler", "slower": slower, "ms_per_s": used[0], "samples": used[1]}
            )
    if options.json:
        print(json.dumps(found))
        return 0
    print(f"{'shell':12} {'what':12} {'iw slower':>9} {'ms/s':>7} {'samples/s':>9}")
    for one in found:
        rate = int(one["samples"]) / options.seconds
        print(f"{one['shell']:12} {one['what']:12} {one['slower']:>9} {one['ms_per_s']:7.2f} {rate:9.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
