"""Fuzz targets: readers of the outputs of radios and programs during a repeat, and of paths and expressions."""

import gzip
import json
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Measured, cell_text
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import LinkSample, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import radiotap
from fieldkit.measure.checks import monitor_checks, monitor_columns
from fieldkit.measure.evidence import link, link_samples, program_output, robot_link_samples
from fieldkit.measure.robot_state import attempt_states, interfaces, state_columns
from tests.fuzz.harness import Target
from tests.helpers.paths import DATA

_IW: Final = DATA / "iw"
_MESH_TRIAL: Final = DATA / "hwsim/6.1.176/mesh-trial"
_CLOCK: Final = "==> clock <==\n100.00 1700000100.000000000 100.00\n==> iw station dump <==\n"
_SAMPLES_TEXT: Final = "".join(
    f"==> 101.{at:02d} {name} <==\n{path.read_text(encoding='utf-8')}"
    for name, pattern in (("link", "link-*"), ("survey", "survey-*"), ("station", "station*"), ("wireless", "wire*"))
    for at, path in enumerate(sorted(_IW.glob(f"{pattern}.txt")))
)
_WIRELESS: Final = "0000   54.  -56.  -256        0      0      0      0      0        0"
_PATHS: Final = (
    *(b"[0].a[1].b", b"end.sum.bits_per_second", b"*.*[] | [0]"),
    b"max_by(intervals, &sum.seconds).sum.bytes",
)
_EXPRESSIONS: Final = (b"rtt = ([0-9.]+) ms", b"^(\\S+) +dB$", b"(?i)(?:loss|lost)[: ]+([0-9]{1,3})%", b"(a+)+$")
_PROGRAM_OUTPUT: Final = {
    "end": {"sum": {"bits_per_second": 5e6}},
    "intervals": [{"sum": {"seconds": 1, "bytes": 12}}],
}


def _measure(samples: list[LinkSample]) -> None:
    """Measure a link; all values must be valid in the table."""
    measured = link.measure(Role.SENDER, samples)
    link.link_history(samples)
    for column in link.COLUMNS:
        assert column.invalid_value_reason(cell_text(measured.values.get(column.name))) is None, column.name


def _read_testbed_samples(data: bytes, place: Path) -> None:
    (place / link_samples.FILE).write_bytes(data)
    for samples in link_samples.read(place / link_samples.FILE).values():
        _measure(list(samples))


def _read_robot_samples(name: str, data: bytes, place: Path) -> None:
    """Read the link samples that a robot recorded, with one mutated file and the others intact."""
    (place / "sender-before.txt").write_text(_CLOCK, encoding="utf-8")
    if "link" not in name:
        (place / "sender-link.txt").write_text(_SAMPLES_TEXT, encoding="utf-8")
    (place / name).write_bytes(data)
    _measure(list(robot_link_samples.read(place, Role.SENDER)))


def _read_radio_frames(data: bytes, place: Path) -> None:
    """Measure a mutated capture on a monitor interface, and compare it with an intact one and with link samples."""
    (place / "sender-monitor.pcap").write_bytes(data)
    frames = radiotap.read(place / "sender-monitor.pcap").frames
    measured = monitor_columns.measure(Role.SENDER, frames)
    for column in monitor_columns.COLUMNS_BY_ROLE[Role.SENDER]:
        assert column.invalid_value_reason(cell_text(measured.values.get(column.name))) is None, column.name
    evidence = AttemptEvidence(_MESH_TRIAL)
    list(monitor_checks.link_contradictions(frames, evidence.links(Role.SENDER)))
    other_frames = radiotap.read(_MESH_TRIAL / "receiver-monitor.pcap").frames
    list(monitor_checks.peer_contradictions(frames, other_frames))
    list(monitor_checks.peer_contradictions(other_frames, frames))


def _parse_iw(data: bytes, _: Path) -> None:
    text = data.decode(errors="replace")
    robot_link_samples.parse_stations(text)
    robot_link_samples.parse_cell(text)
    robot_link_samples.parse_channel(text)
    for line in text.split("\n"):
        robot_link_samples.parse_wireless(line)


