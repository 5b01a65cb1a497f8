"""The program that flies a drone: its messages compared with pymavlink, its path, and invalid messages."""

import math
from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as d

from fieldkit.agent.autopilots import dialect, mavlink_frames
from fieldkit.agent.autopilots.autopilot import AutopilotState, status_text
from fieldkit.agent.flying.arming import ArmingCheck
from fieldkit.agent.flying.flight_plan import FlightNeeds, FlightPlan, point_on_path
from fieldkit.agent.flying.origin import FlightOrigin
from fieldkit.agent.links.client import MessageRate

PX4 = d.MAV_AUTOPILOT_PX4
ARMED = d.MAV_MODE_FLAG_SAFETY_ARMED
metres = st.floats(-50, 50)
legs = st.lists(st.tuples(metres, metres, metres), max_size=5)


class MemoryLink:
    """A link without a connection: it stores sent frames, and delivers frames that a test has set."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.incoming_frames: list[bytes] = []
        self.messages: dict[int, MessageRate] = {}

    def fileno(self) -> int:
        raise AssertionError("no test waits for this link")

    def receive(self) -> Iterator[bytes]:
        frames, self.incoming_frames = self.incoming_frames, []
        yield from frames

    def send(self, frame: bytes) -> None:
        self.sent.append(frame)

    def close(self) -> None:
        raise AssertionError("no test closes this link")


def state_from(*messages: d.MAVLink_message, system: int = 7) -> tuple[AutopilotState, MemoryLink]:
    """Return the state of an autopilot that has sent these messages after its heartbeat."""
    link, writer = MemoryLink(), d.MAVLink(None, srcSystem=system, srcComponent=1)
    heartbeat = d.MAVLink_heartbeat_message(2, PX4, ARMED, 6 << 16, 4, 3)
    link.incoming_frames = [message.pack(writer) for message in (heartbeat, *messages)]
    state = AutopilotState(link)
    state.receive()
    return state, link


def test_state_from_messages_of_an_autopilot() -> None:
    state, _ = state_from(
        d.MAVLink_local_position_ned_message(1, 1.0, -2.0, -3.0, 0.3, 0.4, 0.0),
        d.MAVLink_attitude_message(1, 0.1, 0.2, 1.5, 0, 0, 0),
        d.MAVLink_command_ack_message(400, 4),
        d.MAVLink_statustext_message(4, b"Arming denied: vehicle is falling"),
    )
    assert state.alive
    assert state.armed
    assert state.guided
    assert state.dialect is not None
    assert state.dialect.name == "PX4"
    assert state.position_m == (1.0, -2.0, -3.0)
    assert state.speed_m_s == pytest.approx(0.5)
    assert state.yaw_rad == pytest.approx(1.5)
    assert state.command_results == {400: 4}
    assert status_text(state) == "mode OFFBOARD, its last text: Arming denied: vehicle is falling"
    assert state.texts.unread() == ["Arming denied: vehicle is falling"]
    assert state.texts.unread() == []


def test_other_systems_and_damaged_frames_are_ignored() -> None:
    state, link = state_from(d.MAVLink_local_position_ned_message(1, 1.0, 2.0, 3.0, 0, 0, 0))
    other_system = d.MAVLink(None, srcSystem=9, srcComponent=1)
    other_position = d.MAVLink_local_position_ned_message(2, 99.0, 99.0, 99.0, 0, 0, 0)
    damaged = bytearray(other_position.pack(d.MAVLink(None, srcSystem=7, srcComponent=1)))
    damaged[15] ^= 1
    nan_position = d.MAVLink_local_position_ned_message(2, math.nan, 0, 0, 0, 0, 0)
    link.incoming_frames = [
        other_position.pack(other_system),
        bytes(damaged),
        nan_position.pack(d.MAVLink(None, srcSystem=7, srcComponent=1)),
    ]
    state.receive()
    assert state.position_m == (1.0, 2.0, 3.0)


@given(st.lists(st.tuples(st.sampled_from([*mavlink_frames.CRC_EXTRA]), st.binary(max_size=60)), max_size=5))
def test_any_payload_is_tolerated(payloads: list[tuple[int, bytes]]) -> None:
    state, link = state_from()
    check = ArmingCheck(state, FlightNeeds(3.0, 5.0, 30.0, 0.2, returns=True))
    for kind, payload in payloads:
        body = bytes((len(payload), 0, 0, 0, 7, 1)) + kind.to_bytes(3, "little") + payload
        total = mavlink_frames.checksum(body + bytes((mavlink_frames.CRC_EXTRA[kind],)))
        link.incoming_frames.append(b"\xfd" + body + total.to_bytes(2, "little"))
    state.receive()
    numbers = (*(state.position_m or ()), state.yaw_rad or 0.0, *state.parameters.values())
    assert all(map(math.isfinite, numbers))
    assert all(fault.what and fault.remedy for fault in check.faults())


def test_pymavlink_parses_the_sent_messages() -> None:
    state, link = state_from()
    state.commands.send_heartbeat()
    assert state.dialect is not None
    state.commands.send(*state.dialect.guided_command())
    state.commands.send(dialect.ARM, 1)
    state.commands.send(*state.dialect.bring_down_command("land"))
    state.commands.send_set_point((1.5, -2.5, -3.0), -2.0)
    state.commands.request_stream(mavlink_frames.ATTITUDE, 10.0)
    reader = d.MAVLink(None)
    messages = [message for frame in link.sent for message in reader.parse_buffer(frame)]
    heartbeat, mode, arm, land, set_point, rate_request = messages
    assert (heartbeat.type, heartbeat.autopilot) == (d.MAV_TYPE_ONBOARD_CONTROLLER, d.MAV_AUTOPILOT_INVALID)
    assert {
        (message.target_system, message.target_component) for message in (mode, arm, land, set_point, rate_request)
    } == {(7, 1)}
    assert (mode.command, mode.param1, mode.param2) == (d.MAV_CMD_DO_SET_MODE, 1, 6)
    assert (arm.command, arm.param1, arm.param2) == (d.MAV_CMD_COMPONENT_ARM_DISARM, 1, 0)
    assert land.command == d.MAV_CMD_NAV_LAND
    assert state.dialect.bring_down_command("return") == (d.MAV_CMD_NAV_RETURN_TO_LAUNCH,)
    assert (set_point.x, set_point.y, set_point.z) == (1.5, -2.5, -3.0)
    assert set_point.coordinate_frame == d.MAV_FRAME_LOCAL_NED
    assert set_point.yaw == -2.0
    mask, flags = set_point.type_mask, d.enums["POSITION_TARGET_TYPEMASK"]
    ignored = {
        flag.name.removeprefix("POSITION_TARGET_TYPEMASK_") for bit, flag in flags.items() if mask & bit == bit
    }
    rates = {f"{kind}{axis}_IGNORE" for axis in "XYZ" for kind in "VA"}
    assert ignored == {*rates, "YAW_RATE_IGNORE"}
    assert (rate_request.param1, rate_request.param2) == (d.MAVLINK_MSG_ID_ATTITUDE, 100_000)


def plan(legs: list[tuple[float, float, float]]) -> FlightPlan:
    return FlightPlan("udpout:127.0.0.1:1", "orders", "land", 5.0, height_m=3.0, legs=legs)


def test_acknowledgements_for_others_and_in_progress_are_ignored() -> None:
    companion, other_station = (245, 191), (255, 190)
    state, _ = state_from(
        d.MAVLink_command_ack_message(400, d.MAV_RESULT_DENIED, 0, 0, *other_station),
        d.MAVLink_command_ack_message(22, d.MAV_RESULT_IN_PROGRESS, 40, 0, *companion),
        d.MAVLink_command_ack_message(176, d.MAV_RESULT_ACCEPTED, 0, 0, *companion),
        d.MAVLink_command_ack_message(21, d.MAV_RESULT_FAILED),
        d.MAVLink_statustext_message(d.MAV_SEVERITY_NOTICE, b"Fence Breached"),
        d.MAVLink_statustext_message(d.MAV_SEVERITY_INFO, b"Arming motors"),
    )
    assert state.command_results == {176: d.MAV_RESULT_ACCEPTED, 21: d.MAV_RESULT_FAILED}
    assert state.texts.unread() == ["Fence Breached"]
    assert state.texts.warnings == []


@given(legs, st.floats(-math.pi, math.pi), st.tuples(metres, metres, metres))
def test_path_length_is_independent_of_position_and_heading(
    path_legs: list[tuple[float, float, float]], yaw_rad: float, start_m: tuple[float, float, float]
) -> None:
    corners_m = plan(path_legs).corners_m(FlightOrigin("local", "", start_m[0], start_m[1], yaw_rad), start_m[2])
    assert corners_m[0] == pytest.approx((start_m[0], start_m[1], start_m[2] - 3.0))
    assert [math.dist(a, b) for a, b in pairwise(corners_m)] == pytest.approx(
        [math.hypot(*leg) for leg in path_legs], abs=1e-6
    )
    assert corners_m[-1][2] == pytest.approx(start_m[2] - 3.0 - sum(up for _, _, up in path_legs))


def test_legs_ahead_and_left_follow_the_heading() -> None:
    _, ahead, left = plan([(4.0, 0.0, 0.0), (0.0, 2.0, 1.0)]).corners_m(
        FlightOrigin("local", "", 0.0, 0.0, math.pi / 2), 0.0
    )
    assert ahead == pytest.approx((0.0, 4.0, -3.0)), "the first leg is to the east"
    assert left == pytest.approx((2.0, 4.0, -4.0)), "the second leg is to the north and up"


@given(legs, st.floats(0, 400), st.floats(0, 400))
def test_distance_of_two_points_does_not_exceed_the_path_between_them(
    path_legs: list[tuple[float, float, float]], first_m: float, second_m: float
) -> None:
    corners_m = plan(path_legs).corners_m(FlightOrigin("local", "", 0.0, 0.0, 0.0), 0.0)
    assert (
        math.dist(point_on_path(corners_m, first_m), point_on_path(corners_m, second_m))
        <= abs(first_m - second_m) + 1e-6
    )
    assert point_on_path(corners_m, 1e6) == corners_m[-1]
