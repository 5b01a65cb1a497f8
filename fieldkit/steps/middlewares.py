"""Middlewares that a topic can go over: how their ends find each other, and what a robot must have for them."""

import re
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from fieldkit.core.model import Verdict
from fieldkit.steps.scene import Said


class Over(StrEnum):
    """A middleware."""

    DDS = "dds"
    ZENOH = "zenoh"
    ROS1 = "ros1"
    ROS2 = "ros2"


class Discovery(StrEnum):
    """How the ends of a topic find each other."""

    MULTICAST = "multicast"
    PEERS = "peers"
    ROUTER = "router"
    MASTER = "master"
    ENVIRONMENT = "environment"


WAYS: Final = MappingProxyType(
    {
        Over.DDS: (Discovery.MULTICAST, Discovery.PEERS),
        Over.ZENOH: (Discovery.MULTICAST, Discovery.PEERS, Discovery.ROUTER),
        Over.ROS1: (Discovery.MASTER,),
        Over.ROS2: (Discovery.ENVIRONMENT, Discovery.MULTICAST, Discovery.PEERS),
    }
)
"""Ways of discovery of each middleware, its usual one first."""


@dataclass(frozen=True)
class Binding:
    """What a robot's Python must have for a middleware.

    Attributes:
        package: What it is called.
        load: Python that fails where it is missing.
        remedy: What brings it there.
    """

    package: str
    load: str
    remedy: str


_HERE: Final = ", if it runs on this machine with the python3 beside fieldkit"
BINDINGS: Final = MappingProxyType(
    {
        Over.DDS: Binding("cyclonedds", "import cyclonedds", f"python3 -m pip install cyclonedds{_HERE}"),
        Over.ZENOH: Binding("eclipse-zenoh", "import zenoh", f"python3 -m pip install eclipse-zenoh{_HERE}"),
        Over.ROS1: Binding(
            "rospy",
            # Where the agent looks, too.
            "import sys; sys.path.append('/usr/lib/python3/dist-packages'); import rospy",
            "sudo apt-get install python3-rospy",
        ),
        Over.ROS2: Binding(
            "rclpy",
            # It is asked for its name, for nothing else loads the RMW.
            "import rclpy, std_msgs.msg; print(rclpy.get_rmw_implementation_identifier())",
            "install the RMW that its environment names; `setup` in its profile is for the setup files of its ROS 2",
        ),
    }
)

_SAID_OTHERWISE: Final = MappingProxyType(
    {"ROS_DOMAIN_ID": "domain", "ROS_AUTOMATIC_DISCOVERY_RANGE": "discovery", "ROS_STATIC_PEERS": "discovery"}
)
"""Variables of ROS 2's environment that are no settings, and the key that says each."""

OVER_DDS: Final = frozenset({Over.DDS, Over.ROS2})
"""Those with ports by RTPS' own rule, if the RMW of ROS 2 is one over DDS."""

_VARIABLE: Final = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_RMW: Final = re.compile(r"rmw_\w+", re.ASCII)


def no_setting(name: str) -> str:
    """Return why this is no setting of ROS 2, empty where it may be one."""
    if not _VARIABLE.fullmatch(name):
        return f"settings of ros2 are variables of the environment, not {name!r}"
    return f"{name} is said by {_SAID_OTHERWISE[name]}, not by settings" if name in _SAID_OTHERWISE else ""


def judged(over: Over, said: Said) -> tuple[Verdict, str, str]:
    """Return whether a robot's Python has the middleware; of ROS 2 it says the RMW, too."""
    lines = [line for line in said.text.splitlines() if line.strip()]
    if said.ok:
        rmw = [line for line in lines if over is Over.ROS2 and _RMW.fullmatch(line)]
        return Verdict.OK, ", ".join([BINDINGS[over].package, *rmw]), ""
    remedy = f"on the robot: {BINDINGS[over].remedy}; another Python is python: in its profile"
    return Verdict.FAIL, lines[-1] if lines else "it does not say why", remedy
