"""Findings of `fieldkit check --ros` on the settings of robots, each with one fault."""

from collections.abc import Mapping

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role, Verdict
from fieldkit.ros.networking import settings
from fieldkit.ros.networking.state import RosProgram, RosState
from fieldkit.trial.check.report import Report
from tests.helpers.casts import ros2_robot

Findings = dict[str, tuple[Verdict, str]]

GOOD_KERNEL = {"net/core/rmem_max": 2**31 - 1, "net/ipv4/ipfrag_time": 3, "net/ipv4/ipfrag_high_thresh": 2**27}


def robot_state(
    variables: Mapping[str, str] | None = None,
    *,
    programs: tuple[RosProgram, ...] = (),
    kernel: Mapping[str, int] = GOOD_KERNEL,
    multicast_interface: str | None = "wlan0",
    tcp_ports: frozenset[int] = frozenset(),
    udp_ports: frozenset[int] = frozenset(),
    rmw_interfaces: tuple[str, ...] = (),
    unreadable_settings: str = "",
    drop_rules: tuple[str, ...] | None = (),
) -> RosState:
    return RosState(
        variables=variables or {},
        programs=programs,
        kernel=kernel,
        multicast_interface=multicast_interface,
        tcp_ports=tcp_ports,
        udp_ports=udp_ports,
        hostname="robot",
        rmw_interfaces=rmw_interfaces,
        unreadable_settings=unreadable_settings,
        drop_rules=drop_rules,
    )


def findings(report: Report) -> Findings:
    return {finding.check: (finding.status, finding.detail) for finding in report.findings}


def judge_state(state: RosState) -> Findings:
    report = Report("r")
    settings.judge_robot(ros2_robot("r"), state, report)
    assert all(finding.remedy for finding in report.findings if finding.status is not Verdict.OK)
    return findings(report)


def test_a_robot_without_a_fault_is_ok() -> None:
    assert {status for status, _ in judge_state(robot_state({"ROS_DISTRO": "humble"})).values()} == {Verdict.OK}


ZENOH = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
OTHER_DOMAIN = RosProgram("talker", {"ROS_DISTRO": "humble", "ROS_DOMAIN_ID": "5"})


@pytest.mark.parametrize(
    ("state", "check", "status", "text"),
    [
        (robot_state({"ROS_LOCALHOST_ONLY": "1"}), "discovery range", Verdict.FAIL, "ROS_LOCALHOST_ONLY=1"),
        (robot_state({"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}), "discovery range", Verdict.FAIL, "RANGE=OFF"),
        (
            robot_state({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "10.0.0.2"}),
            "discovery range",
            Verdict.OK,
            "peers 10.0.0.2",
        ),
        (robot_state({"ROS_DOMAIN_ID": "five"}), "ROS domain", Verdict.FAIL, "'five'"),
        (robot_state(programs=(OTHER_DOMAIN,)), "ROS domain", Verdict.WARN, "its only running ROS program uses 5"),
        (
            robot_state(programs=(OTHER_DOMAIN,) * 2),
            "ROS domain",
            Verdict.WARN,
            "2 of its 2 running ROS programs use 5",
        ),
        (
            robot_state(programs=(RosProgram("a", {"ROS_DISTRO": "humble"}),)),
            "ROS domain",
            Verdict.OK,
            "0; 1 running ROS program in this domain, none in another",
        ),
        (robot_state(programs=(RosProgram("a", ZENOH),)), "RMW", Verdict.WARN, "program uses rmw_zenoh_cpp"),
        (robot_state({"ROS_DISTRO": "galactic"}), "RMW", Verdict.OK, "rmw_cyclonedds_cpp"),
        (robot_state(multicast_interface=None), "multicast route", Verdict.FAIL, "no route"),
        (robot_state(multicast_interface="eth0"), "multicast route", Verdict.WARN, "leave through eth0"),
        (robot_state(rmw_interfaces=("eth0",)), "RMW settings", Verdict.FAIL, "limited to eth0"),
        (robot_state(rmw_interfaces=("eth0", "wlan0")), "RMW settings", Verdict.OK, "limited to eth0, wlan0"),
        (robot_state(unreadable_settings="head: x"), "RMW settings", Verdict.FAIL, "head: x"),
        (robot_state(ZENOH), "Zenoh router", Verdict.FAIL, "TCP port 7447"),
        (robot_state(ZENOH, tcp_ports=frozenset({7447})), "Zenoh router", Verdict.WARN, "does not connect to other"),
        (
            robot_state(ZENOH | {"ZENOH_ROUTER_CONFIG_URI": "r.json5"}, tcp_ports=frozenset({7447})),
            "Zenoh router",
            Verdict.OK,
            "separate configuration file",
        ),
        (
            robot_state(kernel=GOOD_KERNEL | {"net/core/rmem_max": 212_992}),
            "kernel buffers",
            Verdict.WARN,
            "net.core.rmem_max is 212992",
        ),
        (robot_state(kernel={}), "kernel buffers", Verdict.OK, "unknown"),
        (robot_state(drop_rules=("udp drop",)), "firewall", Verdict.WARN, "udp drop"),
        (robot_state(drop_rules=None), "firewall", Verdict.OK, "unknown"),
    ],
)
def test_each_fault_is_reported(state: RosState, check: str, status: Verdict, text: str) -> None:
    actual_status, detail = judge_state(state)[check]
    assert actual_status is status
    assert text in detail


def compare_states(first: RosState, second: RosState) -> Findings:
    cast: dict[Role, Robot] = {Role.SENDER: ros2_robot("a", "10.0.0.1"), Role.RECEIVER: ros2_robot("b", "10.0.0.2")}
    reports = {role: Report(robot.name) for role, robot in cast.items()}
    states = {Role.SENDER: first, Role.RECEIVER: second}
    settings.judge_agreement(cast, states, reports)
    settings.judge_servers(cast, states, reports)
    return findings(reports[Role.RECEIVER])


@pytest.mark.parametrize(
    ("variables", "check", "status"),
    [
        ({"ROS_DOMAIN_ID": "1"}, "same ROS domain", Verdict.FAIL),
        (ZENOH, "same RMW", Verdict.FAIL),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, "same RMW", Verdict.WARN),
        ({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}, "same RMW", Verdict.OK),
        ({"ROS_DISTRO": "jazzy"}, "same ROS distribution", Verdict.WARN),
        ({"ROS_DISCOVERY_SERVER": "10.0.0.1:11811"}, "same discovery server", Verdict.FAIL),
        ({"ROS_DISCOVERY_SERVER": "10.0.0.1:11811"}, "discovery server", Verdict.FAIL),
        ({"ROS_DISCOVERY_SERVER": "10.0.0.9:11811"}, "discovery server", Verdict.OK),
    ],
)
def test_settings_that_differ_between_robots_are_reported(
    variables: Mapping[str, str], check: str, status: Verdict
) -> None:
    assert compare_states(robot_state({"ROS_DISTRO": "humble"}), robot_state(variables))[check][0] is status


def test_an_invalid_domain_is_reported_as_it_is_written() -> None:
    _, detail = compare_states(robot_state({}), robot_state({"ROS_DOMAIN_ID": "five"}))["same ROS domain"]
    assert detail == "domain five, but a is in domain 0: their nodes do not discover each other"


def test_a_discovery_server_that_runs_is_ok() -> None:
    variables = {"ROS_DISCOVERY_SERVER": "10.0.0.1"}
    first = robot_state(variables, udp_ports=frozenset({11811}))
    assert compare_states(first, robot_state(variables))["discovery server"][0] is Verdict.OK
