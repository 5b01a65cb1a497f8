"""The autopilot and a ground station: answers, refusals, flights, and bytes that are not MAVLink."""

import math
import random
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as d

from sim_backends.emulated.autopilot.mavlink_frames import Message
from sim_backends.emulated.autopilot.mission_plan import REPEATS, degrees_e7
from sim_backends.emulated.autopilot.parameters import FlightLimits
from tests.helpers.ground_station import HOME_M, RELATIVE, SYSTEM, GroundStation, item, upload

OK = d.MAV_RESULT_ACCEPTED
REJECTED = d.MAV_RESULT_TEMPORARILY_REJECTED
CUSTOM = d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
POSITION_ONLY, VELOCITY_ONLY = 0b110111111000, 0b111111000111
"""Type masks of set-points, which name the fields that are ignored (POSITION_TARGET_TYPEMASK)."""


@pytest.fixture
def gcs() -> GroundStation:
    station = GroundStation()
    station.wait(2)
    station.request_rate(10, d.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    return station


def take_off(gcs: GroundStation, height_m: float = 3.0) -> None:
    assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
    assert gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m) == OK
    gcs.wait(8)


def status_texts(gcs: GroundStation) -> list[str]:
    return [message.text for message in gcs.received if message.get_type() == "STATUSTEXT"]


