"""The check of topics and of the ROS environment of a robot."""

from types import MappingProxyType

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Role, Verdict
from fieldkit.measure.evidence.recordings import RecordingContents
from fieldkit.ros.steps import topic_check
from fieldkit.steps import variants
from fieldkit.steps.scene import CommandResult
from fieldkit.trial.check import software
from fieldkit.trial.check.probe import Sections
from fieldkit.trial.check.report import Report
from fieldkit.trial.check.software import ProbeResult
from tests.helpers.casts import TURTLEBOT, ros_of
from tests.trial.check.test_check_judges import (
    FAIL,
    OK,
    PLAN,
    RELAY,
    SENDER,
    WARN,
    installed,
    judge_all,
    only,
    procedure_of,
)


def probe_result(sections: Sections) -> ProbeResult:
    return ProbeResult(sections, variants.expected(TURTLEBOT))


def test_a_robot_without_ros_needs_no_recorder_and_no_topic() -> None:
    procedure = procedure_of("ping: {from: sender, to: receiver}")
    robot = SENDER.model_copy(update={"profile": TURTLEBOT.model_copy(update={"ros": None})})
    plan = PLAN.model_copy(update={"cast": {**PLAN.cast, Role.SENDER: robot}, "procedure": procedure})
    sections = installed(plan)
    assert {finding.status for finding in judge_all(sections, plan)} == {OK}
    assert not any("ros" in " ".join(argv) for argv in software.commands(plan, Role.SENDER).values())
    assert topic_check.can_record(plan, Role.SENDER, probe_result(sections))
    assert topic_check.battery_of(robot) == ""
    assert topic_check.required_topics(plan, Role.SENDER) == ()


def test_a_recording_on_a_robot_without_ros_is_rejected() -> None:
    robot = SENDER.model_copy(update={"profile": TURTLEBOT.model_copy(update={"ros": None})})
    plan = PLAN.model_copy(update={"cast": {**PLAN.cast, Role.SENDER: robot}})
    with pytest.raises(ConfigurationError, match="cannot record: its profile turtlebot3_burger has no ros"):
        plan.scenes()


def test_a_missing_setup_file_is_one_failure() -> None:
    missing = "bash: line 1: /opt/ros/noetic/setup.bash: No such file or directory"
    sections = installed() | {"ROS": CommandResult(missing, 1), "program rosbag": CommandResult(missing, 1)}
    (failed,) = [finding for finding in judge_all(sections) if finding.status is not OK]
    assert (failed.check, failed.detail) == ("ROS", missing)
    assert not topic_check.can_record(PLAN, Role.SENDER, probe_result(sections))
    assert topic_check.can_record(PLAN, Role.RECEIVER, probe_result({})), (
        "a robot without recordings needs no recorder"
    )


def test_ros_1_without_a_master_is_a_warning() -> None:
    (warning,) = [
        finding
        for finding in judge_all(installed() | {"ROS": CommandResult("noetic", 0)})
        if finding.status is not OK
    ]
    assert "ROS_MASTER_URI" in warning.detail


def recorded_scans(count: int, span_s: float) -> RecordingContents:
    return RecordingContents(count, 0, span_s, MappingProxyType({"/scan": count}))


@pytest.mark.parametrize(
    ("bag", "status"),
    [
        (recorded_scans(10, 1.8), OK),
        (recorded_scans(8, 1.5), OK),
        (recorded_scans(2, 1.9), WARN),
        (recorded_scans(30, 1.9), WARN),
        (recorded_scans(1, 0.0), OK),
        (recorded_scans(0, 0.0), FAIL),
        (None, FAIL),
    ],
)
def test_a_topic_must_be_published_and_should_have_its_rate(bag: RecordingContents | None, status: Verdict) -> None:
    report = Report("turtlebot-1")
    topic_check.judge(SENDER, ["/scan"], bag, report)
    assert only(report.findings, "topic /scan").status is status


def test_a_topic_missing_in_the_profile_has_no_rate() -> None:
    report = Report("turtlebot-1")
    topic_check.judge(
        SENDER, ["/tf_static"], RecordingContents(3, 0, 1.0, MappingProxyType({"/tf_static": 3})), report
    )
    assert only(report.findings, "topic /tf_static").status is OK


def test_a_check_records_long_enough_for_the_slowest_topic() -> None:
    assert topic_check.required_topics(PLAN, Role.SENDER) == ("/scan",)
    assert topic_check.required_topics(PLAN, Role.RELAY) == ()
    assert topic_check.recording_step(Role.SENDER, SENDER, ["/scan"]).duration == topic_check.RECORD_S
    assert topic_check.recording_step(Role.RELAY, RELAY, ["/pidrone/battery"]).duration == 2.0, "two messages at 1 Hz"
    topic = ros_of(RELAY.profile).topics[0].model_copy(update={"name": "/slow", "rate": 0.2})
    ros = ros_of(RELAY.profile).model_copy(update={"topics": (topic,)})
    slow_robot = RELAY.model_copy(update={"profile": RELAY.profile.model_copy(update={"ros": ros})})
    assert topic_check.recording_step(Role.RELAY, slow_robot, ["/slow"]).duration == 10.0
    profile = TURTLEBOT.model_copy(update={"ros": ros_of(TURTLEBOT).model_copy(update={"variant": "ros2"})})
    ros2 = SENDER.model_copy(update={"profile": profile})
    assert topic_check.recording_step(Role.SENDER, ros2, ["/scan"]).duration == 6.0, (
        "a recorder that fieldkit stops needs additional time to start"
    )
    assert topic_check.battery_of(RELAY) == "/pidrone/battery"
    assert topic_check.battery_of(slow_robot) == ""
