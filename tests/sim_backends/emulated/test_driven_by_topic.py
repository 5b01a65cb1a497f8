"""A step moves an emulated robot by its velocity topic only if the topic is unique; the lab moves all others."""

from pathlib import Path

import pytest

from fieldkit.config.site import load_site
from fieldkit.core.model import Topology
from sim_backends.emulated.backend import EmulatedBackend
from tests.helpers import texts
from tests.helpers.paths import ROOT

SITE = texts.site({"one": "one", "two": "two", "drone": "duckiedrone"}, emulated="ros: ROS")
OWN_TOPICS = {
    "/cmd_vel, odometry: /odom": "/two/cmd_vel, odometry: /two/odom",
    "{name: /odom,": "{name: /two/odom,",
}
ROS2 = {"variant: ros1": "variant: ros2"}
ZENOH = ROS2 | {"distribution: foxy": "distribution: jazzy\n      rmw: zenoh"}
DOMAIN = {"\nlimits:": "\n  environment: {ROS_DOMAIN_ID: '7'}\nlimits:"}


def write_profile(folder: Path, name: str, changes: dict[str, str]) -> None:
    text = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    for old_text, new_text in ({"name: turtlebot3_burger": f"name: {name}"} | changes).items():
        assert old_text in text
        text = text.replace(old_text, new_text)
    (folder / f"{name}.yaml").write_text(text, encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("profiles", "ros", "drives"),
    [
        (({}, {}), "debian", {"one", "two"}),
        (({}, {}), "builtin", set()),
        ((ROS2, ROS2), "auto", set()),
        ((ROS2, ROS2 | OWN_TOPICS), "auto", {"one", "two"}),
        ((ROS2, ROS2 | OWN_TOPICS), "builtin", set()),
        ((ROS2 | DOMAIN, ROS2), "auto", {"one", "two"}),
        ((ZENOH, ROS2), "auto", {"one", "two"}),
        ((ZENOH, ZENOH), "auto", set()),
        ((ZENOH, ZENOH | OWN_TOPICS), "auto", {"one", "two"}),
        ((ZENOH, ZENOH | OWN_TOPICS), "auto, ros2: {discovery: router, router: drone}", set()),
    ],
)
def test_robots_are_driven_by_topic_only_if_no_other_robot_subscribes_to_it(
    folder: Path, profiles: tuple[dict[str, str], dict[str, str]], ros: str, drives: set[str]
) -> None:
    assert driven_robots(folder, profiles, SITE.replace("ROS", ros)) == drives


@pytest.mark.parametrize(("changes_of_two", "drives"), [({}, set()), (OWN_TOPICS, {"one", "two"})])
def test_on_a_shared_master_topics_must_differ(
    folder: Path, changes_of_two: dict[str, str], drives: set[str]
) -> None:
    text = SITE.replace("ROS", "debian") + "ros_master: relay\n"
    assert driven_robots(folder, ({}, changes_of_two), text) == drives


def driven_robots(folder: Path, profiles: tuple[dict[str, str], dict[str, str]], site: str) -> set[str]:
    """Return the names of the robots of a site file that are driven by their topic."""
    for name, changes in zip(("one", "two"), profiles, strict=True):
        write_profile(folder / "robots", name, changes)
    (folder / "fieldkit.yaml").write_text(site, encoding="utf-8")
    cast = EmulatedBackend(*load_site(folder / "fieldkit.yaml")).cast(Topology.MASTER)
    return {robot.name for robot in cast.values() if "drive" in robot.abilities}
