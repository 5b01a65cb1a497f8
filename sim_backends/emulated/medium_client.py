"""The lab's handle on the medium process."""

from collections.abc import Mapping, Set
from typing import Self

from fieldkit.errors import ConfigurationError
from fieldkit.profiles import Radio
from sim_backends.emulated import medium_wire
from sim_backends.emulated.child import Child
from sim_backends.emulated.medium_wire import MediumStats
from sim_backends.radio.links import Position, mesh, stations_of
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.parameters import LinkParameters, Pair


class MediumClient:
    """Gives the medium the robots' TUN devices and tells it where they stand; use as a context manager.

    The medium ends as a `Child` does, and is made in a thread as that wants it. It is made at once; the first
    request waits until it is up.

    Args:
        options: The radio.
        seed: Seed of everything random in it.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(self, options: RadioOptions, *, seed: int) -> None:
        self._options = options
        self._child = Child("medium", "sim_backends.emulated.medium", words=(str(seed),))
        self._radios: dict[str, Radio] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the medium."""
        return self._child.pid

    def attach(self, name: str, address: str, radio: Radio, tun_fd: int) -> None:
        """Connect a robot.

        Args:
            name: The robot's name.
            address: Its IPv4 address on the radio with the length of the network, `10.42.0.1/24`.
            radio: Its radio.
            tun_fd: Descriptor of its TUN device; the medium gets a copy, the caller closes this one.

        Raises:
            LinkError: The medium ended or did not answer.
            RobotError: It has that name or address already.
        """
        self._child.ask({"do": "attach", "name": name, "address": address}, descriptors=[tun_fd])
        self._radios[name] = radio

    def place(
        self, positions_m: Mapping[str, Position], *, behind_wall: Set[str] = frozenset(), relay: str | None = None
    ) -> dict[Pair, LinkParameters]:
        """Put the robots in their places; packets from now on meet the links that follow.

        Args:
            positions_m: Where each robot stands, metres east, north, up. Robots not named are out of the game.
            behind_wall: The robots behind the wall.
            relay: The robot whose access point relays between the others; None for direct links.

        Returns:
            What is applied to each directed link.

        Raises:
            ConfigurationError: A robot is named that is not attached, or a relay that has no place.
            LinkError: The medium ended or did not answer.
        """
        cast = {*behind_wall, relay} if relay is not None else set(behind_wall)
        unknown = (positions_m.keys() - self._radios.keys()) | (cast - positions_m.keys())
        if unknown:
            raise ConfigurationError(
                f"robots without a radio or a place: {', '.join(sorted(unknown))}",
                remedy="attach every robot, and give each one behind the wall and the relay a position",
            )
        links = mesh(self._options, stations_of(self._radios, positions_m, behind_wall))
        self._child.ask({"do": "connect", "links": medium_wire.pack_links(links), "relay": relay})
        return links

    def stats(self) -> MediumStats:
        """Return what the medium did so far.

        Raises:
            LinkError: The medium ended or did not answer.
        """
        reply, _ = self._child.ask({"do": "stats"})
        return medium_wire.unpack_stats(reply)

    def close(self) -> None:
        """End the medium and wait until it is gone; does nothing the second time."""
        self._child.close()