class TestTelemetry:
    def test_messages_have_their_rates(self, gcs: GroundStation) -> None:
        counts = Counter(message.get_type() for message in gcs.wait(20))
        assert counts["HEARTBEAT"] == counts["SYS_STATUS"] == counts["EXTENDED_SYS_STATE"] == 20
        assert abs(counts["LOCAL_POSITION_NED"] - 200) <= 1, "as requested"
        assert abs(counts["ATTITUDE"] - 300) <= 1
        assert counts["GLOBAL_POSITION_INT"] == 100
        assert counts["HOME_POSITION"] == counts["BATTERY_STATUS"] == 10
        assert not {"HIGHRES_IMU", "ODOMETRY", "ATTITUDE_QUATERNION"} & counts.keys()

    def test_sequence_numbers_have_no_gaps(self, gcs: GroundStation) -> None:
        numbers = [message.get_seq() for message in gcs.wait(10)]
        assert all((after - before) % 256 == 1 for before, after in pairwise(numbers))

    def test_an_interval_stays_until_the_default_is_requested(self, gcs: GroundStation) -> None:
        for interval_us, expected in ((100_000, 100), (-1, 0), (0, 10)):
            assert gcs.command(d.MAV_CMD_SET_MESSAGE_INTERVAL, d.MAVLINK_MSG_ID_SYS_STATUS, interval_us) == OK
            counts = Counter(message.get_type() for message in gcs.wait(10))
            assert abs(counts["SYS_STATUS"] - expected) <= 1
        assert gcs.command(d.MAV_CMD_SET_MESSAGE_INTERVAL, 12_345, 1e6) == d.MAV_RESULT_FAILED

    def test_data_stream_requests_are_ignored(self, gcs: GroundStation) -> None:
        gcs.send_message(d.MAVLink_request_data_stream_message(SYSTEM, 1, d.MAV_DATA_STREAM_POSITION, 2, 1))
        assert abs(Counter(message.get_type() for message in gcs.wait(10))["LOCAL_POSITION_NED"] - 100) <= 1

    def test_the_autopilot_sends_its_version_on_request(self, gcs: GroundStation) -> None:
        assert gcs.command(d.MAV_CMD_REQUEST_MESSAGE, d.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == OK
        assert gcs.last("AUTOPILOT_VERSION").capabilities & d.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        assert gcs.command(d.MAV_CMD_REQUEST_MESSAGE, math.nan) == d.MAV_RESULT_DENIED
        assert gcs.command(d.MAV_CMD_DO_PARACHUTE) == d.MAV_RESULT_UNSUPPORTED

    def test_silent_clients_receive_no_more_messages(self, gcs: GroundStation) -> None:
        later_ns = gcs.now_ns + 16_000_000_000
        assert not list(gcs.autopilot.advance(later_ns))
        assert gcs.autopilot.next_ns() is None

    def test_positions_agree_with_each_other(self, gcs: GroundStation) -> None:
        take_off(gcs)
        place, home, local = (
            gcs.last(kind) for kind in ("GLOBAL_POSITION_INT", "HOME_POSITION", "LOCAL_POSITION_NED")
        )
        assert (place.lat, place.lon) == (home.latitude, home.longitude) == degrees_e7(*HOME_M[:2])
        assert place.alt - home.altitude == pytest.approx(place.relative_alt, abs=1)
        assert -local.z * 1e3 == pytest.approx(place.relative_alt, abs=50)


class TestFlight:
    def test_take_off_and_land(self, gcs: GroundStation) -> None:
        take_off(gcs)
        assert gcs.last("LOCAL_POSITION_NED").z == pytest.approx(-3.0, abs=0.1)
        assert gcs.last("EXTENDED_SYS_STATE").landed_state == d.MAV_LANDED_STATE_IN_AIR
        assert gcs.last("HEARTBEAT").base_mode & d.MAV_MODE_FLAG_SAFETY_ARMED
        assert gcs.command(d.MAV_CMD_NAV_LAND) == OK
        gcs.wait(10)
        assert gcs.last("EXTENDED_SYS_STATE").landed_state == d.MAV_LANDED_STATE_ON_GROUND
        assert not gcs.last("HEARTBEAT").base_mode & d.MAV_MODE_FLAG_SAFETY_ARMED

    def test_commands_are_refused_in_the_wrong_state(self, gcs: GroundStation) -> None:
        assert gcs.command(d.MAV_CMD_NAV_TAKEOFF) == REJECTED
        assert gcs.command(d.MAV_CMD_NAV_LAND) == REJECTED
        assert gcs.command(d.MAV_CMD_MISSION_START) == REJECTED
        assert gcs.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 6, 0) == REJECTED
        assert gcs.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 99, 0) == d.MAV_RESULT_DENIED
        assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
        assert gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 1000) == REJECTED
        take_off(gcs)
        assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 0) == REJECTED
        assert gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == REJECTED
        gcs.wait(1)
        assert "Takeoff denied: not armed" in status_texts(gcs)
        assert "Disarming denied: not landed" in status_texts(gcs)

    def test_a_takeoff_can_be_repeated_after_a_lost_answer(self, gcs: GroundStation) -> None:
        assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
        for _ in range(3):
            assert gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3) == OK
            gcs.wait(0.5)

    def test_a_drone_that_is_disarmed_in_the_air_by_force_falls(self, gcs: GroundStation) -> None:
        take_off(gcs)
        assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == OK
        gcs.wait(1)
        assert gcs.last("LOCAL_POSITION_NED").z == 0

    def test_the_drone_disarms_if_it_does_not_take_off(self, gcs: GroundStation) -> None:
        assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
        gcs.wait(9)
        assert gcs.autopilot.vehicle.is_armed
        gcs.wait(2)
        assert not gcs.autopilot.vehicle.is_armed

    def test_the_drone_follows_set_points_until_they_stop(self, gcs: GroundStation) -> None:
        take_off(gcs)
        for number in range(30):
            gcs.send_message(
                d.MAVLink_set_position_target_local_ned_message(
                    0, SYSTEM, 1, d.MAV_FRAME_LOCAL_NED, VELOCITY_ONLY, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 0
                )
            )
            if number == 0:
                assert gcs.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 6, 0) == OK
            gcs.wait(0.1)
        assert gcs.last("LOCAL_POSITION_NED").vx == pytest.approx(1.0, abs=0.05)
        gcs.wait(8)
        assert gcs.last("LOCAL_POSITION_NED").vx == pytest.approx(0.0, abs=0.05)
        assert gcs.last("HEARTBEAT").custom_mode == 4 << 16 | 3 << 24
        assert (d.MAV_SEVERITY_CRITICAL, "Failsafe activated") in gcs.texts()

    def test_set_points_do_not_move_the_drone_over_the_fence(self, gcs: GroundStation) -> None:
        take_off(gcs)
        gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, b"GF_MAX_HOR_DIST", 10.0, d.MAV_PARAM_TYPE_REAL32))
        for number in range(100):
            gcs.send_message(
                d.MAVLink_set_position_target_local_ned_message(
                    0, SYSTEM, 1, d.MAV_FRAME_LOCAL_NED, VELOCITY_ONLY, 0, 0, 0, 3.0, 3.0, 0, 0, 0, 0, 0, 0
                )
            )
            if number == 0:
                assert gcs.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 6, 0) == OK
            gcs.wait(0.1)
        gcs.wait(3)
        position = gcs.last("LOCAL_POSITION_NED")
        assert 9.0 < math.hypot(position.x, position.y) <= 10.1

    @pytest.mark.parametrize("up_m", [4.0, math.nan])
    def test_a_position_in_an_unknown_frame_is_refused(self, gcs: GroundStation, up_m: float) -> None:
        take_off(gcs)
        start_m = gcs.autopilot.vehicle.body.position_m
        x, y = degrees_e7(HOME_M[0] + 8, HOME_M[1])
        gcs.send_message(
            d.MAVLink_command_int_message(SYSTEM, 1, 99, d.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, 0, x, y, up_m)
        )
        gcs.wait(5)
        assert gcs.last("COMMAND_ACK").result == 9, "MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME"
        assert math.dist(gcs.autopilot.vehicle.body.position_m, start_m) < 0.5

    def test_return_to_launch(self, gcs: GroundStation) -> None:
        take_off(gcs)
        x, y = degrees_e7(HOME_M[0] + 8, HOME_M[1])
        gcs.send_message(
            d.MAVLink_command_int_message(SYSTEM, 1, RELATIVE, d.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, 0, x, y, 4)
        )
        gcs.wait(10)
        assert gcs.last("LOCAL_POSITION_NED").y == pytest.approx(8.0, abs=0.1)
        assert gcs.command(d.MAV_CMD_NAV_RETURN_TO_LAUNCH) == OK
        heights = [-message.z for message in gcs.wait(40) if message.get_type() == "LOCAL_POSITION_NED"]
        assert max(heights) == pytest.approx(10.0, abs=0.2), "RTL_RETURN_ALT"
        assert not gcs.autopilot.vehicle.is_armed
        assert math.hypot(*gcs.autopilot.vehicle.body.position_m[:2]) < 0.6


