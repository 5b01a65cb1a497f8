"""The `mavlink` step: valid keys, jobs of the recorder, and positions and checks from its files."""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as d

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Placement, Protocol, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence.track import Separation
from fieldkit.measure.positions import position_sources, recorded_positions, trajectories
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.positions.samples import WGS84
from fieldkit.measure.robot_clock import Offset
from fieldkit.motion.logs import tlog_reader
from fieldkit.motion.profile_sections import Mavlink
from fieldkit.motion.steps.mavlink import MavlinkStep
from fieldkit.steps.scene import Flow, Scene
from fieldkit.steps.view import View
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST
from tests.helpers.drones import START_US, Sender, beat, flight, stamped

PLACED = Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance("10m"))
PING = "{ping: {from: sender, to: receiver}}"
DRONE = CAST[Role.RECEIVER].model_copy(
    update={"profile": CAST[Role.RECEIVER].profile.model_copy(update={"mavlink": Mavlink(port=14550)})}
)
SCENE = replace(Scene(Protocol.UDP, {**CAST, Role.RECEIVER: DRONE}, "f"), placement=PLACED)
START_NS = START_US * 1000
NO_COUNTERS: dict[str, object] = {}
START_S = 0.1005
"""Start of the nested steps, at the second message of each kind."""


def mavlink(extra_keys: str = "", during: str = PING) -> MavlinkStep:
    text = f"{{robot: receiver, {extra_keys + ', ' if extra_keys else ''}during: [{during}]}}"
    return schema.validate(schema.parse(text, source="x.yaml"), MavlinkStep)


@pytest.mark.parametrize(
    ("extra_keys", "message"),
    [
        ("rates: {ATITUDE: 5Hz}", "no rate can be requested for 'ATITUDE'; possible: SYS_STATUS"),
        ("rates: {ATTITUDE: 5}", "has no unit"),
        ("rates: {ATTITUDE: 0Hz}", "greater than 0"),
        ("positions: local", "facing is required with positions: local"),
        ("positions: global, facing: away", "facing is required with positions: local"),
        ("system: 256", "less than or equal to 255"),
    ],
)
def test_invalid_keys_are_refused(extra_keys: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        mavlink(extra_keys)


def test_robot_without_autopilot_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="has no mavlink"):
        list(mavlink().jobs(replace(SCENE, cast=CAST)))


def role_and_argument(step: MavlinkStep, scene: Scene = SCENE) -> tuple[Role, dict[str, object]]:
    recording, _ = step.jobs(scene)
    return recording.role, json.loads(recording.job.argv[-2])


def test_recorder_runs_on_the_drone_or_on_another_robot() -> None:
    local = {"connection": "udpout:127.0.0.1:14550", "intervals_us": {}, "system": 0}
    assert role_and_argument(mavlink()) == (Role.RECEIVER, local)
    remote = {"connection": f"udpout:{DRONE.address}:14550", "intervals_us": {"30": 50_000}, "system": 7}
    step = mavlink("at: sender, system: 7, rates: {ATTITUDE: 20Hz}")
    assert role_and_argument(step) == (Role.SENDER, remote)
    (flow,) = step.flows(SCENE)
    assert flow == Flow(Role.RECEIVER, Role.SENDER, 14550, flow.frames, Protocol.UDP, has_other_listener=True)
    assert not list(mavlink().flows(SCENE))
    assert step.stored_bytes(SCENE, Role.SENDER) > 1000
    assert step.stored_bytes(SCENE, Role.RECEIVER) == 0


def test_local_recorder_uses_connection_of_profile() -> None:
    profile = DRONE.profile.model_copy(update={"mavlink": Mavlink(port=14550, connection="/dev/ttyAMA0:921600")})
    scene = replace(SCENE, cast={**CAST, Role.RECEIVER: DRONE.model_copy(update={"profile": profile})})
    assert role_and_argument(mavlink(), scene)[1]["connection"] == "/dev/ttyAMA0:921600"
    assert role_and_argument(mavlink("at: sender"), scene)[1]["connection"] == f"udpout:{DRONE.address}:14550"


