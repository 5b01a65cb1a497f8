"""Fuzz targets: readers of positions, drive logs, flight data and responses to preflight queries."""

import json
import math
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from fieldkit.config import schema
from fieldkit.core.columns import cell_text
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.core.prompts import Question
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import ping
from fieldkit.measure.positions import position_columns, position_files, position_sources, recorded_positions
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.positions.samples import LOCAL, WGS84, Samples
from fieldkit.measure.robot_clock import Offset
from fieldkit.motion.logs import drive_log
from fieldkit.motion.profile_sections import mavlink_of
from fieldkit.motion.steps.drive_lease import DriveLease
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.ros.bags import recorded_topics
from fieldkit.steps.capabilities import HasNeeds
from fieldkit.steps.kinds import ask
from fieldkit.steps.scene import CommandResult
from fieldkit.trial.check.report import Report
from fieldkit.trial.procedure import Procedure
from tests.fuzz.harness import Target
from tests.helpers.casts import CAST, los_plan
from tests.motion.logs.test_drive_log import drive
from tests.ros.bags.test_bag_positions import BEGAN_NS, S, fix, odometry, transform, write_bag
from tests.ros.bags.test_recorded_topics import ROS2, log, write

_ENDS: Final = (Role.SENDER, Role.RECEIVER)
_JOB: Final = Job(folder="f", name="drive", argv=(), limit_s=1.0, log="drive.log")
_STATUS: Final = b'{"phase": "back", "x_m": 0.1, "left_m": 1.5, "ended": "no odometry for 0.5 s"}'
_ARMING: Final = (
    b'{"what": "its battery has 10%", "remedy": "charge it", "grave": true}\n{"autopilot": "PX4", "charge": 0.1}\n',
    b"rmw_cyclonedds_cpp\n",
    b"HTTP/1.0 200 OK\n",
    b"babeld\nbatman-adv\n",
    b"5000000\n",
)
_DEMANDING_PROCEDURE: Final = """\
name: needy
summary: Steps that ask robots for more than programs
scenario: los
topology: master
protocols: [tcp]
repeats: 1
steps:
  - record: {robot: sender, topics: [/scan], duration: 1s}
  - fly:
      robot: ROLE
      height: 1m
      during: [capture: {during: [send: {from: sender, to: receiver, size: 5MB, file: x}, {ping: PING}]}]
  - topics: {from: sender, to: receiver, over: ros2}
""".replace("PING", "{from: sender, to: receiver, forwarded: true}")
_CSV: Final = b"t,x_m,y_m\n2026-11-22T12:00:00Z,0,0\n2026-11-22T12:00:02.5Z,1.5,-2\n2026-11-22T12:00:05Z,3,-2\n"
_CSV_DEGREES: Final = b"t_ns,lat,lon,alt_m\n1795348800000000000,48.1,11.5,520\n1795348801000000000,48.2,11.6,521\n"
_GPX: Final = b"""<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="x" xmlns="http://www.topografix.com/GPX/1/1"><trk><name>walk</name><trkseg>
<trkpt lat="48.1374" lon="11.5755"><ele>520.1</ele><time>2026-11-22T12:00:00Z</time></trkpt>
<trkpt lat="48.1375" lon="11.5756"><time>2026-11-22T12:00:02.250Z</time></trkpt>
<trkpt lat="48.1375" lon="11.5757"><time>2026-11-22T12:00:04.5Z</time></trkpt>
</trkseg></trk></gpx>
"""


def _measure_drive(data: bytes, place: Path) -> None:
    (place / drive_log.FILE).write_bytes(data)
    measured = drive_log.measure(drive_log.read(place / drive_log.FILE))
    for column in drive_log.COLUMNS:
        assert column.invalid_value_reason(cell_text(measured.values.get(column.name))) is None, column.name


def _read_drive_status(data: bytes, _: Path) -> None:
    lease = DriveLease(cast("Shell", None), _JOB, "{}", 1.0)
    lease.output = data
    assert lease.final_state.isprintable()


def _read_answer(data: bytes, place: Path) -> None:
    path = place / "answer-wind.txt"
    path.write_bytes(data)
    questions = (Question("how strong is the wind", unit="m/s"), Question("how is it", choices=("a", "b")))
    for question in questions:
        with suppress(EvidenceError):
            assert ask._read(path, question).isprintable()


@cache
def _demanding_procedure() -> Procedure:
    """Return a procedure whose steps have all kinds of requirements."""
    drone = next(role for role, robot in CAST.items() if mavlink_of(robot.profile) is not None)
    return schema.validate(schema.parse(_DEMANDING_PROCEDURE.replace("ROLE", drone), source="needy.yaml"), Procedure)


def _judge_needs(data: bytes, _: Path) -> None:
    """Judge all preflight queries with the same response."""
    overrides = {"abilities": frozenset({"mavlink"}), "ros_master": CAST[Role.RELAY].address}
    demanding_cast = {role: robot.model_copy(update=overrides) for role, robot in CAST.items()}
    scene = replace(los_plan().scenes()[0], cast=demanding_cast)
    report, text = Report("robot"), data.decode(errors="replace")
    for placed in _demanding_procedure().walk():
        for need in placed.step.needs(scene) if isinstance(placed.step, HasNeeds) else ():
            for code in (0, 1, CommandResult.MISSING):
                report.add(need.name, *need.judge(CommandResult(text, code)))
    assert all(finding.detail.isprintable() and finding.remedy.isprintable() for finding in report.findings)


def _sources_text(sender: PositionSource, receiver: PositionSource) -> bytes:
    clocks = {Role.SENDER: Offset(0.2, 0.01), Role.RECEIVER: Offset(-0.2, 0.01)}
    return position_sources.text(PositionSources({Role.SENDER: sender, Role.RECEIVER: receiver}, clocks)).encode()


