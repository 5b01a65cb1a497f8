"""What this machine must have before an emulated lab can come up; each lack is named with its remedy."""

import os
import shutil
from pathlib import Path
from typing import Final

from fieldkit.errors import ConfigurationError
from sim_backends.emulated import tun
from sim_backends.emulated.child import PATH
from sim_backends.emulated.options import RosChoice

PACKAGE_OF: Final = {
    "unshare": "util-linux",
    "setpriv": "util-linux",
    "ip": "iproute2",
    "sshd": "openssh-server",
    "nc.traditional": "netcat-traditional",
    "tcpdump": "tcpdump",
    "ping": "iputils-ping",
}
"""Debian package per program that an emulated lab runs."""

ROS_PACKAGES: Final = ("python3-rosmaster", "python3-rosbag", "python3-rospy", "python3-sensor-msgs")
_ROS_FILES: Final = ("/usr/bin/rosbag", "/usr/bin/rosmaster", "/usr/lib/python3/dist-packages/rospy")


def check() -> None:
    """Check rights and programs.

    Raises:
        ConfigurationError: Something is missing.
    """
    if os.geteuid() != 0:
        raise ConfigurationError("emulated robots need root: they make network namespaces", remedy="run it by sudo")
    missing = [program for program in PACKAGE_OF if shutil.which(program, path=PATH) is None]
    if missing:
        packages = sorted({PACKAGE_OF[program] for program in missing})
        raise ConfigurationError(
            f"emulated robots need programs that are not installed: {', '.join(missing)}",
            remedy=f"apt-get install --no-install-recommends {' '.join(packages)}",
        )
    if not os.access(tun.DEVICE, os.R_OK | os.W_OK):
        raise ConfigurationError(
            f"emulated robots need {tun.DEVICE}, which is missing or closed to this user",
            remedy="load the module: modprobe tun; in a container, start it with --device /dev/net/tun",
        )


def ros_in_use(choice: RosChoice) -> RosChoice:
    """Return `debian` or `builtin` for a choice.

    Raises:
        ConfigurationError: Debian's ROS is chosen and not installed.
    """
    installed = all(Path(path).exists() for path in _ROS_FILES)
    if choice is RosChoice.DEBIAN and not installed:
        raise ConfigurationError(
            "the site file asks for Debian's ROS, which is not installed",
            remedy=f"apt-get install --no-install-recommends {' '.join(ROS_PACKAGES)}, or write ros: builtin",
        )
    if choice is RosChoice.AUTO:
        return RosChoice.DEBIAN if installed else RosChoice.BUILTIN
    return choice
