"""Minimal runs of the benchmarks: `python -m tests.helpers.smallest NAME FOLDER` runs one in an empty folder.

A run shows that the benchmark still works; its figures have no meaning. It is an error to replace a constant that
does not exist.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final

from tests.helpers.labs import replace_text
from tests.helpers.paths import ROOT

Shrink = Callable[[ModuleType, Path], None]


@dataclass(frozen=True)
class MinimalRun:
    """Configuration of the minimal run of a benchmark.

    Attributes:
        arguments: Command-line arguments; `FOLDER` is replaced by the folder.
        constants: Constants of the module, with smaller values.
        shrink: Function that reduces the parts that are not constants.
        emulated: True if the benchmark needs network namespaces or robot programs.
    """

    arguments: str = ""
    constants: Mapping[str, object] = field(default_factory=dict)
    shrink: Shrink = lambda module, folder: None
    emulated: bool = False


TIMEOUT_S: Final = 600.0


def run_module(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run a Python module of the repository as a program."""
    return subprocess.run(
        (sys.executable, "-m", *arguments),
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


def run_minimally(name: str, folder: Path) -> None:
    """Run a benchmark with its minimal configuration in an empty folder.

    Raises:
        AssertionError: The benchmark failed or printed no figures.
    """
    completed = run_module("tests.helpers.smallest", name, str(folder))
    assert completed.returncode == 0, completed.stderr[-3000:]
    assert any(character.isdigit() for character in completed.stdout), "a benchmark must print figures"


def replace(module: ModuleType, name: str, value: object) -> None:
    """Replace a constant of a module.

    Raises:
        AttributeError: The module has no such constant.
    """
    getattr(module, name)
    setattr(module, name, value)


def _one_link(module: ModuleType, folder: Path) -> None:
    """Reduce `cosim_vs_ns3` to two measurements of a single link."""
    del folder
    replace(module, "DISTANCES_M", {("g54", False): (10,)})
    replace(module, "SECONDS", 0.2)
    replace(module, "BATCH", 2)
    replace(module, "MAX_RUNS", 2)


def _few_losses(module: ModuleType, folder: Path) -> None:
    """Reduce `tcp_vs_ns3` to one loss pattern and one loss probability."""
    del folder
    replace(module, "PATTERNS", {"1 packet": module.PATTERNS["1 packet"]})
    replace(module, "RANDOM_LOSSES", {"2 % of data": (0.02, 0.0, 1.0)})


def _failing_iw(module: ModuleType, folder: Path) -> None:
    """Provide a program `iw` that fails, for `telemetry` on machines without `iw`."""
    del module
    script = folder / "iw"
    script.write_text("#!/bin/sh\nexit 1\n", encoding="ascii")
    script.chmod(0o755)
    os.environ["PATH"] += f":{folder}"


def _two_commands(module: ModuleType, folder: Path) -> None:
    del folder
    replace(module, "COMMANDS", {name: module.COMMANDS[name] for name in ("--version", "columns")})


def _two_bridge_paths(module: ModuleType, folder: Path) -> None:
    del folder
    replace(
        module, "PATHS", tuple(path for path in module.PATHS if path.name in {"ros1 plain", "ros1 bridged to dds"})
    )


def _slow_iperf(module: ModuleType, folder: Path) -> None:
    """Limit the rate of iperf3, which would otherwise load all cores."""
    del folder
    unlimited_iperf = module.iperf
    replace(module, "iperf", lambda client, seconds, *options: unlimited_iperf(client, seconds, *options, "-b", "5M"))


def _small_swarm(module: ModuleType, folder: Path) -> None:
    _slow_iperf(module, folder)
    _one_radio(module, folder)
    replace(module, "ALL_SENDERS_PACKETS_S", dict.fromkeys(module.ALL_SENDERS_PACKETS_S, 500))
    replace(module, "ONE_SENDER_PACKETS_S", 500)


def _one_radio(module: ModuleType, folder: Path) -> None:
    del folder
    replace(module, "RADIOS", dict(list(module.RADIOS.items())[:1]))


def _one_layer(module: ModuleType, folder: Path) -> None:
    del folder
    replace(module, "LAYERS", module.LAYERS[-1:])


def _one_setting(module: ModuleType, folder: Path) -> None:
    """Reduce `zenoh_images` to one pair of each kind in a lab of two robots."""
    lab = folder / "small-lab"
    lab.mkdir()
    text = (module.LAB / "fieldkit.yaml").read_text(encoding="utf-8")
    site_lines = [
        line for line in text.splitlines() if not line.lstrip().startswith(("rover-2", "rover-3", "rover-4"))
    ]
    small = replace_text("\n".join(site_lines) + "\n", ", rover2: rover-2, rover3: rover-3, rover4: rover-4", "")
    (lab / "fieldkit.yaml").write_text(small, encoding="utf-8")
    replace(module, "LAB", lab)
    replace(module, "SUBSCRIBER", ("base", "10.42.0.2"))
    replace(module, "SETTINGS", module.SETTINGS[:2])


def _one_trial(module: ModuleType, folder: Path) -> None:
    """Reduce `field_shape` to one trial with one repeat of each protocol."""
    lab = folder / "lawn"
    shutil.copytree(module.LAB, lab)
    path = lab / "masterless-los.yaml"
    text = path.read_text(encoding="utf-8")
    path.write_text(
        replace_text(text, "[10ft, 20ft, 30ft, 55ft]", "[10ft]", "record: 2s", "record: 1s"), encoding="utf-8"
    )
    replace(module, "CAMPAIGNS", ("masterless-los",))
    replace(module, "LAB", lab)


_STREAM: Final = """\
name: middleware_dds
summary: One short stream
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
steps:
  - capture:
      name: default_tuned_100
      during:
        - together:
            during:
              - topics:
                  name: default_tuned_100
                  from: sender
                  to: receiver
                  over: dds
                  rate: 10Hz
                  bytes: 100B
                  duration: 1s
                  qos: {profile: default}
                  settings: tuned
              - ping: {name: default_tuned_100, from: sender, to: receiver, count: 10, interval: 100ms}
"""


def _one_stream(module: ModuleType, folder: Path) -> None:
    """Reduce `middleware` to one short stream between two robots."""
    lab = folder / "small-lab"
    (lab / "procedures").mkdir(parents=True)
    text = (module.LAB / "fieldkit.yaml").read_text(encoding="utf-8")
    site_lines = [
        line for line in text.splitlines() if not line.lstrip().startswith(("rover-2", "rover-3", "rover-4"))
    ]
    small = replace_text(
        "\n".join(site_lines) + "\n",
        ", rover2: rover-2, rover3: rover-3, rover4: rover-4",
        "",
        "ros: debian",
        "ros: builtin",
    )
    (lab / "fieldkit.yaml").write_text(small, encoding="utf-8")
    campaign = (module.LAB / "dds.yaml").read_text(encoding="utf-8")
    (lab / "dds.yaml").write_text(replace_text(campaign, "[20m, 40m, 60m, 80m]", "[20m]"), encoding="utf-8")
    (folder / "lab" / "procedures").mkdir(parents=True)
    (folder / "lab" / "procedures" / "middleware_dds.yaml").write_text(_STREAM, encoding="utf-8")
    replace(module, "LAB", lab)
    replace(module, "CAMPAIGNS", ("dds",))


_ROW: Final = """\
name: mesh_small
summary: Three robots in a row, one of which is disconnected for a second
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
places:
  first: {near: sender, towards: 60m}
steps:
  - wait: {duration: 10s}
  - fault:
      name: lost
      robot: first
      kind: link-down
      for: 1s
      after: 1s
      during:
        - ping: {from: sender, to: receiver, count: 100, interval: 100ms, payload_bytes: 56, gap: true}
"""


def _short_row(module: ModuleType, folder: Path) -> None:
    """Reduce `mesh` to the loss of one of three robots for a second."""
    source = folder / "mesh"
    source.mkdir()
    shutil.copy(ROOT / "benchmarks" / "studies" / "mesh" / "box.yaml", source)
    (source / "mesh_small.yaml").write_text(_ROW, encoding="utf-8")
    replace(module, "HERE", folder)
    replace(module, "HELLOS_S", (1,))
    replace(module, "LAYOUTS", {"row": module.Layout("row of three", "mesh_small", "120m", ("first",))})
    site_lines = [line for line in module.SITE.splitlines() if not line.strip().startswith(("r4", "r5", "r6", "r7"))]
    replace(module, "SITE", "\n".join(site_lines) + "\n")


def _short_detour(module: ModuleType, folder: Path) -> None:
    """Reduce `mesh_losses` to the loss of one of four robots."""
    del folder
    places = {"sender": (0, 0), "first": (60, -35), "left": (60, 35), "receiver": (120, 0)}
    detour = module.Detour("paths of two and two hops", places, ("first", "left"), fading=False)
    replace(module, "DETOURS", (detour,))
    replace(module, "SETTLE_S", 2.0)


CASES: Final[Mapping[str, MinimalRun]] = {
    "aggregate": MinimalRun("--rounds 1 --tables 1 --rows 80"),
    "archive": MinimalRun("--rounds 1 --trials 20 --repeats 2", {"AGE_S": 2.5}),
    "bridge": MinimalRun(
        "--rounds 1", {"COUNT": 10, "BURST_S": 0.1, "SETTLING_S": 0.5}, shrink=_two_bridge_paths, emulated=True
    ),
    "studies.combinations": MinimalRun(
        "run FOLDER/rows.csv --physics builtin --network builtin --policy scheduled --seeds 2 --duration 300ms"
    ),
    "cosim_discovery": MinimalRun("", {"COUNT": 3, "SEEDS": (1,), "ROWS": ((0.0, None), (0.1, "g6"))}),
    "cosim_exchange": MinimalRun("", {"COUNTS": (3,), "ROUNDS": 1, "EXCHANGES": 5, "STEPS": 5, "PEER_ROUNDS": 1}),
    "cosim_speed": MinimalRun("--rounds 1 --seconds 0.2 --robots 2 --scenarios convoy --mujoco 3"),
    "cosim_speed_ns3": MinimalRun("--rounds 1 --seconds 0.1 --robots 2"),
    "cosim_vs_ns3": MinimalRun("", shrink=_one_link),
    "emane": MinimalRun("--rounds 1", {"ROBOTS": 2, "PINGS": 3}, shrink=_one_radio, emulated=True),
    "studies.field_shape": MinimalRun("--out FOLDER/lab --repeats 1", shrink=_one_trial, emulated=True),
    "high_throughput_vs_ns3": MinimalRun(
        "",
        {
            "WIDTHS_MHZ": {"HT": (40,)},
            "STREAMS": (1,),
            "RATIOS_DB": (40.0,),
            "STATIONS": (2,),
            "AMSDU_STATIONS": (1,),
            "DSCPS": {"voice": 48},
            "QUEUED": 150,
            "SECONDS": 0.1,
            "SEEDS": (1,),
        },
    ),
    "layers": MinimalRun("--rounds 1 --packets 20", {"PINGS": 5, "STATIONS": (2,)}, shrink=_one_layer, emulated=True),
    "ledger": MinimalRun("--repeats 3"),
    "medium": MinimalRun("--rounds 1 --seconds 1 --probes 20", shrink=_slow_iperf, emulated=True),
    "medium_cost": MinimalRun(". --rounds 1 --seconds 0.3", emulated=True),
    "studies.mesh": MinimalRun("--out FOLDER/lab --repeats 1", shrink=_short_row, emulated=True),
    "studies.mesh_losses": MinimalRun("--losses 1", shrink=_short_detour, emulated=True),
    "studies.middleware": MinimalRun(
        "--out FOLDER/lab --only dds --repeats 1 --table FOLDER/table.csv", shrink=_one_stream, emulated=True
    ),
    "minstrel_vs_kernel": MinimalRun("", {"SEEDS": 1}),
    "moves": MinimalRun("--sizes 2", {"STEPS": 10, "WORLDS": ("lawn",)}, emulated=True),
    "pcap": MinimalRun("--rounds 1", {"PACKETS": 6_000, "SCAPY_PACKETS": 100, "BIG_BYTES": 100_000_000}),
    "radio_vs_ns3": MinimalRun("", {"DISTANCES_M": (5,), "STATIONS": (1,), "PAIR_RATIOS_DB": (8.0,), "SECONDS": 0.1}),
    "roaming_vs_kernel": MinimalRun("", {"RUNS": 1, "PACKETS": 5}),
    "startup": MinimalRun("--rounds 1", shrink=_two_commands),
    "stop": MinimalRun("--rounds 1", emulated=True),
    "swarm": MinimalRun("--sizes 2 --seconds 1", {"PINGS": 5}, shrink=_small_swarm, emulated=True),
    "tcp_vs_kernel": MinimalRun("--runs 2 --seconds 1 --together 1 --loss 1% --delay 5ms", emulated=True),
    "tcp_vs_ns3": MinimalRun("", {"SECONDS": 1.0, "SEEDS": 2}, shrink=_few_losses),
    "telemetry": MinimalRun("--seconds 0.5", {"SLOWER": (1,)}, shrink=_failing_iw),
    "topics": MinimalRun("--rounds 1", {"PLAIN": {"zenoh": ("plain", "attached")}, "STREAM_S": 1.0, "BURST_S": 0.1}),
    "trial_overhead": MinimalRun("--rounds 1 --record 1s --round-trips 0s", emulated=True),
    "sweep": MinimalRun("--rounds 1 --seeds 1 --tasks 8 --duration 100ms", {"COUNTS": (1,), "PROCESSES": 1}),
    "studies.real_links": MinimalRun("--links 1"),
    "studies.zenoh_images": MinimalRun(
        "--rounds 1", {"SAMPLES": 2, "BYTES": 10_000}, shrink=_one_setting, emulated=True
    ),
}
"""The minimal run of each benchmark that the tests run."""


def main() -> int:
    """Run a benchmark with its minimal configuration; return its exit code."""
    name, folder = sys.argv[1], Path(sys.argv[2]).resolve()
    case = CASES[name]
    module = import_module(f"benchmarks.{name}")
    for constant, value in case.constants.items():
        replace(module, constant, value)
    case.shrink(module, folder)
    sys.argv = [f"benchmarks.{name}", *case.arguments.replace("FOLDER", str(folder)).split()]
    return module.main() or 0


if __name__ == "__main__":
    sys.exit(main())