@cache
def _tracks() -> dict[str, bytes]:
    """Return bags with the positions of a robot, by the kind of message."""
    messages_by_kind = {
        "odometry": [odometry(BEGAN_NS + n * S, float(n), 0.0, 0.1 * n) for n in range(9)],
        "fix": [fix(BEGAN_NS + n * S, 48 + n / 1e5, 11.0) for n in range(9)],
        "transform": [transform(BEGAN_NS + n * S, float(n), 0.0, "base") for n in range(9)],
    }
    bags = {}
    for name, messages in messages_by_kind.items():
        with tempfile.TemporaryDirectory() as folder:
            bags[name] = write_bag(Path(folder), messages).read_bytes()
    return bags


def _check_samples(samples: Samples) -> None:
    assert len(samples.times_ns) == len(samples.values) > 0
    assert (np.diff(samples.times_ns) > 0).all()
    assert np.isfinite(samples.values[:, :2]).all()


def _read_bag(data: bytes, place: Path) -> None:
    path = place / "track.bag"
    path.write_bytes(data)
    for stamps in ("header", "received"):
        position_source = PositionSource(topic="/where", stamps=stamps, heading_rad=1.0, began_utc_ns=BEGAN_NS + S)
        with suppress(EvidenceError):
            samples = position_files.read_topic(path, position_source)
            _check_samples(samples)
            if samples.yaws_rad is not None:
                _check_samples(position_files.to_placement_frame(samples, position_source))


def _read_positions_file(suffix: str, data: bytes, place: Path) -> None:
    path = place / f"walk.{suffix}"
    path.write_bytes(data)
    _check_samples(position_files.read_file(path))


def _measure_positions(of_trial: bool, data: bytes, place: Path) -> None:
    """Measure the distance of two robots with mutated position sources, of an attempt or of its trial."""
    attempt = place / "repeats" / "udp-01"
    attempt.mkdir(parents=True)
    (attempt / "track.bag").write_bytes(_tracks()["odometry"])
    (place / "positions-receiver.gpx").write_bytes(_GPX)
    (place / "positions-receiver.csv").write_bytes(_CSV)
    folder = place if of_trial else attempt
    (folder / position_sources.FILE).write_bytes(data)
    evidence = AttemptEvidence(attempt)
    times_ns = [BEGAN_NS + S, BEGAN_NS + 3 * S]
    measured = position_columns.measure(evidence, ping.MOTION_COLUMNS, _ENDS, times_ns)
    assert all(math.isfinite(float(value)) for value in measured.values.values())  # gates reject excessive distances
    position_columns.distances_m(evidence, _ENDS)
    recorded_positions.readable_samples(evidence)
    sources = position_sources.read(folder / position_sources.FILE)
    (place / "again.json").write_text(position_sources.text(sources), encoding="utf-8")
    assert position_sources.read(place / "again.json") == sources
    recorded_positions.sources_text(evidence)
    assert math.isfinite(recorded_positions.clock_error_s(evidence) or 0.0)


def _position_sources() -> tuple[bytes, ...]:
    odometry_source = PositionSource(file="track.bag", topic="/where", heading_rad=0.0, began_utc_ns=BEGAN_NS + S)
    stationary = PositionSource(place=(0.0, 0.0, 0.2))
    degrees = PositionSource(place=(48.1, 11.5, None), frame=WGS84)
    metres = PositionSource(place=(0.0, 0.0, 0.0), frame=LOCAL)
    return (
        _sources_text(stationary, odometry_source),
        _sources_text(degrees, PositionSource(file="positions-receiver.gpx", offset_s=0.5)),
        _sources_text(metres, PositionSource(file="positions-receiver.csv")),
    )


@cache
def _recorded_bag() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), "", {"/scan": [BEGAN_NS + n * S for n in range(5)]})
        return Path(folder, "scan.bag").read_bytes()


def _read_reception(data: bytes, place: Path) -> None:
    """Measure the reception of topics with a mutated log and an intact bag."""
    (place / "log").write_bytes(data)
    (place / "scan.bag").write_bytes(_recorded_bag())
    measured = recorded_topics.measure(recorded_topics.read(place, "log", "scan.bag", ["/scan"], 5.0))
    for column in recorded_topics.COLUMNS:
        assert column.invalid_value_reason(cell_text(measured.values.get(column.name))) is None, column.name


def _lines(lines: Iterator[dict[str, Any]]) -> bytes:
    return "".join(f"{json.dumps(line)}\n" for line in lines).encode()


def motion_targets() -> Iterator[Target]:
    """Yield the targets."""
    yield Target("drive-log", (_lines(drive(4.0, 0.5, 1.0)), _lines(drive(0.3, 0.1, 1.0))), _measure_drive)
    yield Target("drive-status", (_STATUS, b'{"phase": "out", "ended": ""}'), _read_drive_status)
    yield Target("needs", _ARMING, _judge_needs)
    yield Target("answer", (b"3.5\n", b"-\n", b"a\n"), _read_answer)
    logs = (log({"/scan": BEGAN_NS}), ROS2.format(s=BEGAN_NS // S, ns=BEGAN_NS % S))
    yield Target("reception", tuple(text.encode() for text in logs), _read_reception, 0.5)
    yield Target("positions-csv", (_CSV, _CSV_DEGREES), partial(_read_positions_file, "csv"))
    yield Target("positions-gpx", (_GPX,), partial(_read_positions_file, "gpx"))
    yield Target("positions-bag", tuple(_tracks().values()), _read_bag, 0.3)
    for name, of_trial in (("attempt", False), ("trial", True)):
        yield Target(f"positions-of-{name}", _position_sources(), partial(_measure_positions, of_trial), 0.5)
