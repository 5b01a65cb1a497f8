"""The emulated backend: the lab of a site file, or the paper's, in namespaces on this machine."""

from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import IPv4Network
from pathlib import Path
from typing import Final

from fieldkit.backends import Ask, Cast, Lab, Robot, cast_of
from fieldkit.config import Document
from fieldkit.errors import ConfigurationError
from fieldkit.events import PhaseStarted, Sink
from fieldkit.model import Topology
from fieldkit.profiles import Site, load_site
from sim_backends.emulated import lab, messages, requirements, system
from sim_backends.emulated.options import RosChoice, load_options

DEFAULT_SITE: Final = Path(__file__).with_name("default.yaml")
NETWORK: Final = IPv4Network(f"10.42.0.0/{lab.NETWORK_BITS}")

# Measured on 2 cores: three robots, from nothing to published topics.
_START_S: Final = {RosChoice.BUILTIN: 0.5, RosChoice.DEBIAN: 1.0}


class EmulatedBackend:
    """Emulated robots.

    Args:
        site: The site file; None for the paper's lab.
        document: Its document, for messages with lines.

    Raises:
        ConfigurationError: The `emulated:` section is wrong, or the lab has more robots than addresses.
    """

    def __init__(self, site: Site | None, document: Document | None) -> None:
        if site is None:
            site, document = load_site(DEFAULT_SITE)
        self._site = site
        self._options = load_options(document)
        hosts = [str(host) for host in NETWORK.hosts()]
        if len(site.robots) > len(hosts):
            raise ConfigurationError(
                f"the lab has {len(site.robots)} robots, an emulated one holds {len(hosts)}",
                where=document.where(("robots",)) if document else "",
                remedy="split the site file",
            )
        self._addresses = dict(zip(site.robots, hosts, strict=False))

    def cast(self, topology: Topology) -> Cast:
        """See `Backend.cast`; addresses follow the order of the robots in the site file."""
        cast = cast_of(self._site, topology, self._addresses)
        for role, robot in cast.items():
            _check_ros(robot)
            for sensor in lab.sensors_of(cast, role):
                messages.check(sensor)
        return cast

    @contextmanager
    def open(self, cast: Cast, *, seed: int, sink: Sink, ask: Ask) -> Iterator[Lab]:  # noqa: ARG002 (nobody is asked)
        """See `Backend.open`."""
        requirements.check()
        ros = requirements.ros_in_use(self._options.ros)
        sink(PhaseStarted("start robots", expected_s=_START_S[ros]))
        with lab.bring_up(cast, radio=self._options.radio, ros=ros, seed=seed) as up:
            yield up


def _check_ros(robot: Robot) -> None:
    ros = robot.profile.ros
    if ros.variant != "ros1":
        raise ConfigurationError(
            f"profile {robot.profile.name} runs {ros.variant}; emulated robots speak ROS 1",
            where=robot.name,
            remedy="set variant: ros1 in a copy of the profile",
        )
    outside = system.outside_own_folders(ros.command.setup)
    if outside:
        raise ConfigurationError(
            f"an emulated robot cannot hold the setup file {outside[0]}, which would lie in a folder of this machine",
            where=robot.name,
            remedy="name one below /opt, /home or /root",
        )
