"""Checks that this machine can run an emulated lab; each error has a remedy."""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.emulated_options import RosChoice, uses_debian_ros
from sim_backends.emulated.process import namespaces
from sim_backends.emulated.process.worker import PATH
from sim_backends.emulated.robot import tun_devices
from sim_backends.emulated.robot.spec import ROBOT_FILES, ROSCORE

PACKAGE_OF: Final = {
    "unshare": "util-linux",
    "setpriv": "util-linux",
    "ip": "iproute2",
    "sshd": "openssh-server",
    "nc.traditional": "netcat-traditional",
    "tcpdump": "tcpdump",
    "ping": "iputils-ping",
}
"""Debian package of each program that every emulated lab runs."""

ORDINARY_PACKAGE_OF: Final = {"newuidmap": "uidmap", "newgidmap": "uidmap"}
"""Debian package of each program that only an ordinary user needs."""

VARIANT_PACKAGE_OF: Final = {
    "nc.openbsd": "netcat-openbsd",
    "ncat": "ncat",
    "busybox": "busybox",
    "dropbear": "dropbear-bin",
    "dropbearconvert": "dropbear-bin",
    "babeld": "babeld",
    "batctl": "batctl",
    "hostapd": "hostapd",
    "iw": "iw",
    "nft": "nftables",
    "wpa_supplicant": "wpasupplicant",
}
"""Debian package of each program that only an option of the lab needs."""

_BATMAN_MODULE: Final = Path("/sys/module/batman_adv")

ROS_PACKAGES: Final = ("python3-rosmaster", "python3-rosbag", "python3-rospy", "python3-sensor-msgs")
_MASTER_FILES: Final = {ROSCORE: "python3-roslaunch", "/usr/lib/rosout/rosout": "rosout"}
"""Files that a ROS master for several robots needs in addition, and the Debian packages that contain them."""


def check(programs: Iterable[str] = (), *, needs_tun: bool = True) -> None:
    """Check permissions and programs.

    Args:
        programs: Programs that the options of this lab need: tool variants of its robots, a routing daemon.
        needs_tun: True if the robots have TUN or TAP devices.

    Raises:
        ConfigurationError: A permission or a program is missing.
    """
    package_of = PACKAGE_OF if namespaces.is_root() else PACKAGE_OF | ORDINARY_PACKAGE_OF
    required_programs = dict.fromkeys((*package_of, *sorted(programs)))
    missing = [program for program in required_programs if shutil.which(program, path=PATH) is None]
    if missing:
        packages = sorted({(package_of | VARIANT_PACKAGE_OF)[program] for program in missing})
        as_root = "" if namespaces.is_root() else "sudo "
        raise ConfigurationError(
            f"emulated robots need programs that are not installed: {', '.join(missing)}",
            remedy=f"{as_root}apt-get install --no-install-recommends {' '.join(packages)}",
        )
    if not namespaces.is_root():
        namespaces.check()
        _check_files()
    if needs_tun:
        os.close(tun_devices.open_device())


def check_batman() -> None:
    """Raise ConfigurationError if the module batman-adv is not loaded; a robot's namespace cannot load it."""
    if not _BATMAN_MODULE.exists():
        raise ConfigurationError(
            "`mesh: {protocol: batman-adv}` needs the kernel module batman-adv, which is not loaded",
            remedy="as root: modprobe batman-adv; or write protocol: babel",
        )


def _check_files() -> None:
    """Raise ConfigurationError if a file that each robot replaces by a mount is missing; only root can create it."""
    missing = [path for path in ROBOT_FILES if not Path(path).exists()]
    if missing:
        raise ConfigurationError(
            f"this machine has no {', '.join(missing)}; each robot mounts a separate file there",
            remedy=f"sudo touch {' '.join(missing)}",
        )


def ros_in_use(choice: RosChoice) -> RosChoice:
    """Return the source of ROS, `debian` or `builtin`, for a choice.

    Raises:
        ConfigurationError: Debian's ROS is chosen and not installed.
    """
    if choice is RosChoice.DEBIAN and not uses_debian_ros(RosChoice.AUTO):
        raise ConfigurationError(
            "the site file requests Debian's ROS, which is not installed",
            remedy=f"apt-get install --no-install-recommends {' '.join(ROS_PACKAGES)}, or write ros: builtin",
        )
    return RosChoice.DEBIAN if uses_debian_ros(choice) else RosChoice.BUILTIN


def check_shared_master(ros: RosChoice) -> None:
    """Check that this machine can run one ROS master for several robots.

    Args:
        ros: Source of the robots' ROS.

    Raises:
        ConfigurationError: Debian's ROS, or a program that roscore starts, is not installed.
    """
    packages = [package for path, package in _MASTER_FILES.items() if not Path(path).exists()]
    if ros is RosChoice.BUILTIN:
        packages = [*ROS_PACKAGES, *packages]
    if packages:
        raise ConfigurationError(
            "the site file gives robots one ROS master (ros_master), which for emulated robots needs Debian's ROS",
            remedy=f"apt-get install --no-install-recommends {' '.join(packages)}, and write ros: debian or "
            "ros: auto under emulated; or remove ros_master",
        )
