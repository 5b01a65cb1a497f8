"""Findings of `fieldkit check --ros` on test datagrams, and the counts that a robot sends."""

import json
from collections.abc import Mapping

import pytest

from fieldkit.core.errors import RobotError
from fieldkit.core.model import Verdict
from fieldkit.ros.networking.exchange import Arrivals, multicast_port, parse_counts, unicast_port
from fieldkit.ros.networking.reachability import judge_arrivals
from fieldkit.trial.check.report import Report
from tests.helpers.casts import ros2_robot
from tests.ros.networking.test_settings import findings, robot_state

ALL = {"unicast": 20, "multicast": 20, "fragmented": 20}


@pytest.mark.parametrize(
    ("counts", "bad_checks"),
    [
        (ALL, {}),
        (ALL | {"multicast": 0}, {"multicast from a": Verdict.FAIL}),
        (ALL | {"fragmented": 0}, {"fragments from a": Verdict.FAIL}),
        (ALL | {"fragmented": 11}, {"fragments from a": Verdict.WARN}),
        (ALL | {"unicast": 18, "multicast": 17}, {"multicast from a": Verdict.WARN}),
        ({}, {"UDP from a": Verdict.FAIL, "multicast from a": Verdict.FAIL}),
    ],
)
def test_missing_datagrams_are_reported(counts: Mapping[str, int], bad_checks: Mapping[str, Verdict]) -> None:
    report = Report("b")
    judge_arrivals(ros2_robot("a"), Arrivals(counts), robot_state(), 0, report, ros2=True)
    statuses = {check: status for check, (status, _) in findings(report).items() if status is not Verdict.OK}
    assert statuses == bad_checks


def test_a_firewall_rule_is_named_and_peers_need_no_multicast() -> None:
    report = Report("b")
    state = robot_state({"ROS_STATIC_PEERS": "10.0.0.1"}, drop_rules=("udp dport 7400-7649 drop",))
    judge_arrivals(ros2_robot("a"), Arrivals({}), state, 0, report, ros2=True)
    assert list(findings(report)) == ["UDP from a"]
    assert "firewall: udp dport 7400-7649 drop" in report.findings[0].detail
    assert "7400:7649" in report.findings[0].remedy


def test_a_failed_exchange_is_not_reported_as_an_absence_of_datagrams() -> None:
    report = Report("b")
    judge_arrivals(ros2_robot("a"), Arrivals({}, "a: no answer"), robot_state(), 0, report, ros2=True)
    assert findings(report) == {"datagrams from a": (Verdict.FAIL, "not tested: a: no answer")}


def test_ports_are_those_of_the_domain() -> None:
    # RTPS 2.5, section 9.6.2.3: PB 7400, DG 250, d0 0, d1 10, PG 2.
    assert (multicast_port(0), multicast_port(3)) == (7400, 8150)
    assert unicast_port(3) == 7400 + 250 * 3 + 10 + 2 * 119 < multicast_port(4)


@pytest.mark.parametrize(
    "output",
    [
        b"",
        b"[]",
        b"{",
        b"[" * 100_000,
        b'{"10.0.0.1": 3}',
        b'{"a": {"unicast": -1}}',
        b'{"a": {"unicast": true}}',
        b'{"a": {"x": 1}}',
        b'{"a": {"unicast": 21}}',
    ],
)
def test_invalid_counts_of_a_robot_are_an_error(output: bytes) -> None:
    with pytest.raises(RobotError, match="sent no counts"):
        parse_counts(output)
    assert parse_counts(json.dumps({"10.0.0.1": ALL}).encode()) == {"10.0.0.1": ALL}
