"""The step `track`: valid keys, recordings of each robot, and stored sources of positions."""

import math
from dataclasses import replace

import pytest

from fieldkit.cli.dry_run import shell_line
from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Placement, Protocol, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.measure.positions.position_sources import PositionSource
from fieldkit.measure.positions.samples import WGS84
from fieldkit.measure.robot_clock import Offset
from fieldkit.ros.steps.track import TrackStep
from fieldkit.steps.scene import Scene
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST

PLACED = Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("10m"))
SCENE = replace(Scene(Protocol.UDP, CAST, "f"), placement=PLACED)
PING = "{ping: {from: sender, to: receiver}}"
MOVE = f"{{move: {{robot: sender, path: [away: 1m], speed: 0.1m/s, during: [{PING}]}}}}"


def track(robots: str, during: str = PING) -> TrackStep:
    return schema.validate(schema.parse(f"{{robots: {robots}, during: [{during}]}}", source="x.yaml"), TrackStep)


@pytest.mark.parametrize(
    ("robots", "message"),
    [
        ("{}", "at least 1 item"),
        ("{sender: {}}", "a robot needs either topic or at"),
        ("{sender: {topic: /odom, at: {lat: 1, lon: 2}}}", "a robot needs either topic or at"),
        ("{sender: {topic: odom}}", "'odom' is not the name of a topic"),
        ("{sender: {topic: /odom, facing: north}}", "away.*towards"),
        ("{sender: {topic: /odom, gap: 3}}", "has no unit"),
        ("{sender: {topic: /odom, gap: 0s}}", "greater than 0"),
        ("{sender: {at: {}}}", "a position needs lat and lon, or frame, x and y"),
        ("{sender: {at: {lat: 1}}}", "a position needs lat and lon, or frame, x and y"),
        ("{sender: {at: {lat: 91, lon: 0}}}", "less than or equal to 90"),
        ("{sender: {at: {x: 1, y: 2}}}", "a position needs lat and lon, or frame, x and y"),
        ("{sender: {at: {frame: map, x: 1}}}", "a position needs lat and lon, or frame, x and y"),
        ("{sender: {at: {frame: map, x: 1, y: 2, lat: 1, lon: 2}}}", "not both"),
    ],
)
def test_invalid_keys_are_rejected(robots: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        track(robots)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ("[{TRACK}, {TRACK}]", "a repeat can have only one track"),
        ("[{{move: {{robot: sender, path: [away: 1m], speed: 1m/s, during: [{TRACK}]}}}}]", "put the move into"),
        ("[{{fault: {{robot: sender, kind: reboot, during: [{TRACK}]}}}}]", "put that step into the track"),
        ("[{{together: {{during: [{TRACK}, {WAIT}]}}}}]", "put that step into the track"),
    ],
)
def test_invalid_place_in_the_procedure_is_rejected(steps: str, message: str) -> None:
    track_step = f"{{track: {{robots: {{sender: {{topic: /odom, facing: away}}}}, during: [{PING}]}}}}"
    text = "name: x\nsummary: x\nscenario: los\ntopology: masterless\nprotocols: [udp]\nrepeats: 1\nsteps: "
    procedure = text + steps.format(TRACK=track_step, WAIT="{wait: {duration: 1s}}")
    with pytest.raises(ConfigurationError, match=message):
        schema.validate(schema.parse(procedure, source="x.yaml"), Procedure)


def test_each_robot_records_its_topics_until_the_step_ends() -> None:
    step = track("{sender: {topic: /odom, facing: away}, receiver: {at: {lat: 48.1, lon: 11.5}}}")
    recording, _ = step.jobs(SCENE)
    assert (recording.role, recording.program) == (Role.SENDER, "rosbag")
    assert shell_line(recording.job).endswith(
        "rosbag record --duration=914 -O track_sender /odom 2> track_sender.sender-record.log"
    )
    assert recording.job.limit_s > 900
    assert step.live_topics(Role.SENDER) == ("/odom",)
    assert step.live_topics(Role.RECEIVER) == ()
    assert step.stored_bytes(SCENE, Role.SENDER) > 10_000
    assert step.stored_bytes(SCENE, Role.RECEIVER) == 0
    assert {"positions.json", "track_sender.bag"} <= set(step.files())


def test_odometry_needs_facing() -> None:
    (refusal,) = track("{sender: {topic: /odom}}").refusals(SCENE)
    assert "facing: away, towards, left or right" in refusal.remedy
    assert not list(track("{sender: {topic: /odom, facing: left}}").refusals(SCENE))


def sources_of(step: TrackStep) -> dict[Role, PositionSource]:
    stored = step._position_sources(SCENE, 7, {Role.SENDER: Offset(0.5, 0.1)})
    assert stored.clocks == {Role.SENDER: Offset(0.5, 0.1)}
    return dict(stored.robots)


@pytest.mark.parametrize(
    ("role", "facing", "heading_rad"),
    [
        (Role.RECEIVER, "away", 0),
        (Role.RECEIVER, "left", math.pi / 2),
        (Role.SENDER, "away", math.pi),
        (Role.SENDER, "towards", 2 * math.pi),
        (Role.SENDER, "right", math.pi / 2),
    ],
)
def test_stored_source_has_start_and_heading(role: Role, facing: str, heading_rad: float) -> None:
    sources = sources_of(track(f"{{{role}: {{topic: /odom, facing: {facing}, gap: 1s, times: received}}}}"))
    place_m = {Role.SENDER: (0.0, 0.0, 0.0), Role.RECEIVER: (10.0, 0.0, 0.0)}
    (other,) = {Role.SENDER, Role.RECEIVER} - {role}
    assert sources[other] == PositionSource(place=place_m[other])
    stored_rad = sources[role].heading_rad
    assert stored_rad == pytest.approx(heading_rad)
    assert sources[role] == PositionSource(
        file=f"track_{role}.bag",
        topic="/odom",
        stamps="received",
        gap_s=1.0,
        start=place_m[role],
        heading_rad=stored_rad,
        began_utc_ns=7,
    )


@pytest.mark.motion
def test_a_moving_robot_without_a_source_has_no_position_and_a_fixed_position_is_stored() -> None:
    sources = sources_of(track("{receiver: {at: {lat: 48.1, lon: 11}}}", MOVE))
    assert sources == {Role.RECEIVER: PositionSource(place=(48.1, 11.0, None), frame=WGS84)}
    fixed_track = track("{receiver: {at: {frame: map, x: 1, y: 2.5}}}")
    assert sources_of(fixed_track)[Role.RECEIVER] == PositionSource(place=(1.0, 2.5, 0.0), frame="frame map")
