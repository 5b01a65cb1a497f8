"""Services for ground stations: parameters, missions, ping, logs, files, and messages on request."""

import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as d
from pymavlink.dialects.v20 import development
from pymavlink.quaternion import Quaternion

from sim_backends.emulated.autopilot import mavlink_frames
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.mission_plan import degrees_e7
from sim_backends.emulated.autopilot.parameters import Parameters
from sim_backends.emulated.autopilot.px4 import PX4
from sim_backends.emulated.autopilot.telemetry import Telemetry
from tests.helpers.ground_station import HOME_M, SYSTEM, GroundStation

OK, FAILED, DENIED = d.MAV_RESULT_ACCEPTED, d.MAV_RESULT_FAILED, d.MAV_RESULT_DENIED
FIRMWARES = pytest.mark.parametrize("firmware", [PX4, ARDUCOPTER], ids=["px4", "ardupilot"])


def station(firmware: Firmware) -> GroundStation:
    gcs = GroundStation(firmware=firmware)
    gcs.wait(1)
    return gcs


@FIRMWARES
def test_ping_logs_and_files_have_an_answer(firmware: Firmware) -> None:
    gcs = station(firmware)
    (ping,) = gcs.send_message(d.MAVLink_ping_message(123_456, 7, 0, 0))
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (123_456, 7, 255, 190)
    assert gcs.send_message(d.MAVLink_ping_message(1, 1, SYSTEM, 1)) == [], "a response is not answered"
    (log,) = gcs.send_message(d.MAVLink_log_request_list_message(SYSTEM, 1, 0, 0xFFFF))
    assert log.num_logs == 0
    for opcode, expected, error in ((4, 129, 10), (3, 129, 6), (77, 129, 7), (2, 128, None)):
        request = struct.pack("<HBBBBBxI", 65_535, 3, opcode, 0, 0, 0, 0).ljust(251, b"\0")
        (answer,) = gcs.send_message(d.MAVLink_file_transfer_protocol_message(0, SYSTEM, 1, list(request)))
        number, session, result, size, requested_opcode, _, _ = struct.unpack_from("<HBBBBBxI", bytes(answer.payload))
        assert (number, session, result, requested_opcode) == (0, 3, expected, opcode)
        assert list(answer.payload[12 : 12 + size]) == ([] if error is None else [error])


def checksum_extra(name: str, fields: list[tuple[str, str, int]]) -> int:
    """Return the CRC_EXTRA of a message (https://mavlink.io/en/guide/serialization.html#crc_extra)."""
    sizes = {"uint32_t": 4, "uint16_t": 2}
    crc = d.x25crc(f"{name} ".encode())
    for field_type, field, length in sorted(fields, key=lambda field: -sizes.get(field[0], 1)):
        crc.accumulate(f"{field_type} {field} ".encode() + bytes([length] * (length > 0)))
    return int(crc.crc & 0xFF ^ crc.crc >> 8)


def pack_frame(message: Any, system: int = 1) -> Any:  # noqa: ANN401 (of pymavlink)
    return message.pack(d.MAVLink(None, srcSystem=system))


def test_messages_that_pymavlink_does_not_have_have_valid_checksums() -> None:
    definitions = {
        "PROTOCOL_VERSION": [
            ("uint16_t", "version", 0),
            ("uint16_t", "min_version", 0),
            ("uint16_t", "max_version", 0),
            ("uint8_t", "spec_version_hash", 8),
            ("uint8_t", "library_version_hash", 8),
        ],
        "COMPONENT_METADATA": [("uint32_t", "time_boot_ms", 0), ("uint32_t", "file_crc", 0), ("char", "uri", 100)],
    }
    for message in (mavlink_frames.protocol_version(), mavlink_frames.component_metadata(1, "mftp://x")):
        frame = pack_frame(message)
        crc = d.x25crc(frame[1:-2])
        crc.accumulate(bytes([checksum_extra(message.get_type(), definitions[message.get_type()])]))
        assert int.from_bytes(frame[-2:], "little") == crc.crc
    frame = pack_frame(mavlink_frames.available_modes(9, 2, 5, 0x05040000, "Return"))
    (mode,) = development.MAVLink(None).parse_buffer(frame)
    assert (mode.number_modes, mode.mode_index, mode.standard_mode) == (9, 2, 5)
    assert (mode.custom_mode, mode.mode_name) == (0x05040000, "Return")