@pytest.mark.parametrize("connection", ["udp:h:1", "tcp:h", "/etc/passwd:1", "udpout:a b:1", "tcp:$(x):1"])
def test_invalid_connection_is_refused(connection: str) -> None:
    with pytest.raises(ConfigurationError, match="connection"):
        schema.validate(schema.parse(f"{{port: 1, connection: '{connection}'}}", source="x.yaml"), Mavlink)


def test_step_with_positions_must_not_be_nested_in_a_move() -> None:
    head = "name: x\nsummary: x\nscenario: los\ntopology: masterless\nprotocols: [udp]\nrepeats: 1\nsteps: "
    step = f"{{mavlink: {{robot: receiver, positions: local, facing: away, during: [{PING}]}}}}"
    move_steps = f"[move: {{robot: receiver, path: [away: 1m], speed: 1m/s, during: [{step}]}}]"
    with pytest.raises(ConfigurationError, match="put the move into the mavlink"):
        schema.validate(schema.parse(head + move_steps, source="x.yaml"), Procedure)
    without_positions = move_steps.replace("positions: local, facing: away, ", "")
    assert schema.validate(schema.parse(head + without_positions, source="x.yaml"), Procedure)


@pytest.mark.parametrize(
    "steps",
    [
        "[{track: {robots: {sender: {at: {lat: 1, lon: 2}}}, during: [{MAVLINK}]}}]",
        "[{MAVLINK}, {track: {robots: {sender: {at: {lat: 1, lon: 2}}}, during: [{PING}]}}]",
        "[{MAVLINK}, {MAVLINK}]",
    ],
)
def test_a_repeat_has_only_one_step_that_records_positions(steps: str) -> None:
    """Neither a name of the step nor another file name solves the conflict, so the message suggests neither."""
    head = "name: x\nsummary: x\nscenario: los\ntopology: masterless\nprotocols: [udp]\nrepeats: 1\nsteps: "
    step = f"{{mavlink: {{name: m, robot: receiver, positions: global, during: [{PING}]}}}}"
    text = steps.replace("{MAVLINK}", step).replace("{PING}", PING)
    with pytest.raises(ConfigurationError, match="only one step that records positions") as caught:
        schema.validate(schema.parse(head + text, source="x.yaml"), Procedure)
    assert "name" not in caught.value.what


def attempt(
    tmp_path: Path,
    step: MavlinkStep,
    log: bytes,
    clock: Offset | None = None,
    counters: dict[str, object] = NO_COUNTERS,
) -> View:
    """Return an attempt with this log, which has 10 messages per second after `START_US`."""
    sources = step._position_sources(SCENE, START_NS + round(1e9 * START_S), {Role.SENDER: clock} if clock else {})
    (tmp_path / position_sources.FILE).write_text(position_sources.text(sources), encoding="utf-8")
    (tmp_path / "mavlink.tlog").write_bytes(log)
    all_counters = {"frames": 203, "left_out": 0, "ended_us": START_US + 10_000_000, "refused": {}} | counters
    (tmp_path / "mavlink.json").write_text(json.dumps(all_counters), encoding="utf-8")
    return View(SCENE, AttemptEvidence(tmp_path))


def separation(view: View, from_s: float, to_s: float) -> Separation:
    source, destination = recorded_positions.trajectories_of_pair(view.evidence, (Role.SENDER, Role.RECEIVER))
    began_ns = START_NS + round(1e9 * START_S)
    return trajectories.separation_between(
        source, destination, began_ns + round(from_s * 1e9), began_ns + round(to_s * 1e9)
    )


LOCAL = "positions: local, facing: left"


def test_local_frame_is_rotated_into_frame_of_placement(tmp_path: Path) -> None:
    """The drone faces north, which is to the left of the link, and flies ahead from a distance of 10 m."""
    view = attempt(tmp_path, mavlink(LOCAL), flight(10, 1.0))
    assert not list(mavlink(LOCAL).check(view))
    distances = separation(view, 1, 9)
    assert distances.distance_start_m == pytest.approx(math.hypot(10, 1), abs=1e-3)
    assert distances.distance_max_m == pytest.approx(math.hypot(10, 9), abs=1e-3)
    measured = mavlink(LOCAL).measure(view)
    assert measured.values["positions_from"] == "sender as placed, receiver LOCAL_POSITION_NED"
    assert measured.values["mavlink_north_end_m"] == 10


