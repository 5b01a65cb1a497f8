"""Read the state of a robot that determines if its ROS programs reach other robots, in one round trip."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.core.deadline import Deadline
from fieldkit.remote.command import printable, with_environment
from fieldkit.remote.shell import Shell
from fieldkit.steps import agent_commands
from fieldkit.trial.check import probe
from fieldkit.trial.check.probe import MISSING_SECTION, Sections

STATE_S: Final = 30.0
"""Timeout of the script; setup files of a large workspace take seconds on a small computer."""
MAX_PROGRAMS: Final = 500
"""Maximum number of running ROS programs that are evaluated; further ones are ignored."""

SCRIPT: Final = resources.files("fieldkit.ros.networking").joinpath("state.sh").read_text(encoding="ascii")
_ROUTE: Final = re.compile(r"\bdev (?P<interface>\S{1,30})")
# A line of /proc/net/tcp or /proc/net/udp: the state 0A is a listening TCP socket, 07 a bound UDP socket.
_SOCKET: Final = re.compile(r"^ *[0-9]+: [0-9A-F]{8,32}:(?P<port>[0-9A-F]{4}) \S+ (?P<state>0A|07) ", re.MULTILINE)
# CycloneDDS, configuration reference, General/Interfaces and the former General/NetworkInterfaceAddress; Fast DDS,
# XML profiles, interfaceWhiteList.
_CYCLONEDDS_INTERFACE: Final = re.compile(
    r"<NetworkInterface\b[^>]{0,200}?\b(?:name|address)=[\"']([^\"'>]{1,60})[\"']"
    r"|<NetworkInterfaceAddress>\s{0,20}([^<\s]{1,60})",
    re.IGNORECASE,
)
_WHITE_LIST: Final = re.compile(r"<interfaceWhiteList>(.{0,5000}?)</interfaceWhiteList>", re.DOTALL)
_WHITE_LIST_ENTRY: Final = re.compile(r"<(?:address|interface)>\s{0,20}([^<\s]{1,60})")
_DECIMAL: Final = re.compile(r"[0-9]{1,18}", re.ASCII)
_IPTABLES_DROP: Final = re.compile(
    r"^(?P<rule>-P INPUT (?:DROP|REJECT)|-A INPUT .*-j (?:DROP|REJECT).*)$", re.MULTILINE | re.ASCII
)
_HOOK: Final = re.compile(r"\bhook (?P<hook>[a-z]+) ", re.ASCII)
_NFT_DROP: Final = re.compile(r"\b(?:drop|reject)\b", re.ASCII)
_OTHER_HOOKS: Final = {"output", "forward", "postrouting", "egress"}
"""Hooks of nftables that packets to the robot's programs do not traverse."""

Variables = Mapping[str, str]
"""Environment variables by name."""


@dataclass(frozen=True)
class RosProgram:
    """A running program with the environment of ROS.

    Attributes:
        name: Its command name.
        variables: Its variables that concern the network.
    """

    name: str
    variables: Variables


@dataclass(frozen=True)
class RosState:
    """Network state of a robot. Attributes that the robot did not report are None or empty.

    Attributes:
        variables: Variables of the network in the environment of its setup files and its profile.
        programs: Its running ROS programs, of the login's user or of all users if the login is root.
        kernel: Settings of the kernel by their path below `/proc/sys`.
        multicast_interface: Interface of the route to 239.255.0.1; None without a route.
        tcp_ports: Ports on which programs listen.
        udp_ports: Ports to which programs are bound.
        hostname: Its host name.
        rmw_interfaces: Names or addresses of the interfaces to which the settings of its RMW are limited; empty if
            they are not limited.
        unreadable_settings: The reason why a file with settings of its RMW cannot be read; empty if there is none.
        drop_rules: Rules of nftables or iptables that drop received packets; None if they could not be read.
    """

    variables: Variables
    programs: tuple[RosProgram, ...]
    kernel: Mapping[str, int]
    multicast_interface: str | None
    tcp_ports: frozenset[int]
    udp_ports: frozenset[int]
    hostname: str
    rmw_interfaces: tuple[str, ...]
    unreadable_settings: str
    drop_rules: tuple[str, ...] | None


