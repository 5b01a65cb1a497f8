"""The state of a robot that `fieldkit check --ros` reads, parsed from outputs of real programs."""

import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.ros.networking import state
from fieldkit.trial.check import probe

NFTABLES = """\
table inet filter {
	chain input {
		type filter hook input priority filter; policy accept;
		ct state invalid drop
		ip daddr 239.255.0.1 counter packets 12 bytes 4032 drop
		jump wifi
	}
	chain wifi {
		iifname "wlan0" udp dport 7410 reject
	}
	chain output {
		type filter hook output priority filter; policy drop;
		tcp dport 25 drop
	}
}
"""
IPTABLES = """\
-P INPUT DROP
-P FORWARD DROP
-A INPUT -i lo -j ACCEPT
-A INPUT -p udp -m udp --dport 7400 -j REJECT --reject-with icmp-port-unreachable
-A FORWARD -j DROP
"""
SOCKETS = """\
  12: 00000000:1D17 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 5 1 0 100 0 0 10 0
 341: 00000000:2E23 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 7 2 0 0
   0: 00000000000000000000000000000000:0016 00000000000000000000000000000000:0000 0A 0:0 00:0 0 0 0 8 1
"""


def output(**sections: str) -> str:
    return "".join(f"==> {name.replace('_', '-')}: 0 <==\n{text}\n" for name, text in sections.items())


def parse_sections(**sections: str) -> state.RosState:
    return state.parse(probe.parse(output(**sections)))


def test_only_rules_that_drop_received_packets_are_listed() -> None:
    assert parse_sections(nftables=NFTABLES, iptables=IPTABLES).drop_rules == (
        "ct state invalid drop",
        "ip daddr 239.255.0.1 counter packets 12 bytes 4032 drop",
        'iifname "wlan0" udp dport 7410 reject',
        "-P INPUT DROP",
        "-A INPUT -p udp -m udp --dport 7400 -j REJECT --reject-with icmp-port-unreachable",
    )


def test_unreadable_rules_are_unknown_and_not_absent() -> None:
    text = "==> nftables: 1 <==\nOperation not permitted\n==> iptables: 127 <==\nnot found\n"
    assert state.parse(probe.parse(text)).drop_rules is None
    assert parse_sections(nftables="").drop_rules == ()


def test_environment_programs_and_sockets_are_parsed() -> None:
    robot = parse_sections(
        environment="ROS_DISTRO=jazzy\nROS_DOMAIN_ID=7",
        programs="program talker\nROS_DISTRO=jazzy\nROS_DOMAIN_ID=3\nprogram rviz2\nROS_DISTRO=jazzy",
        listeners=SOCKETS,
        route="multicast 239.255.0.1 dev wlan0 src 10.42.0.1 uid 0 \\    cache <mc>",
        kernel="net/core/rmem_max 212992\nnet/ipv4/ipfrag_time 30\nnet/core/x many",
        hostname="turtlebot",
    )
    assert robot.variables == {"ROS_DISTRO": "jazzy", "ROS_DOMAIN_ID": "7"}
    assert [(program.name, program.variables.get("ROS_DOMAIN_ID")) for program in robot.programs] == [
        ("talker", "3"),
        ("rviz2", None),
    ]
    assert robot.tcp_ports == {7447, 22}
    assert robot.udp_ports == {11811}
    assert robot.multicast_interface == "wlan0"
    assert robot.kernel == {"net/core/rmem_max": 212992, "net/ipv4/ipfrag_time": 30}
    assert robot.hostname == "turtlebot"


CYCLONEDDS = """
<CycloneDDS><Domain><General><Interfaces>
  <NetworkInterface autodetermine="false" name="eth0" priority="default" />
  <NetworkInterface address='10.0.0.1'/>
</Interfaces><NetworkInterfaceAddress>wlp2s0</NetworkInterfaceAddress></General></Domain></CycloneDDS>
"""
FAST_DDS = """
<transport_descriptor><type>UDPv4</type>
<interfaceWhiteList><address>192.168.1.5</address><interface>wlan1</interface></interfaceWhiteList>
</transport_descriptor><address>10.9.9.9</address>
"""


def test_the_interfaces_in_the_settings_of_the_rmw_are_parsed() -> None:
    names = ("eth0", "10.0.0.1", "wlp2s0", "192.168.1.5", "wlan1")
    assert parse_sections(cyclonedds=CYCLONEDDS, fastdds=FAST_DDS).rmw_interfaces == names
    assert parse_sections(cyclonedds="<NetworkInterface autodetermine='true'/>", fastdds="").rmw_interfaces == ()
    missing = state.parse(probe.parse("==> cyclonedds: 1 <==\nhead: cannot open 'x' for reading\n"))
    assert missing.unreadable_settings == "head: cannot open 'x' for reading"


@given(st.text(max_size=2000))
def test_any_output_is_parsed(text: str) -> None:
    state.parse(probe.parse(text))
    parse_sections(
        cyclonedds=text,
        fastdds=text,
        programs=text,
        listeners=text,
        kernel=text,
        nftables=text,
        environment=text,
        route=text,
    )


@pytest.mark.parametrize("shell", ["dash", "bash"])
def test_the_script_reads_the_state_of_this_machine(shell: str) -> None:
    environment = {
        "PATH": "/usr/bin:/bin:/usr/sbin:/sbin",
        "ROS_DISTRO": "humble",
        "ROS_DOMAIN_ID": "5",
        "SECRET": "x",
    }
    completed = subprocess.run(
        [shell, "-s"], input=state.SCRIPT.encode(), env=environment, capture_output=True, timeout=60, check=True
    )
    assert b"SECRET" not in completed.stdout
    robot = state.parse(probe.parse(completed.stdout.decode()))
    assert robot.variables == {"ROS_DISTRO": "humble", "ROS_DOMAIN_ID": "5"}
    assert {shell, "tr"} & {program.name for program in robot.programs}, "the script's own shell has the variables"
    assert robot.hostname
