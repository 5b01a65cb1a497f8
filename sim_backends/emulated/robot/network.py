"""The network of an emulated robot: one TUN interface named as its radio, and loopback."""

import subprocess
from pathlib import Path
from typing import Final

from fieldkit.core.errors import RobotError
from sim_backends.emulated.robot.tun import open_tun

MTU_BYTES: Final = 1500
_TIMEOUT_S: Final = 5.0


def bring_up(interface: str, address: str) -> int:
    """Bring up loopback and the radio interface in this process's network namespace.

    Multicast and limited broadcast leave by the radio, as on a robot whose only network it is.

    Args:
        interface: Its name.
        address: Its address with the length of the network.

    Returns:
        The TUN device's descriptor, for the medium.

    Raises:
        FieldkitError: The interface cannot be made.
        RobotError: `ip` refused a setting.
    """
    _no_ipv6()
    fd = open_tun(interface)
    _ip(
        "link set lo up",
        f"link set {interface} mtu {MTU_BYTES} up",
        f"address add {address} broadcast + dev {interface}",
        *_routes(interface),
    )
    return fd


def switch_off(interface: str) -> None:
    """Take the radio interface down; it keeps its address. Errors as `switch_on`."""
    _ip(f"link set {interface} down")


def switch_on(interface: str) -> None:
    """Bring the radio interface up again.

    Raises:
        RobotError: `ip` refused.
    """
    _ip(f"link set {interface} up", *_routes(interface))


def _routes(interface: str) -> tuple[str, ...]:
    # Lost with every link that goes down, unlike the route that comes with the address.
    return (f"route replace 224.0.0.0/4 dev {interface}", f"route replace 255.255.255.255/32 dev {interface}")


def _ip(*commands: str) -> None:
    for command in commands:
        # One by one: busybox's ip, which a robot may have, takes no batch.
        done = subprocess.run(
            ["ip", *command.split()],  # noqa: S607 (found on the robot's own PATH)
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
        if done.returncode != 0:
            raise RobotError(f"ip refused a setting: {done.stderr.strip()}", remedy="update iproute2")


def listens(port: int) -> bool:
    """Return whether a TCP socket listens on `port`; asks the kernel, so that no server sees a connection."""
    local = f":{port:04X} "
    listening = "0A"
    lines = Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    return any(local in line[:21] and line.split()[3] == listening for line in lines)


def _no_ipv6() -> None:
    """Keep the kernel's own neighbour discovery off the air: fieldkit measures what robots send."""
    for scope in ("all", "default"):
        switch = Path(f"/proc/sys/net/ipv6/conf/{scope}/disable_ipv6")
        if switch.exists():
            switch.write_text("1", encoding="ascii")
