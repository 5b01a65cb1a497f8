"""Parts of an emulated robot that need no namespace."""

import math
import shlex
import statistics
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.backends.protocols import Cast
from fieldkit.config import locations
from fieldkit.config.profiles import RobotProfile, load_profile
from fieldkit.config.schema import parse, validate
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.ros.interfaces.types import standard_types
from sim_backends.emulated import emulated_options, placement, requirements
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice, load_options
from sim_backends.emulated.medium.air_files import LIMIT_BYTES
from sim_backends.emulated.provisioning import KeyPair, _sensor, definition, robot_spec
from sim_backends.emulated.robot import mounts, rootfs
from sim_backends.emulated.ros import messages, sensor_specs, tcpros
from sim_backends.emulated.ros.sensor_specs import LaserTarget, Sensor
from sim_backends.ros1 import framing
from sim_backends.world.penetration import Obstacles
from sim_backends.world.world import load_world
from tests.helpers.labs import replace_text

STORE = standard_types().ros1
FIELDS = (
    ("sensor_msgs/LaserScan.angle_min", 0.0),
    ("sensor_msgs/LaserScan.time_increment", 0.2 / 360),
    ("sensor_msgs/LaserScan.range_min", 0.12),
    ("sensor_msgs/LaserScan.range_max", 3.5),
    ("sensor_msgs/Imu.orientation.w", 1.0),
    ("sensor_msgs/Imu.orientation_covariance.4", 0.0025),
    ("sensor_msgs/Imu.orientation_covariance.1", 0.0),
    ("sensor_msgs/Imu.angular_velocity_covariance.0", 0.02),
    ("sensor_msgs/Imu.linear_acceleration.z", 9.80665),
    ("sensor_msgs/Imu.linear_acceleration_covariance.8", 0.04),
    ("nav_msgs/Odometry.pose.pose.position.x", 0.0),
    ("nav_msgs/Odometry.pose.pose.orientation.w", 1.0),
    ("nav_msgs/Odometry.pose.covariance.35", 0.03),
    ("nav_msgs/Odometry.twist.twist.linear.x", 0.0),
    ("nav_msgs/Odometry.twist.covariance.7", 0.001),
    ("sensor_msgs/BatteryState.voltage", 11.1),
    ("sensor_msgs/BatteryState.temperature", math.nan),
    ("sensor_msgs/BatteryState.capacity", math.nan),
    ("sensor_msgs/BatteryState.design_capacity", 1.8),
    ("sensor_msgs/BatteryState.percentage", 0.8),
    ("sensor_msgs/BatteryState.power_supply_status", 2),
    ("sensor_msgs/BatteryState.power_supply_health", 1),
    ("sensor_msgs/BatteryState.power_supply_technology", 3),
    ("sensor_msgs/BatteryState.present", 1),
    ("sensor_msgs/Range.radiation_type", 1),
    ("sensor_msgs/Range.field_of_view", math.radians(25)),
    ("sensor_msgs/Range.min_range", 0.02),
    ("sensor_msgs/Range.max_range", 4.0),
    ("sensor_msgs/NavSatFix.status.status", 0),
    ("sensor_msgs/NavSatFix.status.service", 1),
    ("sensor_msgs/NavSatFix.position_covariance.4", 0.01),
    ("sensor_msgs/NavSatFix.position_covariance.8", 0.25),
    ("sensor_msgs/NavSatFix.position_covariance_type", 2),
    ("sensor_msgs/MagneticField.magnetic_field.y", 20e-6),
    ("sensor_msgs/MagneticField.magnetic_field.z", -44e-6),
    ("sensor_msgs/MagneticField.magnetic_field_covariance.0", 1e-14),
    ("sensor_msgs/FluidPressure.fluid_pressure", 101_325.0),
    ("sensor_msgs/FluidPressure.variance", 9.0),
    ("sensor_msgs/Temperature.temperature", 20.0),
    ("sensor_msgs/Temperature.variance", 0.01),
    ("geometry_msgs/PoseStamped.pose.position.x", 0.0),
    ("geometry_msgs/PoseStamped.pose.orientation.w", 1.0),
)
"""Values that a robot at rest publishes, with noise of at most 1 %."""

SITE = """\
backend: emulated
robots:
  a: {profile: turtlebot3_burger}
  b: {profile: turtlebot3_burger}
roles:
  masterless: {sender: b, receiver: a}
"""


def cast_for(topology: Topology) -> Cast:
    return EmulatedBackend(None, None).cast(topology)


def placement_of(scenario: Scenario, topology: Topology) -> Placement:
    return Placement(scenario, topology, parse_distance("10m"))