class TestLimits:
    """No command moves the drone beyond the limits of its profile, except by half a metre while it brakes.

    Its speed may exceed the limit by a twentieth for a short time, since its attitude lags behind the commands.
    """

    OVERSHOOT_M, SPEED_FACTOR = 0.5, 1.05
    LIMITS = FlightLimits(speed_m_s=2.0, height_m=6.0, fence_m=12.0)
    velocities = st.tuples(*[st.floats(-30, 30)] * 3)
    places = st.tuples(*[st.floats(-40, 40)] * 3)

    @settings(max_examples=6, phases=(Phase.explicit, Phase.reuse, Phase.generate))  # each takes half a second
    @given(st.lists(st.tuples(st.booleans(), velocities, places), min_size=1, max_size=5))
    @example(
        [
            (True, (27, 19, 0), (17, 0, 0)),
            (True, (0, -9, 0), (0, 0, 0)),
            (True, (-30, 0, -13), (0, 0, 0)),
            (False, (23, 1, 0), (31, -19, 19)),
            (False, (0, -6, -14), (-10, -2, 33)),
        ]
    )  # brakes twice at the fence
    def test_commands_do_not_exceed_the_limits(
        self, commands: list[tuple[bool, tuple[float, float, float], tuple[float, float, float]]]
    ) -> None:
        gcs = GroundStation(limits=self.LIMITS)
        gcs.wait(1)
        for name, value in ((b"GF_MAX_HOR_DIST", 99.0), (b"GF_MAX_VER_DIST", 99.0), (b"MPC_XY_VEL_MAX", 9.0)):
            gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, name, value, d.MAV_PARAM_TYPE_REAL32))
        take_off(gcs)
        for uses_velocity, velocity, place in commands:
            east_m, north_m, up_m = place
            x, y = degrees_e7(HOME_M[0] + east_m, HOME_M[1] + north_m)
            gcs.send_message(
                d.MAVLink_command_int_message(
                    SYSTEM, 1, RELATIVE, d.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, 0, x, y, up_m
                )
            )
            mask = VELOCITY_ONLY if uses_velocity else POSITION_ONLY
            for number in range(40):
                gcs.send_message(
                    d.MAVLink_set_position_target_local_ned_message(
                        0, SYSTEM, 1, d.MAV_FRAME_LOCAL_NED, mask, *place, *velocity, 0, 0, 0, 0, 0
                    )
                )
                if number == 0:
                    gcs.command(d.MAV_CMD_DO_SET_MODE, CUSTOM, 6, 0)
                gcs.wait(0.1)
                body = gcs.autopilot.vehicle.body
                assert math.hypot(*body.position_m[:2]) <= self.LIMITS.fence_m + self.OVERSHOOT_M
                assert -0.01 <= body.position_m[2] <= self.LIMITS.height_m + self.OVERSHOOT_M
                assert math.hypot(*body.velocity_m_s[:2]) <= self.LIMITS.speed_m_s * self.SPEED_FACTOR

    def test_a_take_off_and_a_mission_outside_the_limits_are_refused(self) -> None:
        gcs = GroundStation(limits=self.LIMITS)
        gcs.wait(1)
        assert gcs.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1) == OK
        assert gcs.command(d.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 6.1) == REJECTED
        assert upload(gcs, [item(0, 0, 0, 5), item(1, 12.5, 0, 5)]) == d.MAV_MISSION_DENIED
        assert upload(gcs, [item(0, 0, 0, 5), item(1, 0, 11.5, 5)]) == d.MAV_MISSION_ACCEPTED


