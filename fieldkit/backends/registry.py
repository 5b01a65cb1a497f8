"""Installed backends by name, and the cast (the robot in each role) that a site file defines."""

from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from types import MappingProxyType

from fieldkit.backends.protocols import Backend, BackendFactory, Cast, Robot, RobotLink
from fieldkit.config.profiles import RobotProfile, load_profile
from fieldkit.config.schema import Document
from fieldkit.config.site import Site
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Topology, sort_roles


def load_backend(name: str, site: Site | None, document: Document | None) -> Backend:
    """Return the backend `name` for a site file.

    Raises:
        ConfigurationError: No such backend is installed, it cannot be loaded, or the site file lacks an entry that it
            needs.
    """
    installed = {point.name: point for point in plugins.entry_points(plugins.BACKENDS)}
    if name not in installed:
        remedy = did_you_mean(name, installed, f"installed: {', '.join(installed)}")
        is_in_site_file = site is not None and document is not None and site.backend == name
        where = document.where(("backend",)) if document and is_in_site_file else ""
        raise ConfigurationError(f"there is no backend {name!r}", where=where, remedy=remedy)
    factory: BackendFactory = plugins.load(installed[name])
    return factory(site, document)


LinkAddresses = Mapping[str, Mapping[str, str]]
"""For each robot, by its name, the address on each of its further links, by the name of the link."""


def cast_of(
    site: Site,
    document: Document | None,
    topology: Topology,
    addresses: Mapping[str, str],
    link_addresses: LinkAddresses = MappingProxyType({}),
) -> Cast:
    """Return the cast that a site file defines for a topology.

    Args:
        site: The site file.
        document: Its document, for messages with lines.
        topology: The topology.
        addresses: Address on the radio per robot name.
        link_addresses: Addresses on further links.

    Raises:
        ConfigurationError: The site file has no roles for the topology, or names a profile that does not exist. It
            lacks the address of a robot on a link of its profile, or has an address on a link that the profile does
            not have. The role of the ROS master is assigned to a robot without ROS 1.
    """
    if topology not in site.roles:
        alternative = "".join(f", or use --topology {name}" for name in list(site.roles)[:1])
        raise ConfigurationError(
            f"the site file gives no roles for topology {topology}",
            where=document.where(("roles",)) if document else "",
            remedy=f"add roles.{topology}{alternative}",
        )
    names = site.roles[topology]
    profiles = profiles_of(site, document, names.values())
    master = names.get(site.ros_master) if site.ros_master else None
    if master is not None and not _runs_ros1(profiles[master]):
        raise ConfigurationError(
            f"ros_master: {master} has the role {site.ros_master}, but its profile {profiles[master].name} has no "
            "ROS 1",
            where=document.where(("ros_master",)) if document else "",
            remedy="name the role of a robot that can run roscore, or remove the line",
        )
    return {
        role: Robot(
            name=names[role],
            address=addresses[names[role]],
            profile=profiles[names[role]],
            links=_links_of(names[role], profiles[names[role]], link_addresses.get(names[role], {}), document),
            control=site.control,
            ros_master=addresses[master] if master and _runs_ros1(profiles[names[role]]) else "",
        )
        for role in sort_roles(names)
    }


def _links_of(
    name: str, profile: RobotProfile, addresses: Mapping[str, str], document: Document | None
) -> dict[str, RobotLink]:
    """Return a robot's ends of its further links, by the name of the link."""
    where = document.where(("robots", name)) if document else ""
    further_links = profile.further_links
    for link in addresses:
        if link not in further_links:
            raise ConfigurationError(
                f"{name} has an address on the link {link!r}, which its profile {profile.name} does not have",
                where=where,
                remedy=did_you_mean(
                    link, further_links, f"further links of the profile: {', '.join(further_links) or 'none'}"
                ),
            )
    missing = [link for link in further_links if link not in addresses]
    if missing:
        raise ConfigurationError(
            f"{name} has no address on the link {missing[0]!r} of its profile {profile.name}",
            where=where,
            remedy=f"add links: {{{missing[0]}: ADDRESS}} to it",
        )
    return {link: RobotLink(interface=further_links[link], address=address) for link, address in addresses.items()}


def _runs_ros1(profile: RobotProfile) -> bool:
    return profile.ros is not None and profile.ros.variant == "ros1"


def profiles_of(site: Site, document: Document | None, robots: Iterable[str]) -> dict[str, RobotProfile]:
    """Return the profile of each robot by the robot's name; each file is read once.

    Args:
        site: The site file.
        document: Its document, for messages with lines.
        robots: Names of robots in the site file.

    Raises:
        ConfigurationError: A profile is invalid, does not exist, or is of a robot that no trial can use; the message
            has the line of the site file.
    """
    profiles_by_name: dict[str, RobotProfile] = {}
    profiles = {}
    for robot in robots:
        name = site.robots[robot].profile
        with document.locating_errors("robots", robot, "profile") if document else nullcontext():
            profiles[robot] = (
                profiles_by_name[name]
                if name in profiles_by_name
                else profiles_by_name.setdefault(name, load_profile(name))
            )
            if reason := profiles[robot].unsupported:
                remedy = "give this robot another profile, or remove it from the site file"
                raise ConfigurationError(f"no trial can use the profile {name}: {reason}", remedy=remedy)
    return profiles
