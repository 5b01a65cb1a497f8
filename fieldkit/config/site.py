"""Site files (`fieldkit.yaml`): the robots of a lab and their roles, as frozen objects."""

import ipaddress
from pathlib import Path
from typing import Annotated

from fieldkit.config import schema
from fieldkit.config.locations import default_backend
from fieldkit.config.schema import AfterValidator, BeforeValidator, Duration, Field, Int, Strict
from fieldkit.core.errors import did_you_mean
from fieldkit.core.model import FIXED_ROLES, Control, Role, Topology


def _no_plain_password(value: object) -> object:
    if value not in ("ask", "keyring"):
        raise schema.validation_error(
            "a password must not be in a file; write `password: ask` or `password: keyring`"
        )
    return value


def is_ipv4(text: str) -> bool:
    """Return True if a text is an IPv4 address in dotted-decimal notation without leading zeros."""
    try:
        return str(ipaddress.IPv4Address(text)) == text
    except ValueError:
        return False


def _ipv4(text: str) -> str:
    if not is_ipv4(text):
        raise schema.validation_error(f"{text!r} is not an IPv4 address; the radio under test needs one")
    return text


RobotName = Annotated[
    str,
    schema.pattern_field(
        r"^[a-z][a-z0-9-]{0,30}$", "a name of at most 31 lower-case letters, digits and -, with a letter first"
    ),
]