class TestParameters:
    def test_the_list_is_complete(self, gcs: GroundStation) -> None:
        answers = gcs.send_message(d.MAVLink_param_request_list_message(SYSTEM, 1))
        assert [answer.param_index for answer in answers] == list(range(answers[0].param_count))
        assert {answer.param_id: answer.param_value for answer in answers}["MPC_XY_VEL_MAX"] == 3.0

    def test_values_outside_the_range_are_rejected(self, gcs: GroundStation) -> None:
        for requested, expected in ((2.0, 2.0), (30.0, 2.0), (math.nan, 2.0)):
            (answer,) = gcs.send_message(
                d.MAVLink_param_set_message(SYSTEM, 1, b"MPC_XY_VEL_MAX", requested, d.MAV_PARAM_TYPE_REAL32)
            )
            assert answer.param_value == expected
        assert not gcs.send_message(d.MAVLink_param_request_read_message(SYSTEM, 1, b"NO_SUCH", -1))


class TestMission:
    PLACES = ((4.0, 0.0, 3.0), (4.0, 4.0, 4.0), (0.0, 4.0, 3.0))

    @pytest.mark.parametrize("loss", [0.0, 0.05, 0.3])
    def test_a_mission_is_flown_despite_loss(self, loss: float) -> None:
        rng = random.Random(7)
        gcs = GroundStation(is_lost=lambda: rng.random() < loss)
        items = [item(number, *place) for number, place in enumerate(self.PLACES)]
        items.append(item(len(items), 0, 0, 0, d.MAV_CMD_NAV_RETURN_TO_LAUNCH))
        assert upload(gcs, items) == d.MAV_MISSION_ACCEPTED
        assert [entry.command for entry in gcs.autopilot.vehicle.mission.items] == [entry.command for entry in items]
        gcs.autopilot.vehicle.arm()
        for _ in range(30):
            gcs.send_message(d.MAVLink_command_long_message(SYSTEM, 1, d.MAV_CMD_MISSION_START, 0, *(0,) * 7))
        least_distances_m = dict.fromkeys(self.PLACES, math.inf)
        for _ in range(600):
            gcs.wait(0.1)
            position = gcs.autopilot.vehicle.body.position_m
            least_distances_m = {
                place: min(distance_m, math.dist(place, position)) for place, distance_m in least_distances_m.items()
            }
        assert max(least_distances_m.values()) < 0.5
        assert not gcs.autopilot.vehicle.is_armed
        if not loss:
            reached_items = [message.seq for message in gcs.received if message.get_type() == "MISSION_ITEM_REACHED"]
            assert list(dict.fromkeys(reached_items)) == [0, 1, 2, 3]
            assert reached_items.count(3) == 1 + REPEATS, "repeated in case of loss"

    def test_a_mission_can_be_downloaded(self, gcs: GroundStation) -> None:
        items = [item(number, *place) for number, place in enumerate(self.PLACES)]
        assert upload(gcs, items) == d.MAV_MISSION_ACCEPTED
        (count,) = gcs.send_message(d.MAVLink_mission_request_list_message(SYSTEM, 1))
        assert count.count == len(items)
        for uploaded_item in items:
            (downloaded,) = gcs.send_message(d.MAVLink_mission_request_int_message(SYSTEM, 1, uploaded_item.seq))
            assert (downloaded.x, downloaded.y, downloaded.z, downloaded.command) == (
                uploaded_item.x,
                uploaded_item.y,
                uploaded_item.z,
                uploaded_item.command,
            )
        (ack,) = gcs.send_message(d.MAVLink_mission_request_int_message(SYSTEM, 1, 3))
        assert ack.type == d.MAV_MISSION_INVALID_SEQUENCE

    @pytest.mark.parametrize(
        ("invalid_item", "result"),
        [
            (item(0, 500.0, 0.0, 3.0), d.MAV_MISSION_DENIED),
            (item(0, 1.0, 0.0, 31.0), d.MAV_MISSION_DENIED),
            (item(0, 1.0, 0.0, math.nan), d.MAV_MISSION_UNSUPPORTED_FRAME),
            (item(0, 0.0, 0.0, 3.0, d.MAV_CMD_DO_PARACHUTE), d.MAV_MISSION_UNSUPPORTED),
        ],
    )
    def test_unsupported_items_are_refused(self, gcs: GroundStation, invalid_item: Message, result: int) -> None:
        assert upload(gcs, [invalid_item]) == result
        assert not gcs.autopilot.vehicle.mission.items

    def test_an_abandoned_upload_is_cancelled(self, gcs: GroundStation) -> None:
        gcs.send_message(d.MAVLink_mission_count_message(SYSTEM, 1, 3))
        counts = Counter(message.get_type() for message in gcs.wait(10))
        assert counts["MISSION_REQUEST_INT"] == 19
        assert gcs.last("MISSION_ACK").type == d.MAV_MISSION_OPERATION_CANCELLED


