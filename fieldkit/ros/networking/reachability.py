"""Findings on test datagrams between robots, and on the names by which nodes of ROS 1 are reached."""

from collections.abc import Mapping
from typing import Final
from urllib.parse import urlsplit

from fieldkit.agent.datagrams import FRAGMENTED, MULTICAST, SIZES, UNICAST
from fieldkit.backends.protocols import Robot
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role
from fieldkit.remote.command import printable
from fieldkit.remote.shell import Shell
from fieldkit.ros.networking import settings
from fieldkit.ros.networking.exchange import COUNT, Arrivals
from fieldkit.ros.networking.state import RosState
from fieldkit.trial.check.report import Report

MIN_ARRIVED: Final = 18
"""Minimum number of arrived datagrams, out of `COUNT`, on a good link. It corresponds to a loss of 10 %."""

_RESOLVE_TIMEOUT_S: Final = 15.0
"""Timeout for the resolution of a name."""
_LOOPBACK_HOSTS: Final = {None, "localhost", "127.0.0.1", "::1"}
"""Hosts in the URI of a master that runs on the robot itself; None if the URI has no host."""
_FRAGMENT_COUNT: Final = -(-SIZES[FRAGMENTED] // 1480)
"""Number of IP fragments of a datagram of the kind `FRAGMENTED`. A fragment has at most 1480 bytes of payload: an MTU
of 1500 bytes without the IPv4 header."""


def judge_arrivals(
    source: Robot, arrivals: Arrivals, state: RosState, domain: int, report: Report, *, ros2: bool
) -> None:
    """Add the findings on the test datagrams of one robot that arrived at the robot of `report`.

    Args:
        source: The sender.
        arrivals: The datagrams that arrived.
        state: State of the receiver.
        domain: ROS domain of the test.
        report: Report of the receiver, to which the findings are added.
        ros2: Whether both robots run ROS 2, for which multicast and fragments matter.
    """
    if arrivals.error:
        report.fail(f"datagrams from {source.name}", f"not tested: {arrivals.error}", "fieldkit check   # first")
        return
    unicast, multicast, fragmented = (arrivals.counts.get(kind, 0) for kind in (UNICAST, MULTICAST, FRAGMENTED))
    firewall_note = f"; firewall: {state.drop_rules[0]}" if state.drop_rules else ""
    remedy = settings.ports_remedy(domain)
    _judge_count(
        f"UDP from {source.name}", unicast, report, none_reason=f"no unicast arrives{firewall_note}", remedy=remedy
    )
    if not ros2:
        return
    if settings.needs_multicast(state.variables):
        if unicast:
            none_reason = f"no multicast arrives, but unicast does{firewall_note}"
            multicast_remedy = f"export ROS_STATIC_PEERS={source.address}   # or a discovery server"
        else:
            none_reason, multicast_remedy = f"no multicast arrives{firewall_note}", remedy
        check = f"multicast from {source.name}"
        _judge_count(check, multicast, report, none_reason=none_reason, remedy=multicast_remedy)
    if unicast:
        _judge_count(
            f"fragments from {source.name}",
            fragmented,
            report,
            none_reason=f"{SIZES[UNICAST]} B arrive, but {SIZES[FRAGMENTED]} B do not{firewall_note}",
            remedy="allow IP fragments in the firewall; or keep datagrams below the MTU: settings: tuned",
            datagram_text=f"datagrams of {SIZES[FRAGMENTED]} B ({_FRAGMENT_COUNT} fragments)",
        )


def _judge_count(
    check: str, count: int, report: Report, *, none_reason: str, remedy: str, datagram_text: str = "datagrams"
) -> None:
    if not count:
        report.fail(check, f"0 of {COUNT} {datagram_text}: {none_reason}", remedy)
    elif count < MIN_ARRIVED:
        report.warn(
            check,
            f"{count} of {COUNT} {datagram_text}: the link loses packets",
            "bring the robots closer, and check again",
        )
    else:
        report.ok(check, f"{count} of {COUNT} {datagram_text}")


def advertised_name(state: RosState) -> str:
    """Return the name under which nodes of ROS 1 are reached (wiki.ros.org/ROS/EnvironmentVariables)."""
    name = state.variables.get("ROS_HOSTNAME") or state.variables.get("ROS_IP") or state.hostname
    return name.lstrip("-")  # getent would parse a leading hyphen as an option


def _host(uri: str) -> str | None:
    try:
        return urlsplit(uri).hostname
    except ValueError:
        return uri


def judge_names(
    role: Role, cast: Mapping[Role, Robot], states: Mapping[Role, RosState], shell: Shell, report: Report
) -> None:
    """Check that a robot with ROS 1 resolves the names of the other robots on its master to their radio addresses.

    Robots use the same master if their ROS_MASTER_URI are equal. Nothing is resolved for a loopback address.

    Raises:
        LinkError: The robot did not answer.
    """
    master = states[role].variables.get("ROS_MASTER_URI", "")
    if _host(master) in _LOOPBACK_HOSTS:
        reason = f"its ROS master, {master}, runs on the robot itself" if master else "ROS_MASTER_URI is not set"
        report.ok("ROS network", f"{reason}: its topics do not reach other robots")
        return
    for other, state in states.items():
        if other is role or settings.is_ros2(cast[other]) or state.variables.get("ROS_MASTER_URI") != master:
            continue
        robot, name = cast[other], advertised_name(state)
        argv = ("getent", "ahostsv4", name)
        output = shell.run(argv, deadline=Deadline.after(_RESOLVE_TIMEOUT_S), check=False).stdout
        addresses = list(
            dict.fromkeys(line.split()[0] for line in output.decode(errors="replace").splitlines() if line)
        )
        check = f"name of {robot.name}"
        if robot.address in addresses:
            report.ok(check, f"its nodes are reached as {name}, which is {robot.address}")
        else:
            resolved_text = printable(", ".join(addresses).encode()) or "unknown here"
            report.fail(
                check,
                f"its nodes are reached as {name}, which is {resolved_text}, not {robot.address}",
                f"on {robot.name}: export ROS_IP={robot.address}   # before its nodes start",
            )
