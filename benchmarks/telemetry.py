"""Cost of the sampler of a robot's link: `python -m benchmarks.telemetry [--json] [--seconds N]`, needs no root.

The sampler runs as on a robot, in each installed shell, with the real `iw` (`apt-get install iw`). Without Wi-Fi in
the kernel `iw` fails early, and the sampler gets a stored station text instead; with Wi-Fi the cost of the driver is
added. The reference is a loop in the same shell that calls `iw` three times and sleeps 0.2 s. Processor time is the
kernel's count for the shell and its children, per second.

The row `a source` is a telemetry source of a profile, in this case a program that is run every 2 s.

A slower computer is simulated by an `iw` that runs several times. The sampler must then call it less often to stay
within its share of the processor time.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from fieldkit.config import schema
from fieldkit.remote.script import SCRIPT
from fieldkit.telemetry.telemetry_section import TelemetrySource
from tests.helpers.telemetry_devices import ENTERPRISE, json_server, modem_bus, snmp_agent

SHELLS: Final = {"bash": ("bash",), "dash": ("dash",), "busybox ash": ("busybox", "sh")}
SLOWER: Final = (1, 4, 8)
"""Numbers of runs of `iw` per call of the sampler."""

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
# A function that replaces `iw` in the script and runs the real one SLOWER times.
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

# A telemetry source of a profile at its default interval; the cost of its program is added.
_POLL: Final = ("poll", ".began", "-", "-", "-", "2", "2", "echo", "signal:")
_ANSWER: Final = r"==> [0-9.]+ 0 [0-9]+ <=="
_COMMUNITY: Final = "benchmark"
_SOURCES: Final = {
    "command": "command: [echo, '{\"rsrp\": -97.5}']\nvalues: {signal_dbm: {json: rsrp}}",
    "http": "http: {url: 'http://127.0.0.1:HTTP/'}\nvalues: {signal_dbm: {json: rsrp}}",
    "snmp": (
        "snmp: {address: 127.0.0.1, port: SNMP, credentials: {file: FOLDER/snmp.conf}}\n"
        f"values: {{signal_dbm: {{oid: {ENTERPRISE}.1.0}}, noise_dbm: {{oid: {ENTERPRISE}.3.0}}}}"
    ),
    "modemmanager": "modemmanager: {modem: any}",
    "batctl": "batctl: {interface: bat0}",
}


Row = dict[str, float | str | int]


def measure(
    shell: Sequence[str], text: str, words: Sequence[str], seconds: float, sample: str = "signal:"
) -> tuple[float, int]:
    """Run a script in a folder like an attempt's for some seconds.

    Args:
        shell: The shell and its arguments.
        text: The script.
        words: Its arguments.
        seconds: Duration of the run.
        sample: Regular expression of a sample in its output.

    Returns:
        Processor time in ms per second, and the number of samples.
    """
    with tempfile.TemporaryDirectory() as folder:
        jobs = Path(folder, ".jobs", "link")
        jobs.mkdir(parents=True)
        os.mkfifo(jobs / "end")
        Path(folder, ".began").write_text("- benchmark\n", encoding="ascii")
        script, output = Path(folder, "script.sh"), Path(folder, "output")
        script.write_text(text, encoding="utf-8")
        path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
        environment = os.environ | {"STATION": _STATION, "PATH": path}
        before, started_s = _children_s(), time.monotonic()
        with output.open("wb") as out:
            running = subprocess.Popen(
                (*shell, str(script), *words), cwd=folder, stdout=out, stderr=subprocess.DEVNULL, env=environment
            )
            time.sleep(seconds)
            running.terminate()
            running.wait()
        used_s, lasted_s = _children_s() - before, time.monotonic() - started_s
        return 1e3 * used_s / lasted_s, len(re.findall(sample.encode(), output.read_bytes()))


def _children_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def measure_sources(seconds: float) -> Iterator[Row]:
    """Yield a row for each kind of telemetry source whose program is installed."""
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        values = {"FOLDER": folder, "HTTP": stack.enter_context(json_server(b'{"rsrp": -97.5}')), "SNMP": 161}
        Path(folder, "snmp.conf").write_text(f"defCommunity {_COMMUNITY}\n", encoding="ascii")
        if shutil.which("snmpget") is not None:
            values["SNMP"] = stack.enter_context(snmp_agent(Path(folder), _COMMUNITY))
        if shutil.which("mmcli") is not None:
            os.environ["DBUS_SYSTEM_BUS_ADDRESS"] = stack.enter_context(modem_bus(Path(folder)))
        for kind, template in _SOURCES.items():
            text = re.sub("|".join(values), lambda match: str(values[match[0]]), template)
            source = schema.validate(schema.parse(text, source=kind), TelemetrySource)
            if shutil.which(source.program) is None:
                print(f"there is no {source.program}", file=sys.stderr)
                continue
            words = ("poll", ".began", "-", *source.poll_words("wlan0"))
            ms_per_s, answers = measure(("sh",), SCRIPT.decode(), words, seconds, _ANSWER)
            yield {"shell": "sh", "what": kind, "slower": 1, "ms_per_s": ms_per_s, "samples": answers}


def main() -> int:
    """Print a line per kind of source, and for each shell the reference, a source, and the sampler by slowness."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each run")
    options = parser.parse_args()
    if shutil.which("iw", path=f"{os.environ['PATH']}:/usr/sbin:/sbin") is None:
        print("there is no iw: apt-get install iw", file=sys.stderr)
        return 2
    rows: list[Row] = [*measure_sources(options.seconds)]
    for name, shell in SHELLS.items():
        if shutil.which(shell[0]) is None:
            continue
        loop = measure(shell, _IW.replace("SLOWER", "1") + _LOOP, (), options.seconds)
        rows.append({"shell": name, "what": "loop of iw", "slower": 1, "ms_per_s": loop[0], "samples": loop[1]})
        poll = measure(shell, SCRIPT.decode(), _POLL, options.seconds)
        rows.append({"shell": name, "what": "a source", "slower": 1, "ms_per_s": poll[0], "samples": poll[1]})
        for slower in SLOWER:
            text = _IW.replace("SLOWER", str(slower)) + SCRIPT.decode()
            used = measure(shell, text, ("sample", "wlan0", "-"), options.seconds)
            rows.append({"shell": name, "what": "sampler", "slower": slower, "ms_per_s": used[0], "samples": used[1]})
    if options.json:
        print(json.dumps(rows))
        return 0
    print(f"{'shell':12} {'what':12} {'iw slower':>9} {'ms/s':>7} {'samples/s':>9}")
    for row in rows:
        rate = int(row["samples"]) / options.seconds
        print(f"{row['shell']:12} {row['what']:12} {row['slower']:>9} {row['ms_per_s']:7.2f} {rate:9.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
