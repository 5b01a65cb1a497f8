"""Variants of a robot's tools, which share names and differ in options, output and abilities."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import PurePosixPath
from types import MappingProxyType

from fieldkit.config.profiles import RobotProfile


class Tool(StrEnum):
    """A tool of the robot that has variants."""

    NETCAT = "netcat"
    PING = "ping"
    CAPTURE = "capture"
    RECORDER = "recorder"


class Netcat(StrEnum):
    """A netcat."""

    TRADITIONAL = "traditional"
    OPENBSD = "openbsd"
    NCAT = "ncat"
    BUSYBOX = "busybox"


class PingTool(StrEnum):
    """A ping; the old iputils, before 20210722, lets only root send more often than every 200 ms."""

    IPUTILS = "iputils"
    IPUTILS_OLD = "iputils-old"
    BUSYBOX = "busybox"


class Recorder(StrEnum):
    """What the profile's record command writes; `NONE`: nothing, the command or its storage plugin is missing."""

    ROSBAG = "rosbag"
    SQLITE3 = "ros2-sqlite3"
    MCAP = "ros2-mcap"
    NONE = "none"


@dataclass(frozen=True)
class Variants:
    """The tools of one robot.

    Attributes:
        netcat: Its netcat.
        ping: Its ping.
        immediate_mode: Whether its tcpdump knows `--immediate-mode` (from 4.7 on).
        recorder: What its record command writes.
        root: Whether its user is root.
        versions: What the tools that were asked say of their version.
    """

    netcat: Netcat
    ping: PingTool
    immediate_mode: bool
    recorder: Recorder
    root: bool = False
    versions: Mapping[Tool, str] = field(default_factory=lambda: MappingProxyType({}))


def expected(profile: RobotProfile) -> Variants:
    """Return what the profile's program names let expect; a plain `nc` is taken for the traditional one."""
    names = {"nc.openbsd": Netcat.OPENBSD, "ncat": Netcat.NCAT, "busybox": Netcat.BUSYBOX}
    return Variants(
        netcat=names.get(PurePosixPath(profile.tools.netcat).name, Netcat.TRADITIONAL),
        ping=PingTool.BUSYBOX if "busybox" in profile.tools.ping else PingTool.IPUTILS,
        immediate_mode=True,
        recorder=_written(profile),
    )


def _written(profile: RobotProfile) -> Recorder:
    if profile.ros is None:
        return Recorder.NONE
    if profile.ros.variant == "ros1":
        return Recorder.ROSBAG
    return Recorder.MCAP if profile.ros.command.writes.endswith(".mcap") else Recorder.SQLITE3