class RawStation(GroundStation):
    """A ground station that reads the ids of messages that pymavlink's dialect does not have."""

    def answers(self, message_id: int, param2: float = 0) -> tuple[int, list[int]]:
        """Return the result of MAV_CMD_REQUEST_MESSAGE, and the ids of the other messages received."""
        command = d.MAVLink_command_long_message(
            SYSTEM, 1, d.MAV_CMD_REQUEST_MESSAGE, 0, message_id, param2, 0, 0, 0, 0, 0
        ).pack(self._link)
        frames = [frame for _, frame in self.autopilot.receive(command, ("gcs", 1), self.now_ns)]
        (ack,) = d.MAVLink(None).parse_buffer(frames[0])
        return int(ack.result), [int.from_bytes(frame[7:10], "little") for frame in frames[1:]]


@pytest.mark.parametrize(
    ("message_id", "px4", "ardupilot"),
    [
        (d.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, OK, OK),
        (d.MAVLINK_MSG_ID_HIGHRES_IMU, OK, FAILED),
        (d.MAVLINK_MSG_ID_RAW_IMU, DENIED, OK),
        (d.MAVLINK_MSG_ID_ODOMETRY, OK, FAILED),
        (d.MAVLINK_MSG_ID_ALTITUDE, OK, FAILED),
        (mavlink_frames.PROTOCOL_VERSION, OK, OK),
        (mavlink_frames.COMPONENT_METADATA, OK, FAILED),
        (d.MAVLINK_MSG_ID_AUTOPILOT_VERSION, OK, OK),
        (12_345, DENIED, FAILED),
    ],
)
def test_a_message_is_sent_on_request_if_the_firmware_has_it(message_id: int, px4: int, ardupilot: int) -> None:
    for firmware, expected in ((PX4, px4), (ARDUCOPTER, ardupilot)):
        gcs = RawStation(firmware=firmware)
        gcs.wait(1)
        assert gcs.answers(message_id) == (expected, [message_id] if expected == OK else [])


@FIRMWARES
def test_each_mode_is_listed(firmware: Firmware) -> None:
    gcs = RawStation(firmware=firmware)
    gcs.wait(1)
    result, message_ids = gcs.answers(mavlink_frames.AVAILABLE_MODES, 0)
    assert (result, message_ids) == (OK, [mavlink_frames.AVAILABLE_MODES] * len(firmware.names))
    assert gcs.answers(mavlink_frames.AVAILABLE_MODES, 1) == (OK, [mavlink_frames.AVAILABLE_MODES])
    assert gcs.answers(mavlink_frames.AVAILABLE_MODES, 200)[0] != OK


def test_modes_have_the_standard_modes_of_the_dialect() -> None:
    messages = Telemetry(station(PX4).autopilot.vehicle, Parameters(())).available_modes(0)
    modes = [development.MAVLink(None).parse_buffer(pack_frame(message))[0] for message in messages]
    assert {mode.mode_name: mode.standard_mode for mode in modes if mode.standard_mode} == {
        "Position": development.MAV_STANDARD_MODE_POSITION_HOLD,
        "Altitude": development.MAV_STANDARD_MODE_ALTITUDE_HOLD,
        "Return": development.MAV_STANDARD_MODE_SAFE_RECOVERY,
        "Mission": development.MAV_STANDARD_MODE_MISSION,
        "Land": development.MAV_STANDARD_MODE_LAND,
        "Takeoff": development.MAV_STANDARD_MODE_TAKEOFF,
    }


