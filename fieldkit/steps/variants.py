"""Variants of a robot's tools: implementations with the same name but different options, output and features."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import PurePosixPath
from types import MappingProxyType

from fieldkit.config.profiles import RobotProfile


class Tool(StrEnum):
    """A tool that has variants."""

    NETCAT = "netcat"
    PING = "ping"
    CAPTURE = "capture"
    RECORDER = "recorder"


class Netcat(StrEnum):
    """A variant of netcat."""

    TRADITIONAL = "traditional"
    OPENBSD = "openbsd"
    NCAT = "ncat"
    BUSYBOX = "busybox"


class PingTool(StrEnum):
    """A variant of ping; iputils before 20210722 allows intervals below 200 ms only for root."""

    IPUTILS = "iputils"
    IPUTILS_OLD = "iputils-old"
    BUSYBOX = "busybox"


class Recorder(StrEnum):
    """The format that the profile's record command writes; `NONE` if the command or its storage plugin is missing."""

    ROSBAG = "rosbag"
    SQLITE3 = "ros2-sqlite3"
    MCAP = "ros2-mcap"
    NONE = "none"


@dataclass(frozen=True)
class Variants:
    """The tools of one robot.

    Attributes:
        netcat: Variant of netcat.
        ping: Variant of ping.
        immediate_mode: Whether its tcpdump supports `--immediate-mode` (since 4.7).
        recorder: Format that its record command writes.
        root: Whether the login user is root.
        versions: Version text of each tool whose version was queried.
    """

    netcat: Netcat
    ping: PingTool
    immediate_mode: bool
    recorder: Recorder
    root: bool = False
    versions: Mapping[Tool, str] = field(default_factory=lambda: MappingProxyType({}))


def expected(profile: RobotProfile) -> Variants:
    """Return the variants expected from the program names of a profile.

    A netcat with any other name, such as `nc`, counts as the traditional one. The versions are assumed to be new.
    """
    names = {"nc.openbsd": Netcat.OPENBSD, "ncat": Netcat.NCAT, "busybox": Netcat.BUSYBOX}
    return Variants(
        netcat=names.get(PurePosixPath(profile.tools.netcat).name, Netcat.TRADITIONAL),
        ping=PingTool.BUSYBOX if "busybox" in profile.tools.ping else PingTool.IPUTILS,
        immediate_mode=True,
        recorder=_expected_recorder(profile),
    )


def _expected_recorder(profile: RobotProfile) -> Recorder:
    if profile.ros is None:
        return Recorder.NONE
    if profile.ros.variant == "ros1":
        return Recorder.ROSBAG
    return Recorder.MCAP if profile.ros.command.writes.endswith(".mcap") else Recorder.SQLITE3
