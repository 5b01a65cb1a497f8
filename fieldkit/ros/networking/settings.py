"""Findings on the ROS settings of one robot, and on settings that must agree between robots.

Sources: docs.ros.org, "The ROS_DOMAIN_ID", "Improved Dynamic Discovery", "DDS tuning information" and "Discovery
Server"; wiki.ros.org/ROS/NetworkSetup; github.com/ros2/rmw_zenoh, README.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.config.locations import copy_profile_command
from fieldkit.core.model import Role
from fieldkit.core.units import format_count
from fieldkit.ros.networking.exchange import multicast_port
from fieldkit.ros.networking.state import RosProgram, RosState, Variables
from fieldkit.trial.check.report import Report

DEFAULT_RMW: Final = "rmw_fastrtps_cpp"
"""Default RMW (ROS middleware implementation) of the distributions from Foxy to Kilted except Galactic (REP 2000)."""
_GALACTIC_RMW: Final = "rmw_cyclonedds_cpp"
"""Default RMW of Galactic (REP 2000)."""
_ZENOH_PORT: Final = 7447
_SERVER_PORT: Final = 11811
"""Default port of a discovery server of Fast DDS."""
_RECOMMENDED_KERNEL: Final = {
    # "DDS tuning information": it sets SocketReceiveBufferSize of Cyclone DDS to 10 MB, which rmem_max must allow.
    "net/core/rmem_max": (10_485_760, "at least", "a burst of fragments of a large sample exceeds the buffer"),
    "net/ipv4/ipfrag_time": (3, "at most", "incomplete datagrams of a lossy link occupy the reassembly buffer"),
    "net/ipv4/ipfrag_high_thresh": (134_217_728, "at least", "incomplete datagrams fill the reassembly buffer"),
}


def is_ros2(robot: Robot) -> bool:
    """Return True if a robot runs ROS 2."""
    return robot.profile.ros is not None and robot.profile.ros.variant == "ros2"


def domain(variables: Variables) -> int | None:
    """Return the ROS domain of an environment, 0 if it is not set; None unless it is a number of 1 to 3 digits."""
    text = variables.get("ROS_DOMAIN_ID") or "0"
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 3 else None


def rmw(variables: Variables) -> str:
    """Return the RMW of an environment; if it is not set, the default of the distribution."""
    default = _GALACTIC_RMW if variables.get("ROS_DISTRO") == "galactic" else DEFAULT_RMW
    return variables.get("RMW_IMPLEMENTATION") or default


def uses_zenoh(variables: Variables) -> bool:
    """Return True if the RMW is rmw_zenoh, which uses no multicast by default and needs a router."""
    return "zenoh" in rmw(variables)


def needs_multicast(variables: Variables) -> bool:
    """Return True if nodes with this environment discover other robots by multicast only."""
    alternatives = ("ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")
    return not uses_zenoh(variables) and not any(variables.get(name) for name in alternatives)


def judge_robot(robot: Robot, state: RosState, report: Report) -> None:
    """Add the findings on one robot."""
    if is_ros2(robot):
        _judge_domain_and_rmw(robot, state, report)
        _judge_range(state.variables, report)
        if uses_zenoh(state.variables):
            _judge_router(state, report)
        else:
            _judge_rmw_interfaces(robot, state, report)
            _judge_multicast_route(robot, state, report)
            _judge_kernel(state, report)
    _judge_firewall(state, report)


def judge_agreement(
    cast: Mapping[Role, Robot], states: Mapping[Role, RosState], reports: Mapping[Role, Report]
) -> None:
    """Add the findings on settings of ROS 2 that must agree; each robot is compared with the first one.

    Args:
        cast: The robots.
        states: State of each robot that could be read.
        reports: The report of each robot, to which the findings are added.
    """
    roles = [role for role in states if is_ros2(cast[role])]
    if len(roles) < 2:
        return
    first_role, *other_roles = roles
    for role in other_roles:
        for compare in (_compare_domains, _compare_rmws, _compare_distributions, _compare_servers):
            compare(cast[first_role], states[first_role].variables, states[role].variables, reports[role])


def _judge_domain_and_rmw(robot: Robot, state: RosState, report: Report) -> None:
    own_domain = domain(state.variables)
    if own_domain is None:
        report.fail("ROS domain", f"ROS_DOMAIN_ID is {state.variables['ROS_DOMAIN_ID']!r}", "use a number, 0 to 101")
        return
    running = [program.variables for program in state.programs]
    other_values = _differing_values(
        [variables.get("ROS_DOMAIN_ID") or "0" for variables in running if domain(variables) != own_domain],
        len(running),
    )
    if other_values:
        report.warn(
            "ROS domain",
            f"its setup files and profile result in domain {own_domain}, but {other_values}",
            f"start them in domain {own_domain}, or correct ROS_DOMAIN_ID: "
            f"{copy_profile_command(robot.profile.name)}",
        )
    else:
        report.ok(
            "ROS domain",
            f"{own_domain}; {format_count(len(running), 'running ROS program')} in this domain, none in another"
            if running
            else str(own_domain),
        )
    own_rmw = rmw(state.variables)
    other_values = _differing_values(
        [rmw(variables) for variables in running if rmw(variables) != own_rmw], len(running)
    )
    if other_values:
        report.warn(
            "RMW",
            f"its setup files and profile result in {own_rmw}, but {other_values}",
            "ros2 daemon stop   # then set RMW_IMPLEMENTATION for all programs of the robot, and restart them",
        )
    else:
        report.ok("RMW", own_rmw)


def _differing_values(values: Sequence[str], program_count: int) -> str:
    """Return the number of programs for each of the three most frequent values as text; empty without a value.

    Args:
        values: Value of a setting in each program that differs from the robot's setup files and profile.
        program_count: Number of all running ROS programs of the robot.
    """
    if program_count == 1:
        return "".join(f"its only running ROS program uses {value}" for value in values)
    return ", ".join(
        f"{count} of its {program_count} running ROS programs {'uses' if count == 1 else 'use'} {value}"
        for value, count in Counter(values).most_common(3)
    )


def _judge_range(variables: Variables, report: Report) -> None:
    if variables.get("ROS_LOCALHOST_ONLY") == "1":
        report.fail(
            "discovery range",
            "ROS_LOCALHOST_ONLY=1: its nodes do not communicate with other robots",
            "unset ROS_LOCALHOST_ONLY   # in its setup files and in .bashrc",
        )
        return
    discovery_range = (variables.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET").upper()
    if discovery_range == "OFF" or (discovery_range == "LOCALHOST" and not variables.get("ROS_STATIC_PEERS")):
        report.fail(
            "discovery range",
            f"ROS_AUTOMATIC_DISCOVERY_RANGE={discovery_range}: its nodes do not discover other robots",
            "export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET   # or list the robots in ROS_STATIC_PEERS",
        )
        return
    peers, server = variables.get("ROS_STATIC_PEERS"), variables.get("ROS_DISCOVERY_SERVER")
    parts = [discovery_range]
    parts += [f"peers {peers}"] if peers else []
    parts += [f"discovery server {server}"] if server else []
    report.ok("discovery range", ", ".join(parts))


def _judge_router(state: RosState, report: Report) -> None:
    if state.variables.get("ZENOH_SESSION_CONFIG_URI"):
        report.ok("Zenoh router", f"session configuration {state.variables['ZENOH_SESSION_CONFIG_URI']}")
    elif _ZENOH_PORT not in state.tcp_ports:
        report.fail(
            "Zenoh router",
            f"no router is listening on TCP port {_ZENOH_PORT}; without one, nodes do not discover each other",
            "ros2 run rmw_zenoh_cpp rmw_zenohd",
        )
    elif not any(
        program.variables.get("ZENOH_ROUTER_CONFIG_URI") for program in (_as_program(state), *state.programs)
    ):
        report.warn(
            "Zenoh router",
            "ZENOH_ROUTER_CONFIG_URI is not set: with the default configuration a router does not connect to other "
            "routers",
            "list the other robots in connect.endpoints of the file ZENOH_ROUTER_CONFIG_URI   # on one side",
        )
    else:
        report.ok("Zenoh router", f"TCP port {_ZENOH_PORT} is open; a separate configuration file is named")


def _as_program(state: RosState) -> RosProgram:
    """Return a program with the environment of the robot's setup files and profile."""
    return RosProgram("", state.variables)


