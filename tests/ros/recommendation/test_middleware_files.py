"""Configuration files of middlewares: the middleware reads its file and uses the settings in it."""

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.ros.middlewares import tuning
from fieldkit.ros.recommendation import configurations
from tests.helpers.paths import ROOT

COMMENT = ["a trial -- with --- dashes -->", "loss 0 %\n*/ of 5 repeats"]


SOCKETS = """
import os, subprocess, sys, time, rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("x")
ends = node.create_publisher(String, "x", 1), node.create_subscription(String, "x", print, 1)
until_s = time.monotonic() + 30
while time.monotonic() < until_s:
    lines = subprocess.run(["ss", "-tulnpH"], capture_output=True, text=True).stdout.splitlines()
    own = [line.split()[0] for line in lines if f"pid={os.getpid()}," in line]
    if own.count("udp") >= 3 and own.count("tcp") == int(sys.argv[1]):
        break
    time.sleep(0.1)
print(own.count("tcp"))
"""


def run(*argv: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(
    "settings", [{}, tuning.recommended_settings("dds", "tcp"), {"Discovery/Tag@x": "1", "No/Such": "1"}]
)
def test_cyclonedds_reads_its_file(tmp_path: Path, settings: dict[str, str]) -> None:
    path = tmp_path / "cyclonedds.xml"
    path.write_text(configurations.configuration_text("dds", "tcp", settings, COMMENT), encoding="utf-8")
    program = "from cyclonedds.domain import DomainParticipant; DomainParticipant(71)"
    completed = run(sys.executable, "-c", program, CYCLONEDDS_URI=f"file://{path}")
    is_known = "No/Such" not in settings
    assert (completed.returncode == 0) == is_known, completed.stderr
    for name, value in settings.items():
        assert value in path.read_text(encoding="utf-8"), name


@pytest.mark.parametrize("middleware", ["dds", "ros2"])
def test_any_comment_leaves_the_xml_well_formed(middleware: str) -> None:
    text = configurations.configuration_text(middleware, "udp", {}, COMMENT)
    assert ET.fromstring(text.encode()).tag


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_zenoh_reads_its_file(tmp_path: Path, transport: str) -> None:
    zenoh = pytest.importorskip("zenoh")
    path = tmp_path / "zenoh.json5"
    settings = tuning.recommended_settings("zenoh", transport)
    path.write_text(configurations.configuration_text("zenoh", transport, settings, COMMENT), encoding="utf-8")
    config = zenoh.Config.from_file(str(path))
    for name, text in settings.items():
        actual, expected = json.loads(config.get_json(name)), json.loads(text)
        pairs = zip(actual, expected, strict=True) if isinstance(expected, list) else []
        assert actual == expected or all(
            {key: actual_entry["config"][key] for key in entry["config"]} == entry["config"]
            for actual_entry, entry in pairs
        )
    zenoh.open(config).close()


@pytest.mark.emulated
@pytest.mark.parametrize(("transports", "loads"), [("LARGE_DATA", True), ("DEFAULT", True), ("NO_SUCH", False)])
def test_fast_dds_reads_its_file(tmp_path: Path, transports: str, *, loads: bool) -> None:
    path = tmp_path / "fastdds.xml"
    settings = {"FASTDDS_BUILTIN_TRANSPORTS": transports}
    path.write_text(configurations.configuration_text("ros2", "tcp", settings, COMMENT), encoding="utf-8")
    python = str(ROOT / ".ros2" / "bin" / "python")
    expected = str(int(transports == "LARGE_DATA"))
    completed = run(
        python,
        "-c",
        SOCKETS,
        expected,
        FASTDDS_DEFAULT_PROFILES_FILE=str(path),
        ROS_DOMAIN_ID="73",
        HOME=str(tmp_path),
        PATH=os.environ["PATH"],
    )
    assert completed.returncode == 0, completed.stderr
    assert ("XML" not in completed.stderr + completed.stdout) == loads, completed.stderr
    # Only LARGE_DATA listens on TCP.
    assert completed.stdout.splitlines()[-1] == expected, completed.stdout


def test_a_setting_that_a_file_cannot_contain_is_rejected() -> None:
    with pytest.raises(ConfigurationError, match="cannot contain FASTDDS_X"):
        configurations.configuration_text("ros2", "tcp", {"FASTDDS_X": "1"}, [])
    with pytest.raises(ConfigurationError, match="cannot contain rmw_cyclonedds_cpp"):
        configurations.configuration_text("ros2", "tcp", {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, [])
    with pytest.raises(ConfigurationError, match="ros1 has no configuration file"):
        configurations.configuration_text("ros1", "tcp", {}, [])
