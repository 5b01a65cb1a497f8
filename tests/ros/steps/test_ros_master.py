"""A shared ROS master: the environment of robots, the preflight check, and errors of the site file."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from fieldkit.backends import registry
from fieldkit.backends.protocols import Cast
from fieldkit.cli.dry_run import shell_line
from fieldkit.config import schema
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol, RepeatId, Role, Topology, Verdict
from fieldkit.core.units import parse_distance
from fieldkit.ros.steps import ros_master, topic_check
from fieldkit.ros.steps.record import RecordStep
from fieldkit.steps.scene import CommandResult, Scene
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.casts import CAST, TURTLEBOT, los_plan
from tests.helpers.labs import BOX
from tests.helpers.plans import steps_of

SHARED = {role: robot.model_copy(update={"ros_master": "10.42.0.3"}) for role, robot in CAST.items()}
ADDRESSES = {"turtlebot-1": "10.0.0.1", "turtlebot-2": "10.0.0.2", "duckiedrone-1": "10.0.0.3"}
SITE = """\
backend: field
robots:
  turtlebot-1: {profile: turtlebot3_burger}
  turtlebot-2: {profile: turtlebot3_burger}
  duckiedrone-1: {profile: duckiedrone}
roles:
  master: {sender: turtlebot-1, receiver: turtlebot-2, relay: duckiedrone-1}
  masterless: {sender: turtlebot-1, receiver: duckiedrone-1}
ros_master: relay
"""


def site(text: str) -> tuple[Site, schema.Document]:
    document = schema.parse(text, source="fieldkit.yaml")
    return schema.validate(document, Site), document


def test_commands_have_the_master_address_and_the_radio_address_of_the_robot() -> None:
    (record,) = steps_of(load_procedure("los"), RecordStep)
    (planned,) = record.jobs(Scene(Protocol.TCP, SHARED, "f"))
    assert shell_line(planned.job) == (
        """bash -c '. /opt/ros/noetic/setup.bash && exec "$@"' bash env ROS_MASTER_URI=http://10.42.0.3:11311 """
        "ROS_HOSTNAME=10.42.0.1 rosbag record --duration=15 -O scan /scan 2> sender-record.log"
    )


def test_shared_master_overrides_variables_of_profile() -> None:
    assert TURTLEBOT.ros is not None
    response = {"ROS_HOSTNAME": "localhost", "ROS_NAMESPACE": "tb1"}
    profile = TURTLEBOT.model_copy(update={"ros": TURTLEBOT.ros.model_copy(update={"environment": response})})
    robot = CAST[Role.SENDER].model_copy(update={"profile": profile})
    assert robot.ros_environment == response
    shared = robot.model_copy(update={"ros_master": "10.42.0.3"}).ros_environment
    assert shared == {
        "ROS_HOSTNAME": "10.42.0.1",
        "ROS_NAMESPACE": "tb1",
        "ROS_MASTER_URI": "http://10.42.0.3:11311",
    }


def test_master_is_set_only_if_its_role_is_cast() -> None:
    robots = registry.cast_of(*site(SITE), Topology.MASTER, ADDRESSES)
    assert {robot.ros_master for robot in robots.values()} == {"10.0.0.3"}
    masterless = registry.cast_of(*site(SITE), Topology.MASTERLESS, ADDRESSES)
    assert {robot.ros_master for robot in masterless.values()} == {""}


@pytest.mark.parametrize("role", ["drone", "rival"])
def test_master_role_without_robot_is_rejected(role: str) -> None:
    text = SITE.replace("ros_master: relay", f"ros_master: {role}")
    with pytest.raises(ConfigurationError, match="one of the assigned roles: sender, receiver, relay") as caught:
        site(text)
    assert caught.value.where == "fieldkit.yaml:9"


def test_master_on_robot_without_ros_1_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ConfigurationError, match="duckiedrone-1 has the role relay, but its profile box has no ROS 1"
    ) as caught:
        registry.cast_of(*site(SITE.replace("profile: duckiedrone}", "profile: box}")), Topology.MASTER, ADDRESSES)
    assert caught.value.where == "fieldkit.yaml:9"


def test_preflight_checks_only_shared_masters() -> None:
    record = RecordStep.model_validate({"robot": "receiver", "topics": ("/scan",), "duration": "1s"})
    separate, shared = (
        {need.name: need for need in record.needs(Scene(Protocol.TCP, cast, "f"))} for cast in (CAST, SHARED)
    )
    assert separate.keys() == {"ROS"}
    assert shared.keys() == {"ROS", "ROS master"}
    assert shared["ROS master"].missing_program == "rosbag", "there is no test recording without a master"
    assert shared["ROS"].argv[-3:] == ("sh", "-c", 'echo "$ROS_DISTRO $ROS_MASTER_URI"')


@pytest.mark.parametrize(
    ("response", "detail"),
    [
        (
            CommandResult(
                "bash: connect: No route to host\nbash: line 1: /dev/tcp/10.42.0.3/11311: No route to host", 1
            ),
            "route",
        ),
        (CommandResult("", 124), "no output"),
        (CommandResult("HTTP/1.0 404 Not Found", 0), "404"),
        (CommandResult("SSH-2.0-OpenSSH_9.2p1", 0), "SSH"),
    ],
)
def test_invalid_answer_of_master_fails_with_remedy(response: CommandResult, detail: str) -> None:
    verdict, detail_text, remedy = ros_master.judge(SHARED[Role.RELAY], response)
    assert verdict is Verdict.FAIL
    assert detail_text.startswith("no master answers at duckiedrone-1, 10.42.0.3:11311: ")
    assert detail in detail_text
    assert remedy.startswith("on duckiedrone-1: ROS_HOSTNAME=10.42.0.3 roscore ")


def test_battery_topics_of_shared_master_are_ambiguous() -> None:
    plan = los_plan()
    assert not any(topic_check.has_shared_battery(plan, role) for role in plan.cast)
    shared = plan.model_copy(update={"cast": SHARED})
    has_shared = {role: topic_check.has_shared_battery(shared, role) for role in SHARED}
    assert has_shared == {Role.SENDER: True, Role.RECEIVER: True, Role.RELAY: False}


def test_profiles_hash_depends_on_sharing_but_not_on_addresses() -> None:
    separate, shared = (plan_of(cast).profiles_sha256 for cast in (CAST, SHARED))
    assert separate != shared
    moved_cast = {
        role: robot.model_copy(update={"address": f"10.9.9.{number}", "ros_master": "10.9.9.2"})
        for number, (role, robot) in enumerate(SHARED.items())
    }
    assert plan_of(moved_cast).profiles_sha256 == shared


def plan_of(cast: Cast, procedure: str = "los") -> Plan:
    request = TrialRequest(procedure=load_procedure(procedure), distance=parse_distance("30ft"))
    return make_plan(request, backend="field", cast=cast, now=datetime(2026, 11, 20, 12, 0, tzinfo=UTC))


def test_masterloss_requires_a_shared_master() -> None:
    with pytest.raises(ConfigurationError, match="procedure masterloss needs one ROS master") as caught:
        plan_of(CAST, "masterloss")
    assert "ros_master: relay" in caught.value.remedy
    plan = plan_of(SHARED, "masterloss")
    names = {column.name for column in plan.columns or ()}
    assert names >= {"before.bag_discovery_s", "through.bag_gap_s", "after.bag_discovered", "again.bag_messages"}
    assert plan.scene(RepeatId(Protocol.TCP, 1), "f").cast == SHARED
