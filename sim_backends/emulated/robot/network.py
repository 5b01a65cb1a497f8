"""Network of an emulated robot: loopback, an interface with the radio's name, and the routing daemon babeld."""

import shutil
import subprocess
from collections.abc import Mapping
from ipaddress import IPv4Interface
from pathlib import Path
from typing import Final

from fieldkit.core.errors import RobotError
from sim_backends.emulated.medium.framing import mac_of
from sim_backends.emulated.robot.spec import LOOPBACK_INTERFACE, SHARED_NETWORK, STATE
from sim_backends.emulated.robot.tun_devices import open_tun

BABEL_PORT: Final = 6696
"""UDP port of Babel (RFC 8966, section 5)."""

LINK_COST: Final = 1024
"""Cost of a further link in Babel; a radio without loss costs 256, so that it is preferred."""

_LONG_TERM_STATE: Final = f"{STATE}/babel-state"


def babeld_command(interface: str, address: str, hello_s: float, links: Mapping[str, str]) -> tuple[str, ...]:
    """Return the command of a robot's routing daemon. Other settings have babeld's defaults.

    Args:
        interface: The radio interface. It is declared wireless, because a TAP device has no wireless extensions.
        address: The robot's address with the prefix length; each robot announces its own address as a host route.
        hello_s: Interval of the hello messages with which babeld measures the links to its neighbours.
        links: Address with the prefix length of each further link, by its interface. If `LOOPBACK_INTERFACE` is one
            of them, the daemon also uses the other links, each with the cost `LINK_COST`, and announces the address
            of `LOOPBACK_INTERFACE` over all links. It announces the address on the radio only over the radio.
    """
    shared_address = links.get(LOOPBACK_INTERFACE)
    tunnels = [name for name in links if name != LOOPBACK_INTERFACE] if shared_address else []
    rules = [f"out if {name} ip {IPv4Interface(address).network} deny" for name in tunnels]
    rules += [f"interface {name} type tunnel rxcost {LINK_COST} hello-interval {hello_s:g}" for name in tunnels]
    if shared_address is not None:
        ip = IPv4Interface(shared_address).ip
        rules += [f"redistribute local ip {ip}/32 allow", f"install ip {SHARED_NETWORK} pref-src {ip}"]
    settings = _settings(interface, address, hello_s, *rules)
    return (*_program(_LONG_TERM_STATE), *settings, interface, *tunnels)


def guest_babeld_command(interface: str, address: str, hello_s: float) -> tuple[str, ...]:
    """Return the command of the routing daemon of a node that uses the robots' routes.

    The node announces only its own address. The daemon writes no files. The arguments are those of `babeld_command`.
    """
    filters = (f"out ip {IPv4Interface(address).ip}/32 allow", "out deny")
    return (*_program(""), *_settings(interface, address, hello_s, *filters), interface)


def _program(long_term_state: str) -> tuple[str, ...]:
    no_pid_file = ""  # babeld does not start again if the file of a killed process exists
    return (shutil.which("babeld") or "/usr/sbin/babeld", "-I", no_pid_file, "-S", long_term_state)


def _settings(interface: str, address: str, hello_s: float, *rules: str) -> tuple[str, ...]:
    # The first filter that matches is applied, so the general filter is the last one.
    settings = (
        f"interface {interface} type wireless hello-interval {hello_s:g}",
        f"redistribute local ip {IPv4Interface(address).network} allow",
        *rules,
        "redistribute local deny",
    )
    return tuple(word for setting in settings for word in ("-C", setting))


MTU_BYTES: Final = 1500
_TIMEOUT_S: Final = 5.0
"""Maximum duration of an `ip` command."""


def bring_up(interface: str, address: str, *, mesh: bool = False) -> int:
    """Bring up loopback and the radio interface in this process's network namespace.

    Multicast and limited broadcast use the radio interface, as on a robot that has no other network.

    Args:
        interface: Name of the interface.
        address: Its address with the prefix length.
        mesh: True if robots forward packets for each other. The interface then has a MAC address, with which frames
            address the next hop, and IPv6, whose link-local addresses the routing daemon uses (RFC 8966, section 4).

    Returns:
        The device's descriptor, for the medium.

    Raises:
        FieldkitError: The interface cannot be created.
        RobotError: `ip` rejected a setting.
    """
    disable_ipv6()
    fd = _open_device(interface, address, mesh=mesh)
    configure(interface, address)
    return fd