def frames() -> list[bytes]:
    """Return frames of requests, some with extreme values."""
    link = d.MAVLink(None, srcSystem=255, srcComponent=190)
    requests = [
        d.MAVLink_mission_count_message(SYSTEM, 1, 65_535),
        d.MAVLink_mission_count_message(SYSTEM, 1, 2),
        item(0, 1.0, 1.0, 2.0),
        d.MAVLink_param_request_list_message(SYSTEM, 1),
        d.MAVLink_param_set_message(SYSTEM, 1, b"\xff" * 16, math.nan, 9),
        *(
            d.MAVLink_command_long_message(SYSTEM, 1, command, 0, value, value, value, 0, 0, 0, value)
            for command in (16, 20, 21, 22, 176, 178, 192, 224, 300, 400, 510, 511, 512, 520)
            for value in (0.0, 1.0, -1.0, 1e30, math.nan, math.inf, 0.5)
        ),
        *(
            d.MAVLink_command_int_message(SYSTEM, 1, frame, 192, 0, 0, *(0,) * 4, 1, 1, math.nan)
            for frame in (0, 6, 99)
        ),
    ]
    return [request.pack(link) for request in requests]


FRAMES = frames()


def with_changed_byte(frame: bytes, index: int, value: int) -> bytes:
    index %= len(frame)
    return frame[:index] + bytes([value]) + frame[index + 1 :]


mutated_frames = st.builds(with_changed_byte, st.sampled_from(FRAMES), st.integers(0, 279), st.integers(0, 255))
cut_frames = st.builds(lambda frame, end: frame[: end % len(frame)], st.sampled_from(FRAMES), st.integers(0, 279))


def with_valid_checksum(frame: bytes) -> bytes:
    """Return a frame with a valid checksum for its content, so that it is not discarded."""
    kind = int.from_bytes(frame[7:10], "little")
    if frame[0] != 0xFD or len(frame) < 12 or kind not in d.mavlink_map:
        return frame
    crc = d.x25crc(frame[1:-2])
    crc.accumulate(bytes([d.mavlink_map[kind].crc_extra]))
    checksum: int = crc.crc
    return frame[:-2] + checksum.to_bytes(2, "little")


hostile_datagrams = st.one_of(
    st.binary(max_size=300),
    mutated_frames,
    cut_frames,
    mutated_frames.map(with_valid_checksum),
    st.sampled_from(FRAMES),
)


class TestHostile:
    @settings(deadline=None)
    @given(st.lists(hostile_datagrams, min_size=1, max_size=12))
    def test_the_autopilot_survives_any_bytes(self, datagrams: list[bytes]) -> None:
        gcs = GroundStation()
        for datagram in datagrams:
            gcs.send(datagram)
            gcs.wait(0.1)
        assert Counter(message.get_type() for message in gcs.wait(3))["HEARTBEAT"] >= 2

    def test_a_truncated_frame_does_not_affect_the_next(self, gcs: GroundStation) -> None:
        gcs.send(FRAMES[3][:-4])
        assert gcs.send(FRAMES[3])

    @pytest.mark.parametrize(("system", "component"), [(SYSTEM + 1, 1), (SYSTEM, 100)])
    def test_messages_to_other_systems_are_ignored(self, gcs: GroundStation, system: int, component: int) -> None:
        message = d.MAVLink_command_long_message(system, component, d.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, *(0,) * 6)
        assert gcs.send_message(message) == []
        assert not gcs.autopilot.vehicle.is_armed

    def test_clients_beyond_the_maximum_are_not_served(self, gcs: GroundStation) -> None:
        for port in range(2, 40):
            list(gcs.autopilot.receive(FRAMES[3], ("other", port), gcs.now_ns))
        assert not list(gcs.autopilot.receive(FRAMES[3], ("late", 1), gcs.now_ns))