def _judge_rmw_interfaces(robot: Robot, state: RosState, report: Report) -> None:
    radio, check = robot.profile.radio.interface, "RMW settings"
    interfaces = state.rmw_interfaces
    if state.unreadable_settings:
        report.fail(check, state.unreadable_settings, "correct CYCLONEDDS_URI or FASTDDS_DEFAULT_PROFILES_FILE")
    elif interfaces and not {radio, robot.address} & set(interfaces):
        report.fail(
            check,
            f"limited to {', '.join(interfaces)}: its nodes do not use {radio}",
            f"name {radio} in the file of CYCLONEDDS_URI or FASTDDS_DEFAULT_PROFILES_FILE",
        )
    elif interfaces:
        report.ok(check, f"limited to {', '.join(interfaces)}")


def _judge_multicast_route(robot: Robot, state: RosState, report: Report) -> None:
    radio = robot.profile.radio.interface
    if not needs_multicast(state.variables):
        return
    if state.multicast_interface is None:
        report.fail("multicast route", "no route to 239.255.0.1", f"sudo ip route add 224.0.0.0/4 dev {radio}")
    elif state.multicast_interface != radio:
        report.warn(
            "multicast route",
            f"packets to 239.255.0.1 leave through {state.multicast_interface}, not {radio}",
            f"sudo ip route add 224.0.0.0/4 dev {radio}   # or name {radio} in the settings of the RMW",
        )
    else:
        report.ok("multicast route", f"through {radio}")


