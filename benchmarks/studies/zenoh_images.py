"""Losses of 1 MB images over Zenoh, per repeat: `python -m benchmarks.studies.zenoh_images [--rounds N] [--page P]`.

The program needs root. Two emulated robots of a separate lab are 20 m apart. The agent of the step `topics` is
compared with a plain pair of Zenoh sessions on the same robots (benchmarks/studies/zenoh_plain.py, which imports
nothing of fieldkit), with several settings; each round runs all of them in sequence. Losses of this stream are
bimodal, so each repeat is printed instead of a mean.

A repeat takes 11 s, a round of six settings about 70 s.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.studies.middleware import LAB, ROOT
from fieldkit.core import files
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types
from fieldkit.ros.middlewares import tuning
from fieldkit.ros.streams import topic_samples

BEGIN: Final = "<!-- written by benchmarks.studies.zenoh_images: from here -->"
END: Final = "<!-- written by benchmarks.studies.zenoh_images: to here -->"
PLAIN: Final = ROOT / "benchmarks" / "studies" / "zenoh_plain.py"
BYTES: Final = 1_000_000
RATE_HZ: Final = 2.0
SAMPLES: Final = 16
PUBLISHER: Final = ("rover-1", "10.42.0.1")
SUBSCRIBER: Final = ("base", "10.42.0.5")
MAX_WAIT_SETTING: Final = "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments"
"""Microseconds for which a publisher with DROP waits for space in its queue, for a fragmented sample; 50,000 by
default (Zenoh 1.9, DEFAULT_CONFIG.json5)."""
LONG_WAIT_US: Final = 500_000
_PORT: Final = 7447
_DOMAIN: Final = 42


@dataclass(frozen=True)
class ImageSetting:
    """A pair of programs and its settings.

    Attributes:
        label: Label of its row in the table.
        profile: Quality of service of the agent; empty for the plain pair.
        settings: Settings of Zenoh by their path, as in the step `topics`.
    """

    label: str
    profile: str
    settings: Mapping[str, str]


SETTINGS: Final = (
    ImageSetting("plain pair, `DROP`", "", {}),
    ImageSetting("agent, `sensor_data`", "sensor_data", {}),
    ImageSetting("agent, `default` (reliable)", "default", {}),
    ImageSetting("plain pair, `DROP`, waits 500 ms", "", {MAX_WAIT_SETTING: str(LONG_WAIT_US)}),
    ImageSetting("agent, `default`, waits 500 ms", "default", {MAX_WAIT_SETTING: str(LONG_WAIT_US)}),
    ImageSetting(
        "agent, `default`, tuned (`block_first`)",
        "default",
        tuning.recommended_settings("zenoh", "tcp"),
    ),
)


class ImageLab:
    """Two robots of a running lab.

    Args:
        folder: Folder of the lab.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._python = str(Path(sys.executable))

    def command(self, robot: str, *argv: str) -> list[str]:
        """Return the command that runs another command on a robot."""
        robot_command = ("env", f"PYTHONPATH={ROOT}", *argv)
        return ["ssh", "-F", str(self._folder / "lab.ssh"), robot, shlex.join(robot_command)]

    def lost_images(self, setting: ImageSetting) -> list[int]:
        """Return the numbers of the images that did not arrive in one repeat.

        Raises:
            subprocess.CalledProcessError: A program on a robot failed.
            RuntimeError: The subscriber exited early, a log of the agent is incomplete, or no image was sent because
                the publisher discovered no subscription.
        """
        sent, arrived = self._agent(setting) if setting.profile else self._plain(setting)
        if not sent:
            raise RuntimeError(f"{setting.label}: no image was sent")
        return sorted(set(range(SAMPLES)) - set(arrived))

    def _plain(self, setting: ImageSetting) -> tuple[list[int], list[int]]:
        ends = {}
        for verb, listens in (("subscribe", True), ("publish", False)):
            locators = [f"tcp/{SUBSCRIBER[1]}:{_PORT}"]
            config: dict[str, Any] = {
                "mode": "peer",
                "scouting/multicast/enabled": False,
                "listen/endpoints": locators if listens else [],
                "connect/endpoints": [] if listens else locators,
            }
            config |= {path: json.loads(text) for path, text in setting.settings.items()}
            request = {"config": config, "key": "images", "bytes": BYTES, "rate": RATE_HZ, "samples": SAMPLES}
            ends[verb] = (str(PLAIN), verb, json.dumps(request))
        return self._stream(ends, "up")

    def _agent(self, setting: ImageSetting) -> tuple[list[int], list[int]]:
        stream = {"over": "zenoh", "size_bytes": BYTES, "rate_hz": RATE_HZ, "duration_s": SAMPLES / RATE_HZ}
        ends = {}
        for verb, (_, address) in (("subscribe", SUBSCRIBER), ("publish", PUBLISHER)):
            node = f"fieldkit_{verb}"
            network = {"address": address, "domain": _DOMAIN, "port": _PORT, "node": node}
            topic = topics.describe(
                standard_types(),
                "/images",
                "std_msgs/msg/UInt8MultiArray",
                PROFILES[setting.profile],
                domain=_DOMAIN,
                node=node,
            )
            request = {
                "network": {**network, "discovery": "multicast", "settings": dict(setting.settings)},
                "topic": topic,
                "stream": {**stream, "patience_s": 20.0},
            }
            ends[verb] = ("-m", "fieldkit.agent", verb, json.dumps(request), f"{verb}.bin")
        self._stream(ends, "up,")
        return self._logged_numbers(PUBLISHER[0], "publish"), self._logged_numbers(SUBSCRIBER[0], "subscribe")

    def _logged_numbers(self, robot: str, verb: str) -> list[int]:
        data = subprocess.run(self.command(robot, "cat", f"{verb}.bin"), check=True, capture_output=True).stdout
        path = self._folder / f"{verb}.bin"
        path.write_bytes(data)
        log = topic_samples.read_log(path)
        if not log.is_complete:
            raise RuntimeError(f"{path} is incomplete")
        return [int(number) for number in log.samples.sequence]

    def _stream(self, ends: Mapping[str, Sequence[str]], up: str) -> tuple[list[int], list[int]]:
        """Run the subscriber and the publisher.

        Returns:
            The numbers of the sent and of the received samples that they print. The agent prints no numbers.
        """
        script = "echo pid $$; exec " + shlex.join((self._python, "-u", *ends["subscribe"])) + " 2>&1"
        with subprocess.Popen(
            self.command(SUBSCRIBER[0], "sh", "-c", script),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as subscriber:
            assert subscriber.stdout is not None
            pid = subscriber.stdout.readline().split()[1]
            while not (line := subscriber.stdout.readline()).startswith(up):
                if not line:
                    raise RuntimeError("the subscriber exited before it was up")
            publish = self.command(PUBLISHER[0], self._python, *ends["publish"])
            sent = subprocess.run(publish, check=True, capture_output=True, text=True, stdin=subprocess.DEVNULL)
            subprocess.run(self.command(SUBSCRIBER[0], "kill", "-TERM", pid), check=True)
            received, _ = subscriber.communicate()
        return _numbers(sent.stdout), _numbers(received)


def _numbers(text: str) -> list[int]:
    return [json.loads(line)[0] for line in text.splitlines() if line.startswith("[")]


def measure(folder: Path, rounds: int) -> dict[str, list[list[int]]]:
    """Return the images lost in each repeat by setting.

    Args:
        folder: An empty folder, for the lab.
        rounds: Number of repeats of each setting.
    """
    text = (LAB / "fieldkit.yaml").read_text(encoding="utf-8").replace("ros: debian", "ros: builtin")
    (folder / "fieldkit.yaml").write_text(text, encoding="utf-8")
    lost_images: dict[str, list[list[int]]] = {setting.label: [] for setting in SETTINGS}
    _fieldkit(folder, "lab", "up")
    try:
        (folder / "lab.ssh").write_text(_fieldkit(folder, "lab", "ssh-config"), encoding="utf-8")
        _fieldkit(folder, "lab", "move", PUBLISHER[0], "--to", "195m", "195m")
        _fieldkit(folder, "lab", "move", SUBSCRIBER[0], "--to", "215m", "195m")
        lab = ImageLab(folder)
        for number in range(rounds):
            for setting in SETTINGS:
                lost_images[setting.label].append(lab.lost_images(setting))
                print(number, setting.label, lost_images[setting.label][-1], file=sys.stderr, flush=True)
    finally:
        _fieldkit(folder, "lab", "down")
    return lost_images


def _fieldkit(folder: Path, *words: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = (sys.executable, "-m", "fieldkit", *words)
    return subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout


def table(lost_images: Mapping[str, Sequence[Sequence[int]]], conditions: str) -> Iterator[str]:
    """Yield a table with the number of lost images in each repeat, in the order of the repeats."""
    yield conditions
    yield ""
    lost_header = f"images lost of {SAMPLES}, a number for each repeat"
    yield f"| pair and settings | {lost_header} | repeats that lost the first image |"
    yield "| --- | --- | --- |"
    for label, repeats in lost_images.items():
        first = sum(0 in lost for lost in repeats)
        yield f"| {label} | {', '.join(str(len(lost)) for lost in repeats)} | {first} of {len(repeats)} |"


def main() -> None:
    """Measure; print the table, or write it into a page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="repeats of each setting")
    parser.add_argument("--page", type=Path, help="write the table into this page")
    parser.add_argument("--json", type=Path, help="write every repeat there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        lost_images = measure(Path(folder), options.rounds)
    congestion_control = Path("/proc/sys/net/ipv4/tcp_congestion_control").read_text(encoding="ascii").strip()
    conditions = (
        f"{time.strftime('%Y-%m-%d', time.gmtime())}: {options.rounds} repeats of each, alternating; TCP with "
        f"{congestion_control}; load average of the last 15 minutes {os.getloadavg()[2]:.1f}."
    )
    if options.json:
        files.write(options.json, json.dumps(lost_images).encode())
    lines = list(table(lost_images, conditions))
    if options.page is None:
        print("\n".join(lines))
        return
    text = options.page.read_text(encoding="utf-8")
    before, after = text.index(BEGIN) + len(BEGIN), text.index(END)
    files.write(options.page, "\n".join((text[:before], "", *lines, "", text[after:])).encode())


if __name__ == "__main__":
    main()
