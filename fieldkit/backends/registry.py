"""Installed backends by name, and the cast that a site file gives them."""

from collections.abc import Mapping

from fieldkit.backends.protocols import Backend, BackendFactory, Cast, Robot
from fieldkit.config.profiles import Site, load_profile
from fieldkit.config.schema import Document
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import Role, Topology


def load_backend(name: str, site: Site | None, document: Document | None) -> Backend:
    """Return the backend `name` for a site file.

    Raises:
        ConfigurationError: No such backend is installed, it cannot be loaded, or the site file does not give what it
            needs.
    """
    installed = {point.name: point for point in plugins.points(plugins.BACKENDS)}
    if name not in installed:
        remedy = nearest(name, installed, f"installed: {', '.join(installed)}")
        raise ConfigurationError(f"there is no backend {name!r}", remedy=remedy)
    factory: BackendFactory = plugins.load(installed[name])
    return factory(site, document)


def cast_of(site: Site, topology: Topology, addresses: Mapping[str, str]) -> Cast:
    """Return the cast that a site file gives for a topology.

    Args:
        site: The site file.
        topology: The topology.
        addresses: Address on the radio per robot name.

    Raises:
        ConfigurationError: The site file has no roles for the topology, or names a profile that does not exist.
    """
    if topology not in site.roles:
        raise ConfigurationError(
            f"the site file gives no roles for topology {topology}",
            remedy=f"add roles.{topology}, or use --topology {next(iter(site.roles), 'masterless')}",
        )
    names = site.roles[topology]
    profiles = {
        name: load_profile(name) for name in dict.fromkeys(site.robots[robot].profile for robot in names.values())
    }
    return {
        role: Robot(
            name=names[role],
            address=addresses[names[role]],
            profile=profiles[site.robots[names[role]].profile],
            control=site.control,
        )
        for role in Role
        if role in names
    }