def _judge_kernel(state: RosState, report: Report) -> None:
    problems, commands = [], []
    for key, (value, relation, consequence) in _RECOMMENDED_KERNEL.items():
        actual = state.kernel.get(key)
        if actual is not None and (actual < value if relation == "at least" else actual > value):
            name = key.replace("/", ".")
            problems.append(f"{name} is {actual}: {consequence}")
            commands.append(f"{name}={value}")
    if problems:
        report.warn(
            "kernel buffers", "; ".join(problems), f"sudo sysctl -w {' '.join(commands)}   # for samples above 1.5 kB"
        )
    elif state.kernel:
        report.ok("kernel buffers", "as ROS recommends")
    else:
        report.ok("kernel buffers", "unknown: these settings cannot be read in the robot's network namespace")


def _judge_firewall(state: RosState, report: Report) -> None:
    if state.drop_rules is None:
        report.ok("firewall", "unknown: reading the rules needs root and either nft or iptables")
    elif state.drop_rules:
        first_rules = "; ".join(state.drop_rules[:3])
        report.warn(
            "firewall",
            f"rules drop packets: {first_rules}",
            "sudo nft list ruleset   # check that ROS packets are accepted",
        )
    else:
        report.ok("firewall", "no rule drops received packets")


def _domain_text(variables: Variables) -> str:
    """Return the domain as it is written in an environment, even if it is invalid."""
    return variables.get("ROS_DOMAIN_ID") or "0"


def _compare_domains(first_robot: Robot, expected: Variables, actual: Variables, report: Report) -> None:
    if domain(actual) != domain(expected):
        report.fail(
            "same ROS domain",
            f"domain {_domain_text(actual)}, but {first_robot.name} is in domain {_domain_text(expected)}: their "
            "nodes do not discover each other",
            "use one ROS_DOMAIN_ID on all robots",
        )


def _compare_rmws(first_robot: Robot, expected: Variables, actual: Variables, report: Report) -> None:
    if uses_zenoh(actual) != uses_zenoh(expected):
        report.fail(
            "same RMW",
            f"{rmw(actual)}, but {first_robot.name} has {rmw(expected)}: Zenoh and DDS do not communicate",
            "use one RMW_IMPLEMENTATION on all robots",
        )
    elif rmw(actual) != rmw(expected):
        report.warn(
            "same RMW",
            f"{rmw(actual)}, but {first_robot.name} has {rmw(expected)}: such nodes may not communicate",
            "use one RMW_IMPLEMENTATION on all robots",
        )
    else:
        report.ok("same RMW", f"{rmw(actual)}, as on {first_robot.name}")


def _compare_distributions(first_robot: Robot, expected: Variables, actual: Variables, report: Report) -> None:
    own_distro, first_distro = actual.get("ROS_DISTRO", ""), expected.get("ROS_DISTRO", "")
    if own_distro and first_distro and own_distro != first_distro:
        report.warn(
            "same ROS distribution",
            f"{own_distro}, but {first_robot.name} has {first_distro}: their nodes may not communicate",
            "install one distribution on all robots, or compare the types: ros2 topic info -v TOPIC",
        )


def _compare_servers(first_robot: Robot, expected: Variables, actual: Variables, report: Report) -> None:
    own_server, first_server = actual.get("ROS_DISCOVERY_SERVER", ""), expected.get("ROS_DISCOVERY_SERVER", "")
    if own_server != first_server:
        report.fail(
            "same discovery server",
            f"{own_server or 'no discovery server'}, but {first_robot.name} has {first_server or 'none'}: "
            "their nodes do not discover each other",
            "use one ROS_DISCOVERY_SERVER on all robots, or on none",
        )


def judge_servers(
    cast: Mapping[Role, Robot], states: Mapping[Role, RosState], reports: Mapping[Role, Report]
) -> None:
    """Add a finding on each discovery server."""
    roles = {cast[role].address: role for role in states}
    for role, state in states.items():
        for server in filter(None, state.variables.get("ROS_DISCOVERY_SERVER", "").split(";")):
            address, _, port_text = server.partition(":")
            port = int(port_text) if port_text.isascii() and port_text.isdecimal() else _SERVER_PORT
            server_role = roles.get(address)
            if server_role is None:
                reports[role].ok("discovery server", f"{server} runs on none of the robots, so it is not checked")
            elif port in states[server_role].udp_ports:
                reports[role].ok(
                    "discovery server",
                    f"{server}: a program on {cast[server_role].name} is listening on UDP port {port}",
                )
            else:
                reports[role].fail(
                    "discovery server",
                    f"{server}: no program on {cast[server_role].name} is listening on UDP port {port}",
                    f"on {cast[server_role].name}: fastdds discovery -i 0 -l {address} -p {port}",
                )


def ports_remedy(domain_number: int) -> str:
    """Return a command that opens a firewall for a domain."""
    first_port = multicast_port(domain_number)
    port_range = f"{first_port}:{first_port + 249}"  # RTPS assigns 250 ports to each domain
    return f"sudo ufw allow proto udp to any port {port_range}   # the ports of ROS domain {domain_number}"