class SiteRobot(Strict):
    """One robot of a lab.

    Attributes:
        profile: Name of its profile.
        host: Name or address for SSH; required by the field backend.
        port: SSH port.
        user: SSH user; required by the field backend.
        key: Path of the private key; without this key, the keys of the SSH agent are used.
        password: Login by password instead of a key: `ask` requests the password at the terminal once per run,
            `keyring` reads it from the system's keyring. The password itself is never written into the file.
        host_key: Pinned host key, `ssh-ed25519 AAAA...`; required by the field backend. `fieldkit enroll` writes it.
        address: Its IPv4 address on the radio under test; the default is `host`.
        links: Its IPv4 address on each further link of its profile, by the name of the link.
    """

    profile: str
    host: str | None = None
    port: Annotated[Int, Field(gt=0, lt=65536)] = 22
    user: str | None = None
    key: str | None = None
    password: Annotated[str | None, BeforeValidator(_no_plain_password)] = None
    host_key: str | None = None
    address: Annotated[str, AfterValidator(_ipv4)] | None = None
    links: dict[str, Annotated[str, AfterValidator(_ipv4)]] = Field(default_factory=dict, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _has_one_login_method(self) -> "SiteRobot":
        if self.key is not None and self.password is not None:
            raise schema.validation_error("it has a key and a password; remove one of them")
        return self


class Site(Strict):
    """A lab: its robots and their roles, in the file `fieldkit.yaml` of the current folder.

    For real robots see [field](field.md). Without a site file, or with one that has neither `robots` nor `roles`, the
    emulated backend uses two TurtleBots and a Duckiedrone.

    The emulated backend ignores `host`, `port`, `user`, `key`, `host_key` and `address`: its robots have addresses
    from 10.42.0.1 on, in the order of the file, and generated keys. With `control: radio` the operator's laptop is
    also a station, `laptop` at 10.42.0.254: it is 2 m from the relay in `master` and from the receiver in
    `masterless`, and never behind the wall of `nlos`. Its radio is 802.11n at 2.4 GHz with 17 dBm and a sensitivity
    of -82 dBm, and every packet of SSH is subject to the radio model. In `master`, packets from sender to receiver
    cross two links, so `loss` and `delay` apply twice. [Method](method-radio.md#the-emulated-radio) describes the
    radio model.

    Attributes:
        backend: Backend used if the command line gives none. The default is `emulated` if the file has the section
            `emulated`, but neither `robots` nor `roles`; otherwise `field`.
        control: `separate`: SSH has a separate network. `radio`: SSH uses the radio under test, see [two ways of
            control](field.md#two-ways-of-control).
        ros_master: Role of the robot that runs the ROS master of all robots with ROS 1, in topologies that have this
            role: [one ROS master](ros-master.md). Without it, each robot uses the master that its setup files name.
        patience: How long a command waits for a lost control connection before it fails. The first connection of a
            run is not retried.
        robots: The robots of the lab by name: lower-case letters, digits and hyphens. Only the backend `emulated` has
            default robots, which it uses if `roles` is also missing.
        roles: Robot by role, per topology. `master` needs `sender`, `receiver` and `relay`; `masterless` needs the
            first two. Further roles are for procedures that have `places` for them; trials of other procedures do not
            use their robots. Required if there are `robots`.
        emulated: Options of the emulated backend; other backends ignore them.
    """

    backend: str = "field"
    control: Control = Control.SEPARATE
    patience: Duration = 60.0
    robots: dict[RobotName, SiteRobot] = Field(default_factory=dict)
    roles: dict[Topology, dict[Role, str]] = Field(default_factory=dict)
    ros_master: Role | None = None
    emulated: dict[str, object] | None = None

    @property
    def has_default_robots(self) -> bool:
        """True if the file has neither robots nor roles, so that the backend must provide both."""
        return not {"robots", "roles"} & self.model_fields_set

    @schema.model_validator(mode="before")
    @classmethod
    def _choose_backend(cls, data: object) -> object:
        return {"backend": default_backend(data), **data} if isinstance(data, dict) else data

    @schema.model_validator(mode="after")
    def _has_robots_and_roles(self) -> "Site":
        missing = [key for key in ("robots", "roles") if key not in self.model_fields_set]
        if missing and not (self.has_default_robots and self.backend == "emulated"):
            raise schema.validation_error(
                f"required key {missing[0]!r} is missing; only the backend emulated has default robots and roles, "
                "for a file without both keys",
                remedy=f"add {': and '.join(missing)}: to it",
            )
        return self

    @schema.model_validator(mode="after")
    def _robots_are_different_machines(self) -> "Site":
        names: dict[tuple[str, int], str] = {}
        for name, robot in self.robots.items():
            other = names.setdefault((robot.host or name, robot.port), name)
            if other != name:
                raise schema.validation_error(f"{name} and {other} are the same machine", "robots", name, "host")
        return self

    @schema.model_validator(mode="after")
    def _roles_name_robots(self) -> "Site":
        for topology, robot_by_role in self.roles.items():
            for role, name in robot_by_role.items():
                if name not in self.robots:
                    robots = ", ".join(self.robots)
                    raise schema.validation_error(
                        f"roles.{topology}.{role} names {name!r}; the robots are: {robots}", "roles", topology, role
                    )
                # A procedure may define other roles. A role that resembles an unassigned fixed role is a misspelling.
                unassigned = [fixed for fixed in FIXED_ROLES if fixed not in robot_by_role]
                if role not in FIXED_ROLES and (suggestion := did_you_mean(role, unassigned, "")):
                    raise schema.validation_error(f"roles.{topology}.{role}: {suggestion}", "roles", topology, role)
            if len(set(robot_by_role.values())) < len(robot_by_role):
                raise schema.validation_error(f"roles.{topology}: one robot has two roles", "roles", topology)
        return self

    @schema.model_validator(mode="after")
    def _ros_master_has_a_robot(self) -> "Site":
        if self.has_default_robots:  # the default robots have all fixed roles
            return self
        # Only a fixed role can be the master: other roles exist only in trials of the procedures that define them.
        assigned = [
            role for role in FIXED_ROLES if any(role in robot_by_role for robot_by_role in self.roles.values())
        ]
        if self.ros_master is not None and self.ros_master not in assigned:
            raise schema.validation_error(
                f"ros_master must be one of the assigned roles: {', '.join(assigned)}", "ros_master"
            )
        return self


def load_site(path: Path) -> tuple[Site, schema.Document]:
    """Return the site file and its document, from which each backend validates its section.

    Raises:
        ConfigurationError: For the same reasons as `schema.load`.
    """
    document = schema.read(path)
    return schema.validate(document, Site), document
