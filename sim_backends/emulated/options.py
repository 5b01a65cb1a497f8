"""The `emulated:` section of a site file."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final, Literal

from fieldkit.config import schema
from fieldkit.config.schema import Bool, Document, Duration, Field, Strict
from sim_backends.emulated.robot.rootfs import NETCATS
from sim_backends.emulated.robot.spec import HELLO_S, Netcat, Ping, SshServer, Userland
from sim_backends.radio.options import RadioOptions

BOOT_S: Final = 2.0
LATE_BOUND_S: Final = 0.1


class RosChoice(StrEnum):
    """Source of a robot's ROS."""

    AUTO = "auto"
    DEBIAN = "debian"
    BUILTIN = "builtin"


ROS_FILES: Final = ("/usr/bin/rosbag", "/usr/bin/rosmaster", "/usr/lib/python3/dist-packages/rospy")
"""By which Debian's ROS is known to be installed."""


def uses_debian_ros(choice: RosChoice) -> bool:
    """Return whether robots with ROS 1 have Debian's, by choice or because it is installed."""
    if choice is RosChoice.AUTO:
        return all(Path(path).exists() for path in ROS_FILES)
    return choice is RosChoice.DEBIAN


class RobotOptions(Strict):
    """Which variant of each tool one robot has; what is not said is as on this machine.

    Attributes:
        ssh: Its SSH server.
        sftp: Whether that server offers SFTP.
        userland: `busybox`: `sh`, `tar`, `ip` and their like are busybox's, and what busybox lacks is missing.
        netcat: Its only netcat, as `nc` and by its own name.
        ping: Its `ping`.
    """

    ssh: SshServer = "openssh"
    sftp: Bool = True
    userland: Userland = "gnu"
    netcat: Netcat | None = None
    ping: Ping | None = None

    def programs(self) -> set[str]:
        """Return what this machine must have for it beside what every emulated lab needs."""
        found = {"dropbear", "dropbearconvert"} if self.ssh == "dropbear" else set()
        if self.netcat is not None:
            found.add(NETCATS[self.netcat])
        return found | ({"busybox"} if "busybox" in {self.userland, self.ping} else set())


AS_THIS_MACHINE: Final = RobotOptions.defaults()


class MeshOptions(Strict):
    """A mesh: robots forward for each other, and a routing daemon on each finds the ways.

    Attributes:
        daemon: `babeld`, which speaks Babel (RFC 8966).
        hello: How often it says hello to its neighbours, in seconds; 4 s is its own default. A way that is lost is
            replaced within a multiple of it.
    """

    daemon: Literal["babeld"]
    hello: Annotated[Duration, Field(ge=0.1, le=60)] = HELLO_S


class Ros2Options(Strict):
    """How the nodes of robots with ROS 2 find each other over the radio.

    Attributes:
        discovery: `multicast`: by multicast (DDS), by scouting (Zenoh); `peers`: each is told the addresses of all
            others; `router`: by a router, which Zenoh alone has.
        router: The robot that runs the router.
    """

    discovery: Literal["multicast", "peers", "router"] = "multicast"
    router: str | None = None

    @schema.model_validator(mode="after")
    def _a_router_runs_somewhere(self) -> "Ros2Options":
        if (self.discovery == "router") != (self.router is not None):
            raise schema.complaint("`discovery: router` and `router: ROBOT`, which runs it, go together", "router")
        return self


class EmulatedOptions(Strict):
    """Options of the emulated backend.

    Attributes:
        ros: `debian`, ROS's own master and rosbag from Debian's packages; `builtin`, fieldkit's own sensors and
            `rosbag` command; `auto`, Debian's where they are installed. Robots with ROS 2 speak over the radio unless
            it is `builtin`.
        ros2: How those find each other.
        robots: Tool variants of the robots that have others than this machine, by name.
        world: What they stand in: a file of the lab's own folder `worlds/`, or one that ships with fieldkit.
        radio: The radio between the robots.
        late_bound: A repeat is void if the medium handed a packet over so much later than its model says, in seconds.
        record_air: Whether every transmission attempt is written to the evidence; fixed links make none.
        boot: How long a robot that lost its power stays dark, in seconds; its programs start after that.
        mesh: How the robots forward for each other; None if they do not.
    """

    ros: RosChoice = RosChoice.AUTO
    ros2: Ros2Options = Ros2Options.defaults()
    robots: dict[str, RobotOptions] = Field(default_factory=dict)
    world: str = "lawn"
    radio: RadioOptions = RadioOptions.defaults()
    late_bound: Annotated[Duration, Field(gt=0)] = LATE_BOUND_S
    record_air: Bool = False
    boot: Annotated[Duration, Field(ge=0)] = BOOT_S
    mesh: MeshOptions | None = None


def load_options(document: Document | None) -> EmulatedOptions:
    """Return the options in a site file's document; the defaults without one.

    Raises:
        ConfigurationError: The section is wrong; the message has file and line.
    """
    if document is None or not document.data.get("emulated"):
        return EmulatedOptions.defaults()
    return schema.validate(document.part("emulated"), EmulatedOptions)