def test_attitude_and_acceleration_agree_in_flight() -> None:
    gcs = station(PX4)
    gcs.request_rate(
        10, d.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, d.MAVLINK_MSG_ID_HIGHRES_IMU, d.MAVLINK_MSG_ID_ODOMETRY
    )
    gcs.request_rate(10, d.MAVLINK_MSG_ID_LOCAL_POSITION_NED, d.MAVLINK_MSG_ID_ATTITUDE)
    gcs.autopilot.vehicle.arm()
    gcs.autopilot.vehicle.take_off(3.0)
    gcs.wait(10)
    x, y = degrees_e7(HOME_M[0] + 20, HOME_M[1])
    frame = d.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    gcs.send_message(
        d.MAVLink_command_int_message(SYSTEM, 1, frame, d.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, 0, x, y, 3)
    )
    gcs.wait(4)
    gcs.now_ns -= gcs.now_ns % 100_000_000
    gcs.wait(0.2)
    attitude, quaternion = gcs.last("ATTITUDE"), gcs.last("ATTITUDE_QUATERNION")
    assert pitch_of(quaternion) == pytest.approx(attitude.pitch, abs=0.02)
    imu = gcs.last("HIGHRES_IMU")
    assert (imu.xacc**2 + imu.yacc**2 + imu.zacc**2) ** 0.5 == pytest.approx(9.81, abs=0.05)
    assert imu.zacc < 0
    odometry, local = gcs.last("ODOMETRY"), gcs.last("LOCAL_POSITION_NED")
    body_speed = (odometry.vx**2 + odometry.vy**2 + odometry.vz**2) ** 0.5
    assert body_speed == pytest.approx((local.vx**2 + local.vy**2 + local.vz**2) ** 0.5, abs=0.2)
    assert local.vy > 1.0, "it is flying east"
    assert odometry.vx == pytest.approx(body_speed, abs=0.2), "the nose points along the path"


def pitch_of(quaternion: Any) -> float:  # noqa: ANN401 (of pymavlink)
    """Return the pitch of a quaternion, computed by pymavlink's library."""
    rotation = Quaternion([quaternion.q1, quaternion.q2, quaternion.q3, quaternion.q4])
    return float(rotation.euler[1])


class TestParameters:
    def test_px4_encodes_integer_parameters_bytewise(self) -> None:
        gcs = station(PX4)
        values = {
            value.param_id: value for value in gcs.send_message(d.MAVLink_param_request_list_message(SYSTEM, 1))
        }
        autostart = values["SYS_AUTOSTART"]
        assert autostart.param_type == d.MAV_PARAM_TYPE_INT32
        assert struct.unpack("<i", struct.pack("<f", autostart.param_value)) == (10_040,)
        gcs.set("COM_DL_LOSS_T", 30)
        gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, b"COM_DL_LOSS_T", 20.0, d.MAV_PARAM_TYPE_REAL32))
        gcs.wait(0.1)
        assert (d.MAV_SEVERITY_INFO, "[pm] param types mismatch param: COM_DL_LOSS_T") in gcs.texts()

    def test_arducopter_casts_integer_parameters_to_floats(self) -> None:
        gcs = station(ARDUCOPTER)
        (value,) = gcs.send_message(d.MAVLink_param_request_read_message(SYSTEM, 1, b"SYSID_MYGCS", -1))
        assert (value.param_value, value.param_type) == (255.0, d.MAV_PARAM_TYPE_INT32)
        gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, b"SYSID_MYGCS", 245.0, d.MAV_PARAM_TYPE_REAL32))
        (value,) = gcs.send_message(d.MAVLink_param_request_read_message(SYSTEM, 1, b"SYSID_MYGCS", -1))
        assert value.param_value == 245.0

    @pytest.mark.parametrize(("firmware", "texts"), [(PX4, ["[pm] unknown param: NO_SUCH"]), (ARDUCOPTER, [])])
    def test_only_px4_reports_an_unknown_parameter_name(self, firmware: Firmware, texts: list[str]) -> None:
        gcs = station(firmware)
        assert not gcs.send_message(d.MAVLink_param_set_message(SYSTEM, 1, b"NO_SUCH", 1.0, d.MAV_PARAM_TYPE_REAL32))
        gcs.wait(0.1)
        assert [text for _, text in gcs.texts()] == texts


def test_a_refused_mission_is_refused_again_when_the_answer_was_lost() -> None:
    gcs = station(PX4)
    x, y = degrees_e7(HOME_M[0] + 500, HOME_M[1])
    frame, waypoint = d.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, d.MAV_CMD_NAV_WAYPOINT
    item = d.MAVLink_mission_item_int_message(SYSTEM, 1, 0, frame, waypoint, 0, 1, 0, 0, 0, 0, x, y, 3.0)
    gcs.send_message(d.MAVLink_mission_count_message(SYSTEM, 1, 1))
    for _ in range(3):
        (ack,) = gcs.send_message(item)
        assert ack.type == d.MAV_MISSION_DENIED