def read(robot: Robot, shell: Shell) -> RosState:
    """Read the state of a robot.

    Raises:
        LinkError: The robot did not answer within `STATE_S`.
        RobotError: Its output exceeds the limit of a command.
    """
    argv = with_environment(("sh", "-s"), setup=agent_commands.setup(robot), environment=robot.ros_environment)
    completed = shell.run(argv, stdin=SCRIPT.encode(), deadline=Deadline.after(STATE_S), check=False)
    return parse(probe.parse(completed.stdout.decode(errors="replace")))


def parse(sections: Sections) -> RosState:
    """Return the state from the sections of the script's output."""

    def text(name: str) -> str:
        section = sections.get(name, MISSING_SECTION)
        return section.text if section.ok else ""

    route = _ROUTE.search(text("route"))
    sockets = [(match["state"], int(match["port"], 16)) for match in _SOCKET.finditer(text("listeners"))]
    kernel_rows = (line.split() for line in text("kernel").splitlines())
    return RosState(
        variables=_variables(text("environment")),
        programs=_programs(text("programs")),
        kernel={words[0]: int(words[1]) for words in kernel_rows if len(words) == 2 and _DECIMAL.fullmatch(words[1])},
        multicast_interface=route["interface"] if route else None,
        tcp_ports=frozenset(port for state, port in sockets if state == "0A"),
        udp_ports=frozenset(port for state, port in sockets if state == "07"),
        hostname=text("hostname").strip(),
        rmw_interfaces=_rmw_interfaces(text("cyclonedds"), text("fastdds")),
        unreadable_settings=" ".join(
            printable(section.text.encode())
            for section in (sections.get(name, MISSING_SECTION) for name in ("cyclonedds", "fastdds"))
            if not section.ok and section.code != MISSING_SECTION.code
        ),
        drop_rules=_drop_rules(sections),
    )


def _variables(text: str) -> dict[str, str]:
    pairs = (line.partition("=") for line in text.splitlines())
    return {name: printable(value.encode()) for name, separator, value in pairs if separator}


def _programs(text: str) -> tuple[RosProgram, ...]:
    parts = re.split(r"^program ", text, flags=re.MULTILINE)[1 : MAX_PROGRAMS + 1]
    programs = (part.partition("\n") for part in parts)
    return tuple(RosProgram(printable(name.encode()), _variables(lines)) for name, _, lines in programs)


def _rmw_interfaces(cyclonedds: str, fastdds: str) -> tuple[str, ...]:
    names = [name or address for name, address in _CYCLONEDDS_INTERFACE.findall(cyclonedds)]
    for white_list in _WHITE_LIST.findall(fastdds):
        names += _WHITE_LIST_ENTRY.findall(white_list)
    return tuple(dict.fromkeys(printable(name.encode()) for name in names))


def _drop_rules(sections: Sections) -> tuple[str, ...] | None:
    nftables, iptables = (sections.get(name, MISSING_SECTION) for name in ("nftables", "iptables"))
    if not nftables.ok and not iptables.ok:
        return None
    rules = [*_nftables_drops(nftables.text if nftables.ok else "")]
    if iptables.ok:
        rules += [match["rule"] for match in _IPTABLES_DROP.finditer(iptables.text)]
    return tuple(dict.fromkeys(printable(rule.encode(), limit=120) for rule in rules))


def _nftables_drops(ruleset: str) -> Iterator[str]:
    """Yield the rules and policies that drop packets, except in chains for sent or forwarded packets (nft(8))."""
    hook = ""
    for line in ruleset.splitlines():
        words = line.strip()
        if words.startswith("chain "):
            hook = ""
        elif match := _HOOK.search(words):
            hook = match["hook"]
        if hook not in _OTHER_HOOKS and _NFT_DROP.search(words):
            yield words