def _open_device(interface: str, address: str, *, mesh: bool) -> int:
    fd = open_tun(interface, ethernet=mesh)
    if mesh:
        prepare_mesh(interface)
        mac = mac_of(IPv4Interface(address).ip).hex(":")
        run_ip(f"link set {interface} address {mac}")
    return fd


def add_link(interface: str, address: str, *, mesh: bool = False) -> int:
    """Bring up the interface of a further link, without routes for multicast.

    Args:
        interface: Name of the interface.
        address: Its address with the prefix length.
        mesh: True if robots forward packets for each other.

    Returns:
        The device's descriptor, for the medium of the link.

    Raises:
        FieldkitError: The interface cannot be created.
        RobotError: `ip` rejected a setting.
    """
    fd = _open_device(interface, address, mesh=mesh)
    run_ip(f"link set {interface} mtu {MTU_BYTES} up", f"address add {address} broadcast + dev {interface}")
    return fd


def add_loopback_address(address: str) -> None:
    """Add an address to the loopback interface. Raises the errors of `run_ip`."""
    run_ip(f"address add {address} dev {LOOPBACK_INTERFACE}")


def switch_on_link(interface: str) -> None:
    """Bring the interface of a further link up again. Raises the errors of `switch_on`."""
    run_ip(f"link set {interface} up")


def configure(interface: str, address: str) -> None:
    """Bring up loopback and an interface with its address and routes. Raises the errors of `run_ip`."""
    run_ip(
        "link set lo up",
        f"link set {interface} mtu {MTU_BYTES} up",
        f"address add {address} broadcast + dev {interface}",
        *_routes(interface),
    )


def switch_off(interface: str) -> None:
    """Take an interface down; it keeps its address. Raises the errors of `switch_on`."""
    run_ip(f"link set {interface} down")


def switch_on(interface: str) -> None:
    """Bring the radio interface up again.

    Raises:
        RobotError: `ip` rejected a setting.
    """
    run_ip(f"link set {interface} up", *_routes(interface))


def _routes(interface: str) -> tuple[str, ...]:
    # When an interface is taken down, the kernel removes its routes. It restores only the route that belongs to the
    # address when the interface is brought up again.
    return (f"route replace 224.0.0.0/4 dev {interface}", f"route replace 255.255.255.255/32 dev {interface}")


def run_ip(*commands: str) -> None:
    """Run `ip` commands.

    Raises:
        RobotError: `ip` rejected a setting.
    """
    for command in commands:
        # Each command runs separately, because busybox's ip, which a robot may have, has no batch mode.
        result = subprocess.run(
            ["ip", *command.split()],  # noqa: S607 (found on the robot's PATH)
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
        if result.returncode != 0:
            raise RobotError(
                f"ip rejected a setting: {result.stderr.strip()} (ip {command})",
                remedy="correct the address or the interface of the robot, or update iproute2",
            )


def has_listener(port: int) -> bool:
    """Return True if an IPv4 TCP socket listens on `port`, as the kernel's table shows; no connection is made."""
    local = f":{port:04X} "
    listening = "0A"
    # The first 21 characters of a line are its number and the local address.
    lines = Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    return any(local in line[:21] and line.split()[3] == listening for line in lines)


def has_udp6_socket(port: int) -> bool:
    """Return True if an IPv6 UDP socket is bound to `port`, as the kernel's table shows."""
    # The second word of a line is the local address.
    lines = Path("/proc/net/udp6").read_text(encoding="ascii").splitlines()[1:]
    return any(line.split()[1].endswith(f":{port:04X}") for line in lines)


def prepare_mesh(interface: str) -> None:
    """Enable forwarding, and link-local addresses without duplicate detection, since no other robot has this MAC."""
    settings = {
        "ipv4/conf/all/forwarding": 1,
        # Every forwarded packet leaves through the interface on which it arrived; this must not cause ICMP redirects.
        "ipv4/conf/all/send_redirects": 0,
        f"ipv4/conf/{interface}/send_redirects": 0,
        f"ipv6/conf/{interface}/disable_ipv6": 0,
        f"ipv6/conf/{interface}/accept_dad": 0,
        f"ipv6/conf/{interface}/accept_ra": 0,
        f"ipv6/conf/{interface}/router_solicitations": 0,
    }
    for name, value in settings.items():
        Path("/proc/sys/net", name).write_text(str(value), encoding="ascii")


def disable_ipv6() -> None:
    """Disable IPv6, so that the kernel's neighbour discovery adds no packets to the traffic of the programs."""
    for scope in ("all", "default"):
        switch = Path(f"/proc/sys/net/ipv6/conf/{scope}/disable_ipv6")
        if switch.exists():
            switch.write_text("1", encoding="ascii")