def _evaluate_path(data: bytes, place: Path) -> None:
    """Evaluate a path of any length, as in a procedure."""
    path_text = data.decode(errors="replace")
    (place / "run.txt").write_text(json.dumps(_PROGRAM_OUTPUT), encoding="ascii")
    if program_output.path_error(path_text) is None:
        with suppress(EvidenceError):
            program_output.at_path(place / "run.txt", path_text)


def _match_expression(data: bytes, place: Path) -> None:
    expression = data.decode(errors="replace")
    (place / "run.txt").write_text("rtt = 12.5 ms\nloss: 3%\n" + "a" * 5000 + "b\n", encoding="ascii")
    if program_output.expression_error(expression) is None:
        program_output.by_expression(place / "run.txt", expression)


def _measure_states(data: bytes, place: Path) -> None:
    """Measure an attempt with mutated snapshots; all values must be valid in the table."""
    for when in ("before", "after"):
        (place / f"sender-sources-{when}.txt").write_bytes(data)
    (place / "sender-sources-during.txt").write_bytes(b"==> next <==\n" + data + b"==> next <==\n" + data[::2])
    evidence, names = AttemptEvidence(place), {Role.SENDER: "rover"}
    measured = attempt_states.measure(evidence, names, Measured())
    list(attempt_states.problems(evidence, names, {}))
    interfaces.read_indices(evidence, Role.SENDER)
    for column in (*state_columns.MARK_COLUMNS, *state_columns.declare_columns("sender")):
        assert column.invalid_value_reason(cell_text(measured.values.get(column.name))) is None, column.name


def _snapshot(**paths: str) -> bytes:
    """A snapshot with stored outputs; the names are those of the sources, with `_` for `-`."""
    text = ""
    for name, path in paths.items():
        lines = (DATA / path).read_text(encoding="utf-8").split("\n")
        text += f"==> {name.replace('_', '-')} <==\n" + "".join(f" {line}\n" for line in (*lines, "code 0"))
    return text.encode()


def radio_targets() -> Iterator[Target]:
    """Yield the targets."""
    samples = robot_link_samples.parse(_SAMPLES_TEXT)
    testbeds = link_samples.text({Role.SENDER: samples, Role.RECEIVER: samples[:3]}).encode()
    yield Target("link-csv", (testbeds,), _read_testbed_samples)
    states = (_CLOCK + (_IW / "station-iwlwifi-6.txt").read_text(encoding="utf-8")).encode()
    for name, seed in (
        ("sender-link.txt", _SAMPLES_TEXT.encode()),
        ("sender-link.txt.gz", gzip.compress(_SAMPLES_TEXT.encode(), mtime=0)),
        ("sender-before.txt", states),
    ):
        yield Target(f"own-{name}".replace(".", "_"), (seed,), partial(_read_robot_samples, name))
    outputs = (*sorted(path.read_bytes() for path in _IW.glob("*.txt")), _WIRELESS.encode())
    yield Target("radiotap", ((_MESH_TRIAL / "sender-monitor.pcap").read_bytes(),), _read_radio_frames)
    yield Target("telemetry", outputs, _parse_iw)
    snapshots = (
        _snapshot(chrony="chrony/slow-2023.txt", ptp="linuxptp/current-1.2.txt"),
        _snapshot(chrony="chrony/synchronized-4.3.csv", timesyncd="timedatectl/status-245.txt"),
        _snapshot(iw_info="iw/info-hwsim-station-6.txt", iw_scan="iw/scan-hwsim-5.txt", iw_reg="iw/reg-balena.txt"),
        b"==> health <==\n cpu  1 0 5 8 5 0 0 0 0 0\n temperature 48312\n battery 80 12300000\n disk 9\n code 0\n",
        b"==> vcgencmd <==\n throttled=0x50005\n code 0\n==> interfaces <==\n 7: wlan0@if6: <UP>\n code 0\n",
    )
    yield Target("robot-state", snapshots, _measure_states)
    yield Target("json-path", _PATHS, _evaluate_path)
    yield Target("expression", _EXPRESSIONS, _match_expression)
