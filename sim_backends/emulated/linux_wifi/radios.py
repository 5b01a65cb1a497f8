"""Finds the radios of mac80211_hwsim in this kernel, and moves them into the network namespaces of robots."""

import os
import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from sim_backends.emulated.process.worker import PATH
from sim_backends.emulated.robot.network import MTU_BYTES

_FOLDER: Final = Path("/sys/class/ieee80211")
_CLASS: Final = "mac80211_hwsim"
_MODULE: Final = Path("/sys/module/mac80211_hwsim")
_RADIO_BIT: Final = 0x40
"""Bit in the first byte of an address by which a radio's address in hwsim differs from that of its interface."""
_ARPHRD_IEEE80211_RADIOTAP: Final = "803"
"""Type of a monitor interface: linux/if_arp.h."""
_RETURN_S: Final = 5.0
"""Default wait until the kernel has moved the radios of a lab back, after the last process of the lab has exited."""
_POLL_S: Final = 0.05
_TIMEOUT_S: Final = 60.0
"""Timeout of `iw` and `ip`."""


@dataclass(frozen=True)
class HwsimRadio:
    """A radio of hwsim.

    Attributes:
        phy: Name of its device, `phy0`.
        interface: Name of its network interface, `wlan0`.
        address: Address that identifies it in hwsim; it differs in one bit from the address of the interface.
        monitors: Names of its monitor interfaces, for example those that an earlier lab has left.
    """

    phy: str
    interface: str
    address: str
    monitors: tuple[str, ...] = ()

    def move_to_namespace(self, pid: int) -> None:
        """Remove the settings of an earlier lab, and move the radio into the network namespace of a process.

        When that namespace ends, the kernel moves the radio to the initial network namespace.

        Raises:
            RobotError: The kernel refused the move.
        """
        for monitor in self.monitors:
            _run("iw", "dev", monitor, "del")
        reset_link(self.interface)
        _run("iw", "phy", self.phy, "set", "netns", str(pid))


def reset_link(interface: str) -> None:
    """Give an interface the default link mode and MTU, which it keeps when it is moved between namespaces.

    A station's wpa_supplicant sets the link mode `dormant` (RFC 2863) and does not reset it when it is killed. The
    interface would then be dormant in an ad hoc cell, too, and would have no IPv6 address, which babeld needs.

    Raises:
        RobotError: The kernel refused the settings.
    """
    _run("ip", "link", "set", interface, "mode", "default", "mtu", str(MTU_BYTES))


def _run(program: str, *words: str) -> None:
    argv = (shutil.which(program, path=PATH) or program, *words)
    result = subprocess.run(argv, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    if result.returncode:
        cause = result.stderr.strip()
        raise RobotError(f"cannot move a radio to a robot: {program}: {cause}", remedy="start the lab again")


def find_radios(folder: Path = _FOLDER) -> list[HwsimRadio]:
    """Return the radios of hwsim in this network namespace, in the order of their numbers.

    A radio without an interface, or with monitor interfaces only, is omitted.

    Args:
        folder: Folder of the kernel's wireless devices.
    """
    radios = []
    for entry in sorted(folder.glob("phy*"), key=lambda entry: int(entry.name.removeprefix("phy"))):
        monitors: list[str] = []
        interfaces: list[str] = []
        for path in sorted((entry / "device" / "net").glob("*")):
            is_monitor = (path / "type").read_text(encoding="ascii").strip() == _ARPHRD_IEEE80211_RADIOTAP
            (monitors if is_monitor else interfaces).append(path.name)
        if interfaces and _CLASS in (entry / "device" / "subsystem").resolve().parts:
            first, *others = (entry / "macaddress").read_text(encoding="ascii").strip().split(":")
            address = ":".join((f"{int(first, 16) | _RADIO_BIT:02x}", *others))
            radios.append(HwsimRadio(entry.name, interfaces[0], address, tuple(monitors)))
    return radios


def can_use_radios() -> bool:
    """Return True if this process can use radios of hwsim: it is root, and the module is loaded."""
    return os.geteuid() == 0 and _MODULE.exists()


def require_radios(count: int, wait_s: float = _RETURN_S) -> list[HwsimRadio]:
    """Return the first `count` radios.

    Args:
        count: Number of radios.
        wait_s: Maximum time to wait for radios of a lab that has just ended.

    Raises:
        ConfigurationError: There are fewer radios.
    """
    deadline = Deadline.after(wait_s)
    while len(radios := find_radios()) < count and not deadline.expired:
        time.sleep(_POLL_S)
    if len(radios) < count:
        raise ConfigurationError(
            f"the robots and access points need {count} radios, but mac80211_hwsim has {len(radios)} here",
            remedy=f"as root: modprobe -r mac80211_hwsim; modprobe mac80211_hwsim radios={count}",
        )
    return radios[:count]
