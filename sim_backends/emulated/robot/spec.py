"""Specification of an emulated robot: plain data that crosses from the lab to its init process as JSON."""

from dataclasses import dataclass
from typing import Any, Final, Literal, Self

from sim_backends.emulated.ros.messages import Definition, Sensor

SshServer = Literal["openssh", "dropbear"]
Userland = Literal["gnu", "busybox"]
Netcat = Literal["traditional", "openbsd", "ncat", "busybox"]
Ping = Literal["iputils", "busybox"]

USER: Final = "root"
HOME: Final = "/root"
STATE: Final = "/run/robot"
"""Folder in the robot of what its init process writes: files bound over `/etc`, logs, marks of readiness."""

ROS_MASTER_PORT: Final = 11311


@dataclass(frozen=True)
class RobotSpec:
    """One emulated robot.

    Attributes:
        name: Its name in the lab, and its host name.
        interface: Name of its radio interface.
        address: Its IPv4 address on the radio with the length of the network, `10.42.0.1/24`.
        hosts: Addresses of all robots of the lab by name.
        host_key: Private host key of its SSH server, OpenSSH PEM.
        authorized_key: Public key that may log in.
        ros: `builtin` or `debian`.
        ros_version: 1 or 2.
        distribution: ROS distribution that its profile names.
        setup: Setup files that its profile names.
        sensors: What it publishes.
        definitions: Those of its sensors' message types.
        ssh: Its SSH server.
        sftp: Whether that server offers SFTP.
        userland: Where `sh`, `tar`, `ip` and their like come from.
        netcat: Its only netcat, as `nc` and by its own name; None for what this machine or the userland has.
        ping: Its `ping`; None as for `netcat`.
    """

    name: str
    interface: str
    address: str
    hosts: dict[str, str]
    host_key: str
    authorized_key: str
    ros: str
    ros_version: int
    distribution: str
    setup: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    definitions: dict[str, Definition]
    ssh: SshServer = "openssh"
    sftp: bool = True
    userland: Userland = "gnu"
    netcat: Netcat | None = None
    ping: Ping | None = None

    @property
    def ip(self) -> str:
        """The address without the length of the network."""
        return self.address.partition("/")[0]

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Return what `dataclasses.asdict` and JSON made of a specification."""
        sensors = tuple(Sensor(**sensor) for sensor in data["sensors"])
        definitions = {kind: Definition(**one) for kind, one in data["definitions"].items()}
        return cls(**{**data, "setup": tuple(data["setup"]), "sensors": sensors, "definitions": definitions})