def test_times_use_clock_of_the_recorder(tmp_path: Path) -> None:
    step = mavlink(f"at: sender, {LOCAL}")
    view = attempt(tmp_path, step, flight(10, 1.0), Offset(0.5, 0.001))
    assert recorded_positions.samples_of(view.evidence, Role.RECEIVER).times_ns[0] == START_NS + 500_000 - 500_000_000


def test_delayed_messages_have_the_time_in_their_header(tmp_path: Path) -> None:
    delayed_log = b"".join(
        struct.pack(">Q", frame.at_us + (2_000_000 if frame.at_us > START_US + 5_000_000 else 0)) + frame.data
        for frame in tlog_reader.frames(flight(10, 1.0))
    )
    view_by_header = attempt(tmp_path, mavlink(LOCAL), delayed_log)
    assert separation(view_by_header, 1, 8).distance_max_m == pytest.approx(math.hypot(10, 8), abs=1e-3)
    view_by_reception = attempt(tmp_path, mavlink(f"{LOCAL}, times: received"), delayed_log)
    assert separation(view_by_reception, 1, 8).distance_max_m == pytest.approx(math.hypot(10, 6), abs=1e-3)


def test_distances_of_global_positions_from_a_fixed_position(tmp_path: Path) -> None:
    sender, step = Sender(), mavlink("positions: global, heights: true")
    frames = [(0, sender.frame(beat()))]
    for at_ms in range(0, 10_001, 100):
        north = round(1e7 * at_ms / 1e3 / 110_574.3)  # 1 m/s northwards, in degrees at the equator
        global_position = d.MAVLink_global_position_int_message(at_ms, north, 0, 30_000, 3_000, 100, 0, 0, 0)
        frames.append((at_ms * 1_000, sender.frame(global_position)))
    view = attempt(tmp_path, step, stamped(frames), counters={"frames": 102})
    assert not list(step.check(view))
    fixed = PositionSource(place=(0.0, 0.0, 0.0), frame=WGS84)
    robots = {**position_sources.read(tmp_path / position_sources.FILE).robots, Role.SENDER: fixed}
    (tmp_path / position_sources.FILE).write_text(
        position_sources.text(PositionSources(robots, heights=True)), encoding="utf-8"
    )
    distances = separation(View(SCENE, AttemptEvidence(tmp_path)), 2 - START_S, 8 - START_S)
    assert distances.distance_start_m == pytest.approx(math.hypot(30, 2), abs=0.02)
    assert distances.distance_max_m == pytest.approx(math.hypot(30, 8), abs=0.02)


@pytest.mark.parametrize(
    ("log", "counters", "problem"),
    [
        (flight(10)[:-3], {}, "is truncated"),
        (flight(10), {"frames": 9}, "mavlink.tlog has 203 frames, but its recorder wrote 9"),
        (flight(10), {"left_out": 4}, "lacks 4 received frames"),
        (flight(10), {"refused": {"1": 2}}, "refused the request for SYS_STATUS"),
        (flight(10), {}, "no SYS_STATUS, which was requested"),
        (b"", {"frames": 0}, "no heartbeat from an autopilot"),
    ],
)
def test_incomplete_log_makes_repeat_void(
    log: bytes, counters: dict[str, object], problem: str, tmp_path: Path
) -> None:
    step = mavlink(f"{LOCAL}, rates: {{SYS_STATUS: 1Hz}}")
    problems = list(step.check(attempt(tmp_path, step, log, counters=counters)))
    assert any(problem in text for text in problems), problems


def test_position_sources_of_nested_steps_take_precedence() -> None:
    placed_source, topic, file = (
        PositionSource(place=(0.0, 0.0, 0.0)),
        PositionSource(file="a.bag", topic="/odom"),
        PositionSource(file="b.tlog"),
    )
    inner = PositionSources({Role.SENDER: topic, Role.RECEIVER: placed_source})
    outer = PositionSources(
        {Role.SENDER: placed_source, Role.RECEIVER: file}, {Role.SENDER: Offset(1, 0.1)}, heights=True
    )
    merged = position_sources.merge(inner, outer)
    assert merged.robots == {Role.SENDER: topic, Role.RECEIVER: file}
    assert (merged.clocks, merged.heights) == (outer.clocks, True)
