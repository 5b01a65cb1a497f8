"""`fieldkit check --ros` end to end, on robots with ROS 2 and with faults in their network namespaces."""

from pathlib import Path

import pytest

from fieldkit.config.locations import SITE_FILE
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Topology
from sim_backends.emulated.backend import DEFAULT_SITE
from tests.helpers.field_robots import start_field_robots
from tests.helpers.labs import copy_shipped, replace_text
from tests.helpers.runs import run_here

pytestmark = pytest.mark.emulated

FIREWALL = """\
table inet faults {
  chain early { type filter hook prerouting priority -450; ip frag-off & 0x1fff != 0 drop; }
  chain input { type filter hook input priority 0; ip daddr 239.255.0.1 drop; }
}
"""


def test_faults_of_the_ros_network_are_reported_with_evidence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    copy_shipped(tmp_path, "robots", "turtlebot3_burger", "variant: ros1", "variant: ros2")
    environment = "  environment: {ROS_DOMAIN_ID: '7', ROS_AUTOMATIC_DISCOVERY_RANGE: 'OFF'}\n  topics:"
    changes = (
        "variant: ros1",
        "variant: ros2",
        "name: turtlebot3_burger",
        "name: misconfigured",
        "  topics:",
        environment,
    )
    copy_shipped(tmp_path, "robots", "turtlebot3_burger", *changes, called="misconfigured")
    shipped = DEFAULT_SITE.read_text(encoding="utf-8")
    site = replace_text(shipped, "turtlebot-2: {profile: turtlebot3_burger", "turtlebot-2: {profile: misconfigured")
    # The emulated Wi-Fi would sometimes lose one of the datagrams.
    options = "emulated: {ros: builtin, late_bound: 2s, radio: {loss: 0%}}"
    (tmp_path / "lab.yaml").write_text(f"{site}\n{options}\n", encoding="utf-8")
    with start_field_robots(tmp_path, topology=Topology.MASTER, site=tmp_path / "lab.yaml") as robots:
        robots.testbed.shells[Role.RECEIVER].run(
            ("nft", "-f", "-"), stdin=FIREWALL.encode(), deadline=Deadline.after(60)
        )
        run = run_here(tmp_path, "check", "--ros", "--topology", "master", "--json")
        for shell in robots.testbed.shells.values():
            file_names = shell.run(("ls", ".fieldkit"), deadline=Deadline.after(60)).stdout.decode().split()
            assert [name for name in file_names if not name.startswith(("job-", "agent-"))] == []
    findings = {(finding["robot"], finding["check"]): finding for finding in run.events("finding")}
    statuses = {key: finding["status"] for key, finding in findings.items() if finding["status"] != "ok"}
    assert statuses == {
        ("turtlebot-2", "discovery range"): "fail",
        ("turtlebot-2", "firewall"): "warn",
        ("turtlebot-2", "same ROS domain"): "fail",
        ("turtlebot-2", "multicast from turtlebot-1"): "fail",
        ("turtlebot-2", "fragments from turtlebot-1"): "fail",
    }
    assert all(findings[key]["remedy"] for key in statuses)
    assert run.code == 3
    details = {key: finding["detail"] for key, finding in findings.items()}
    assert "0 of 20" in details["turtlebot-2", "fragments from turtlebot-1"]
    assert "ip daddr 239.255.0.1 drop" in details["turtlebot-2", "firewall"]
    assert details["turtlebot-1", "multicast from turtlebot-2"] == "20 of 20 datagrams"
    assert details["turtlebot-2", "UDP from turtlebot-1"] == "20 of 20 datagrams"
    assert details["turtlebot-1", "fragments from turtlebot-2"] == "20 of 20 datagrams of 8000 B (6 fragments)"
    assert details["duckiedrone-1", "ROS network"].endswith("its topics do not reach other robots")
    assert (tmp_path / SITE_FILE).is_file()
    assert not (tmp_path / "trials").exists()
