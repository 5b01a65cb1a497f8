"""The lab's handle on the medium process."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Self

from fieldkit.config.profiles import Radio
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import DelayParts, LinkSample, Vector
from sim_backends.emulated.medium import air_log
from sim_backends.emulated.medium.framing import IP, Framing
from sim_backends.emulated.medium.ports import MediumStats, unpack_links, unpack_stats
from sim_backends.emulated.process.worker import Worker
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.world_channel import antenna_of
from sim_backends.world.world import World


class MediumClient:
    """Gives the medium the robots' TUN or TAP devices and tells it where they stand; use as a context manager.

    The medium ends as a `Worker` does, and is made in a thread as that wants it. It is made at once; the first
    request waits until it is up.

    Args:
        options: The radio.
        world: What stands between the robots; None for open ground.
        seed: Seed of everything random in it.
        framing: What the devices carry.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(
        self, options: RadioOptions, world: World | None = None, *, seed: int, framing: Framing = IP
    ) -> None:
        self._options = options
        self._world = world
        self._told = False
        self._worker = Worker("medium", "sim_backends.emulated.medium.process", words=(str(seed), framing.name))
        self._robots: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the medium."""
        return self._worker.pid

    def attach(self, name: str, address: str, radio: Radio, fd: int) -> None:
        """Connect a robot.

        Args:
            name: The robot's name.
            address: Its IPv4 address on the radio with the length of the network, `10.42.0.1/24`.
            radio: Its radio.
            fd: Descriptor of its device, or another of which each read gives one packet as framed and each write
                takes one, as of a socket of packets; the medium gets a copy, the caller closes this one.

        Raises:
            LinkError: The medium ended or did not answer.
            RobotError: It has that name or address already.
        """
        antenna = asdict(antenna_of(radio))
        self._worker.ask({"do": "attach", "name": name, "address": address, "antenna": antenna}, descriptors=[fd])
        self._robots.add(name)

    def place(
        self,
        positions_m: Mapping[str, Vector],
        *,
        relay: str | None = None,
        velocities_m_s: Mapping[str, Vector] = MappingProxyType({}),
    ) -> None:
        """Put the robots in their places; packets from now on meet what stands between them.

        A place holds until the next call: a velocity moves nobody, it makes the fading as fast as a moving robot's.

        Args:
            positions_m: Where each robot's antenna is, metres east, north, up. Robots not named are out of the game.
            relay: The robot whose access point relays between the others; None where they talk directly.
            velocities_m_s: How fast robots move, metres per second east, north, up; those not named stand.

        Raises:
            ConfigurationError: A robot is named that is not attached, or a relay that has no place.
            LinkError: The medium ended or did not answer.
        """
        unknown = (positions_m.keys() - self._robots) | ({relay} - {None} - positions_m.keys())
        if unknown:
            raise ConfigurationError(
                f"robots without a radio or a place: {', '.join(sorted(map(str, unknown)))}",
                remedy="attach every robot, and give the relay a position",
            )
        if not self._told:
            world = None if self._world is None else self._world.model_dump(mode="json")
            self._worker.ask({"do": "use", "options": self._options.model_dump(mode="json"), "world": world})
            self._told = True
        velocities = dict(velocities_m_s)
        self._worker.ask({"do": "place", "positions": positions_m, "relay": relay, "velocities": velocities})

    def record(self, folder: Path | None) -> None:
        """Write what goes over the air from now on to files in `folder` (see `air_log`), or no longer with None.

        Raises:
            LinkError: The medium ended or did not answer.
            OSError: The files cannot be made.
        """
        with ExitStack() as stack:
            names = () if folder is None else (folder / air_log.PCAP, folder / air_log.CSV)
            files = [stack.enter_context(name.open("wb")) for name in names]
            self._worker.ask({"do": "record"}, descriptors=[file.fileno() for file in files])

    def stats(self) -> MediumStats:
        """Return what the medium did so far.

        Raises:
            LinkError: The medium ended or did not answer.
        """
        reply, _ = self._worker.ask({"do": "stats"})
        return unpack_stats(reply)

    def delays(self, source: str, destination: str, protocol: int, port: int) -> DelayParts:
        """Return what the packets of one flow that were delivered were delayed by since this was asked first.

        Args:
            source: The robot that sends.
            destination: The robot that receives.
            protocol: IP protocol number, of TCP or UDP.
            port: Port of `destination`.

        Raises:
            LinkError: The medium ended or did not answer.
            RobotError: It has no such robot.
        """
        request = {"do": "delays", "source": source, "destination": destination, "protocol": protocol, "port": port}
        reply, _ = self._worker.ask(request)
        return DelayParts(**reply)

    def links(self, *, go_on: bool) -> dict[str, list[LinkSample]]:
        """Return what the radios told of their links since this was asked last, by robot, and now.

        Args:
            go_on: Whether to sample them from now on.

        Raises:
            LinkError: The medium ended or did not answer.
        """
        reply, _ = self._worker.ask({"do": "links", "go_on": go_on})
        return unpack_links(reply)

    def demand_up(self) -> None:
        """Return if the medium runs; raises as `Worker.demand_up`."""
        self._worker.demand_up()

    def close(self) -> None:
        """End the medium and wait until it is gone; does nothing the second time."""
        self._worker.close()
