"""Middlewares of topics: their discovery methods, and the Python packages that a robot needs for them."""

import re
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from fieldkit.core.model import Verdict
from fieldkit.steps.scene import CommandResult


class MiddlewareName(StrEnum):
    """Middleware of a topic, with the Python library that fieldkit uses: see `BINDINGS`.

    `DDS` and `ZENOH` use their libraries directly. `ROS2` uses rclpy of the robot's own ROS 2, with any RMW (ROS
    middleware implementation).
    """

    DDS = "dds"
    ZENOH = "zenoh"
    ROS1 = "ros1"
    ROS2 = "ros2"


class Discovery(StrEnum):
    """Method by which publishers and subscribers discover each other.

    `ENVIRONMENT` is the method that the environment of the robot's own ROS 2 selects.
    """

    MULTICAST = "multicast"
    PEERS = "peers"
    ROUTER = "router"
    MASTER = "master"
    ENVIRONMENT = "environment"


DISCOVERY_METHODS: Final = MappingProxyType(
    {
        MiddlewareName.DDS: (Discovery.MULTICAST, Discovery.PEERS),
        MiddlewareName.ZENOH: (Discovery.MULTICAST, Discovery.PEERS, Discovery.ROUTER),
        MiddlewareName.ROS1: (Discovery.MASTER,),
        MiddlewareName.ROS2: (Discovery.ENVIRONMENT, Discovery.MULTICAST, Discovery.PEERS),
    }
)
"""Discovery methods of each middleware, the default first."""


@dataclass(frozen=True)
class Binding:
    """The Python package that a robot needs for a middleware.

    Attributes:
        package: Name of the package.
        load: Python code that fails if the package is missing.
        remedy: How to install it.
    """

    package: str
    load: str
    remedy: str


_LAB_NOTE: Final = "; the robots of a lab use the Python that runs fieldkit"
BINDINGS: Final = MappingProxyType(
    {
        MiddlewareName.DDS: Binding(
            "cyclonedds", "import cyclonedds", f"python3 -m pip install cyclonedds{_LAB_NOTE}"
        ),
        MiddlewareName.ZENOH: Binding(
            "eclipse-zenoh", "import zenoh", f"python3 -m pip install eclipse-zenoh{_LAB_NOTE}"
        ),
        MiddlewareName.ROS1: Binding(
            "rospy",
            # The agent searches this folder, too.
            "import sys; sys.path.append('/usr/lib/python3/dist-packages'); import rospy",
            "sudo apt-get install python3-rospy",
        ),
        MiddlewareName.ROS2: Binding(
            "rclpy",
            # The RMW is loaded only when its name is queried.
            "import rclpy, std_msgs.msg; print(rclpy.get_rmw_implementation_identifier())",
            "install the RMW that its environment names; list the setup files of its ROS 2 as `setup` in its profile",
        ),
    }
)

_KEY_OF_VARIABLE: Final = MappingProxyType(
    {"ROS_DOMAIN_ID": "domain", "ROS_AUTOMATIC_DISCOVERY_RANGE": "discovery", "ROS_STATIC_PEERS": "discovery"}
)
"""Environment variables of ROS 2 that are invalid as settings, and the key of the step that sets each of them."""

OVER_DDS: Final = frozenset({MiddlewareName.DDS, MiddlewareName.ROS2})
"""Middlewares whose ports follow the rule of RTPS (for ROS 2, if its RMW uses DDS)."""

_VARIABLE: Final = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_RMW: Final = re.compile(r"rmw_\w+", re.ASCII)


def invalid_setting_reason(name: str) -> str:
    """Return the reason why `name` is not a setting of ROS 2; empty if it is valid."""
    if not _VARIABLE.fullmatch(name):
        return f"settings of ros2 are environment variables, not {name!r}"
    return f"{name} is set by the key {_KEY_OF_VARIABLE[name]}, not in settings" if name in _KEY_OF_VARIABLE else ""


def judge_binding(over: MiddlewareName, result: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the output of `Binding.load`.

    If the package is present, the detail is its name, for ROS 2 with the RMW, and the remedy is empty.
    """
    lines = [line for line in result.text.splitlines() if line.strip()]
    if result.ok:
        rmw = [line for line in lines if over is MiddlewareName.ROS2 and _RMW.fullmatch(line)]
        return Verdict.OK, ", ".join([BINDINGS[over].package, *rmw]), ""
    remedy = f"on the robot: {BINDINGS[over].remedy}; to use another Python, write python: in its profile"
    return Verdict.FAIL, lines[-1] if lines else "the program printed nothing", remedy