def sensor(kind: str = "sensor_msgs/LaserScan", points: int | None = 360) -> Sensor:
    return Sensor("/scan", kind, rate_hz=5.0, frame="base_scan", points=points)


def read_back(data: bytes, kind: str) -> Any:  # noqa: ANN401 (rosbags makes its types at run time)
    return STORE.deserialize_ros1(data, kind.replace("/", "/msg/"))


class TestBackend:
    def test_the_default_lab_has_the_robots_of_the_paper(self) -> None:
        master, masterless = cast_for(Topology.MASTER), cast_for(Topology.MASTERLESS)
        assert {role: (robot.name, robot.address) for role, robot in master.items()} == {
            Role.SENDER: ("turtlebot-1", "10.42.0.1"),
            Role.RECEIVER: ("turtlebot-2", "10.42.0.2"),
            Role.RELAY: ("duckiedrone-1", "10.42.0.3"),
        }
        assert {role: (robot.name, robot.address) for role, robot in masterless.items()} == {
            Role.SENDER: ("turtlebot-1", "10.42.0.1"),
            Role.RECEIVER: ("duckiedrone-1", "10.42.0.3"),
        }

    def test_addresses_follow_the_site_file(self) -> None:
        document = parse(SITE, source="fieldkit.yaml")
        backend = EmulatedBackend(validate(document, Site), document)
        assert backend.cast(Topology.MASTERLESS)[Role.SENDER].address == "10.42.0.2"

    def test_a_wrong_option_is_named_with_its_line(self) -> None:
        document = parse(SITE + "emulated:\n  rod: auto\n", source="fieldkit.yaml")
        with pytest.raises(ConfigurationError, match=r"fieldkit\.yaml:8: .*'ros'"):
            EmulatedBackend(validate(document, Site), document)

    @pytest.mark.parametrize(
        ("text", "lab_bytes"),
        [("", 0), ("record_air: true", LIMIT_BYTES), ("record_air: true\n  radio: {loss: 1%}", 0)],
    )
    def test_only_a_lab_that_records_the_air_writes_files(self, text: str, lab_bytes: int) -> None:
        document = parse(SITE + f"emulated:\n  boot: 2s\n  {text}\n", source="fieldkit.yaml")
        assert EmulatedBackend(validate(document, Site), document).lab_bytes == lab_bytes

    def test_options_default_without_their_section(self) -> None:
        assert load_options(None) == load_options(parse(SITE, source="fieldkit.yaml")) == EmulatedOptions()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (("sensor_msgs/Imu", "sensor_msgs/Imi"), r"cannot publish sensor_msgs/Imi(.|\n)*'sensor_msgs/Imu'\?"),
            (
                ("variant: ros1", "variant: ros2", "points: 360}", 'points: 360, definition: "int8 x"}'),
                "runs ros2, whose emulated recorder supports only standard types",
            ),
            (("/opt/ros/noetic/setup.bash", "/proc/ros/setup.bash"), "cannot have the setup file /proc/ros"),
            (("/opt/ros/noetic/setup.bash", "/setup.bash"), "cannot have the setup file /setup.bash"),
        ],
    )
    def test_unsupported_profiles_are_rejected_before_startup(
        self, change: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        text = replace_text(locations.find("robots", "turtlebot3_burger").read_text(encoding="utf-8"), *change)
        profile = validate(parse(text, source="robot.yaml"), RobotProfile)
        monkeypatch.setattr("fieldkit.backends.registry.load_profile", lambda _: profile)
        with pytest.raises(ConfigurationError, match=message):
            cast_for(Topology.MASTER)


class TestPlacement:
    LAWN = load_world("lawn")

    def test_master_puts_the_relay_between_the_stations(self) -> None:
        cast = cast_for(Topology.MASTER)
        los = placement_of(Scenario.LOS, Topology.MASTER)
        assert placement.positions_m(cast, los, self.LAWN) == {
            "turtlebot-1": pytest.approx((3.0, 6.0, 0.2)),
            "duckiedrone-1": pytest.approx((13.0, 6.0, 0.2)),
            "turtlebot-2": pytest.approx((23.0, 6.0, 0.2)),
        }
        assert placement.relay(cast, los) == "duckiedrone-1"

    def test_masterless_puts_sender_and_receiver_the_distance_apart(self) -> None:
        cast = cast_for(Topology.MASTERLESS)
        nlos = placement_of(Scenario.NLOS, Topology.MASTERLESS)
        positions = placement.positions_m(cast, nlos, self.LAWN)
        assert positions == {
            "turtlebot-1": pytest.approx((3.0, 18.0, 0.2)),
            "duckiedrone-1": pytest.approx((13.0, 18.0, 0.2)),
        }
        assert placement.relay(cast, nlos) is None
        endpoints = (np.array([positions[name]]) for name in ("turtlebot-1", "duckiedrone-1"))
        assert Obstacles(self.LAWN).crossings(*endpoints) != [()], "the sender is behind the wall"

    def test_a_world_without_a_line_for_the_scenario_is_refused(self) -> None:
        without_lines = self.LAWN.model_copy(update={"lines": {}})
        with pytest.raises(ConfigurationError, match="no line for the positions of robots in the scenario los"):
            placement.positions_m(
                cast_for(Topology.MASTER), placement_of(Scenario.LOS, Topology.MASTER), without_lines
            )


class TestRequirements:
    def test_missing_programs_are_named_with_their_packages(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("os.geteuid", lambda: 0)
        missing_programs = {"sshd", "ping"}
        monkeypatch.setattr(
            "shutil.which", lambda name, **_: None if name in missing_programs else f"/usr/bin/{name}"
        )
        with pytest.raises(ConfigurationError, match="sshd, ping") as error_info:
            requirements.check()
        assert error_info.value.remedy.endswith("iputils-ping openssh-server")

    def test_debians_ros_is_used_if_it_is_installed(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setattr(emulated_options, "ROS_FILES", (str(tmp_path),))
        assert requirements.ros_in_use(RosChoice.AUTO) is RosChoice.DEBIAN
        assert requirements.ros_in_use(RosChoice.BUILTIN) is RosChoice.BUILTIN
        monkeypatch.setattr(emulated_options, "ROS_FILES", (str(tmp_path / "nothing"),))
        assert requirements.ros_in_use(RosChoice.AUTO) is RosChoice.BUILTIN
        with pytest.raises(ConfigurationError, match="not installed"):
            requirements.ros_in_use(RosChoice.DEBIAN)


ROOM = LaserTarget(((2.0, 1.5), (-2.0, 1.5), (-2.0, -1.5), (2.0, -1.5)), 0.0, 0.0, 2.0)
"""Walls around a robot at the origin that faces east."""


class TestMessages:
    @pytest.mark.parametrize("kind", messages.GENERATORS)
    def test_a_message_of_every_type_is_read_back_to_the_last_byte(self, kind: str) -> None:
        data = messages.Source(sensor(kind)).message(7, 1_500_000_000_123_456_789)
        message = read_back(data, kind)
        header = message.transforms[0].header if kind == "tf2_msgs/TFMessage" else message.header
        assert (header.seq, header.stamp.sec, header.stamp.nanosec) == (7, 1_500_000_000, 123_456_789)
        assert header.frame_id == "base_scan"
        assert bytes(STORE.serialize_ros1(message, kind.replace("/", "/msg/"))) == data

    @pytest.mark.parametrize(("path", "value"), FIELDS, ids=[path for path, _ in FIELDS])
    def test_each_number_is_in_its_field(self, path: str, value: float) -> None:
        kind, *names = path.split(".")
        field = read_back(messages.Source(sensor(kind)).message(0, 0), kind)
        for name in names:
            field = field[int(name)] if name.isdecimal() else getattr(field, name)
        assert field == pytest.approx(value, rel=0.01, nan_ok=True)

    def test_noise_has_the_deviation_of_the_sensor(self) -> None:
        source = messages.Source(sensor("sensor_msgs/Imu"))
        imus = [read_back(source.message(number, 0), "sensor_msgs/Imu") for number in range(1000)]
        turns = [imu.angular_velocity.x for imu in imus]
        assert statistics.stdev(turns) == pytest.approx(0.002, rel=0.2)
        assert statistics.mean(turns) == pytest.approx(0.0, abs=0.0005)
        assert statistics.mean(imu.linear_acceleration.z for imu in imus) == pytest.approx(9.80665, abs=0.005)

    def test_the_ranges_of_a_scan_are_the_distances_to_the_walls(self) -> None:
        source = messages.Source(sensor(points=4), [ROOM])
        scans = [read_back(source.message(number, 0), "sensor_msgs/LaserScan") for number in range(200)]
        means_m = [statistics.mean(float(scan.ranges[beam]) for scan in scans) for beam in range(4)]
        assert means_m == pytest.approx([2.0, 1.5, 2.0, 1.5], abs=0.01)

    def test_definitions_are_those_of_ros(self) -> None:
        """The sums are those that Debian's ROS 1 packages announce."""
        assert definition("sensor_msgs/LaserScan").md5 == "90c7ef2dc6895d81024acba2ac42f369"
        assert definition("nav_msgs/Odometry").md5 == "cd5e73d190d741a2f92e81eda573aca7"
        assert "float32[] ranges" in definition("sensor_msgs/LaserScan").text

    @pytest.mark.parametrize("profile", locations.names("robots"))
    def test_the_topics_of_every_profile_can_be_published(self, profile: str) -> None:
        for topic in load_profile(profile).topics:
            sensor_specs.check(_sensor(topic))

    def test_a_scan_has_the_real_size_and_is_within_the_range_of_the_laser(self) -> None:
        data = messages.Source(sensor(), [ROOM]).message(0, 0)
        assert (
            len(data) == 57 + 4 + 8 * 360
        )  # 57 bytes with a frame of 5 letters, 4 more letters, and 8 bytes per beam
        scan = read_back(data, "sensor_msgs/LaserScan")
        low_m, high_m = messages.LASER_RANGE_M
        assert low_m <= scan.ranges.min() <= scan.ranges.max() <= high_m + 1e-6
        assert scan.angle_max == pytest.approx(2 * math.pi * 359 / 360)
        assert scan.scan_time == pytest.approx(0.2)

    def test_equal_robots_publish_equal_messages(self) -> None:
        first, second = (messages.Source(sensor()).message(1, 2) for _ in range(2))
        assert first == second

    def test_a_laser_without_beams_is_refused(self) -> None:
        with pytest.raises(ConfigurationError, match="points"):
            messages.Source(sensor(points=None))


class TestTcpros:
    @given(fields=st.dictionaries(st.from_regex(r"[a-z_]{1,9}", fullmatch=True), st.text()), cut=st.integers(1, 50))
    def test_a_header_is_read_from_chunks_of_any_size(self, fields: dict[str, str], cut: int) -> None:
        stream = framing.pack(framing.pack_header(fields)) + framing.pack(b"message")
        packets = framing.PacketSplitter()
        received_packets: list[bytes] = []
        for start in range(0, len(stream), cut):
            packets.feed(stream[start : start + cut])
            received_packets += packets
        assert framing.unpack_header(received_packets[0]) == fields
        assert received_packets[1:] == [b"message"]
        assert packets.pending == 0

    def test_a_truncated_header_is_rejected(self) -> None:
        with pytest.raises(ValueError, match="within a field"):
            framing.unpack_header(framing.pack_header({"topic": "/scan"})[:-1])

    def test_an_excessive_length_is_rejected(self) -> None:
        packets = framing.PacketSplitter()
        packets.feed(b"\xff\xff\xff\xff")
        with pytest.raises(ValueError, match="longer than"):
            list(packets)

    def test_topics_with_a_common_prefix_have_separate_sockets(self) -> None:
        assert tcpros.socket_path("/a/b") != tcpros.socket_path("/a_b") != tcpros.socket_path("/a")


class TestSystem:
    def test_the_setup_file_finds_ros_in_any_folder(self, tmp_path: Path) -> None:
        setup = tmp_path / "my robot's" / "setup.bash"
        setup.parent.mkdir()
        keys = KeyPair.make(), KeyPair.make()
        spec = robot_spec(
            cast_for(Topology.MASTER), Role.SENDER, ros=RosChoice.BUILTIN, login=keys[0], host_key=keys[1]
        )
        setup.write_text(rootfs.setup_script(spec, setup), encoding="utf-8")
        command = f'. {shlex.quote(str(setup))} && echo "$PATH" && echo "$ROS_DISTRO $ROS_MASTER_URI"'
        result = subprocess.run(
            ["/bin/sh", "-c", command], capture_output=True, text=True, check=True, env={"PATH": "/bin"}
        )
        assert result.stdout == f"{setup.parent}/bin:/bin\nnoetic http://127.0.0.1:11311\n"

    def test_only_outermost_paths_inside_folders_of_the_robot_are_mounted(self) -> None:
        paths = [Path("/opt/a/b"), Path("/opt/a"), Path("/usr/lib"), Path("/root"), Path("/root/.pyenv/x")]
        assert set(mounts._outermost(paths)) == {Path("/opt/a"), Path("/root/.pyenv/x")}

    def test_keys_are_in_openssh_format_and_different_each_time(self) -> None:
        first, second = KeyPair.make(), KeyPair.make()
        assert first.private.startswith("-----BEGIN OPENSSH PRIVATE KEY-----\n")
        assert first.public.startswith("ssh-ed25519 AAAA")
        assert first.public != second.public
