"""`fieldkit enroll ROBOT`: show a robot's host key once, and pin it in the site file."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fieldkit.cli.operators import confirm
from fieldkit.cli.parser import Parser
from fieldkit.config.locations import SITE_FILE
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, FieldkitError, HostKeyError, did_you_mean, shell_command
from fieldkit.core.text import print_text
from fieldkit.remote.identity import Address, HostKey

if TYPE_CHECKING:
    from fieldkit.config.site import SiteRobot


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit enroll`."""
    parser.description = (
        "Read the SSH host key of a robot (ed25519 if it has one) without logging in, show type and fingerprint, ask "
        "for confirmation, and write the key into the site file as host_key; nothing else in the file changes. A key "
        "that is already pinned is not changed. If the robot offers another key, enroll prints both fingerprints "
        "and exits with code 3. If you answer no, the exit code is 1."
    )
    parser.add_argument("robot", metavar="ROBOT", help="name of a robot in the site file")
    parser.add_argument(
        "--site", type=Path, metavar="FILE", default=Path(SITE_FILE), help=f"site file (default: {SITE_FILE})"
    )
    parser.add_argument("--yes", action="store_true", help="do not ask for confirmation; required without a terminal")
    parser.add_argument("--replace", action="store_true", help="replace another pinned key")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Pin the key, unless it is pinned already."""
    from fieldkit.config.site_edits import pin_host_key
    from fieldkit.remote.login import read_host_key
    from fieldkit.remote.sockets import over_tcp
    from fieldkit.remote.ssh import CONNECT_S

    name, path = arguments.robot, arguments.site
    robot, where = _robot(name, path)
    address = Address(name, robot.host or "", robot.port)
    pinned_key = _pinned_key(name, robot, ignore_invalid=arguments.replace)
    robot_key = read_host_key(
        address,
        over_tcp(address.host, address.port),
        deadline=Deadline.after(CONNECT_S),
        kind=pinned_key.kind if pinned_key else "ssh-ed25519",
    )
    if robot_key == pinned_key:
        print_text(f"{name}: this key is already pinned: {robot_key.fingerprint}")
        return 0
    if pinned_key is not None and not arguments.replace:
        raise HostKeyError(
            f"the host key changed: pinned {pinned_key.fingerprint}, offered {robot_key.fingerprint}",
            where=f"{where}: {name}",
            remedy=f"if the robot was reinstalled: fieldkit enroll {name} --replace; if not, another computer "
            "answered",
        )
    _show(address, robot_key, pinned_key)
    if not arguments.yes and not confirm("pin it", remedy="compare the fingerprints, then add --yes"):
        print_text("not pinned")
        return FieldkitError.exit_code
    pin_host_key(path, name, robot_key.text)
    print_text(f"pinned in {path}")
    return 0


def _robot(name: str, path: Path) -> "tuple[SiteRobot, str]":
    """Return a robot of the site file, and its file and line there."""
    from fieldkit.config.site import load_site

    if not path.exists():
        raise ConfigurationError(
            "there is no site file", where=str(path), remedy=shell_command("fieldkit", "init", "--out", path)
        )
    site, document = load_site(path)
    if name not in site.robots:
        raise ConfigurationError(
            f"there is no robot {name!r}",
            where=str(path),
            remedy=did_you_mean(name, site.robots, f"the robots are: {', '.join(site.robots) or 'none'}"),
        )
    where = document.where(("robots", name))
    if site.robots[name].host is None:
        raise ConfigurationError(f"robot {name!r} has no host", where=where, remedy="add host: to it")
    return site.robots[name], where


def _pinned_key(name: str, robot: "SiteRobot", *, ignore_invalid: bool) -> HostKey | None:
    if robot.host_key is None:
        return None
    try:
        return HostKey.parse(robot.host_key, name)
    except ConfigurationError:
        if ignore_invalid:
            return None
        raise


def _show(address: Address, robot_key: HostKey, pinned_key: HostKey | None) -> None:
    if pinned_key is not None:
        print_text(f"pinned before: {pinned_key.kind} {pinned_key.fingerprint}")
    print_text(
        f"{address.robot} at {address.host} port {address.port} offers: {robot_key.kind} {robot_key.fingerprint}"
    )
    print_text(
        f"compare it with the output of this command on the robot's console:\n  {robot_key.fingerprint_command}"
    )
