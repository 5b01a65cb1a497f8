"""The interface of radio models, and Wi-Fi stations in a world."""

from collections.abc import Callable, Mapping, Sequence, Set
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Protocol

from typing_extensions import override

from fieldkit.core.model import LinkSample, Vector
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.core.links import Delay, Delivery, LinkCounters, LossLog, Pair, Payload
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.mac.channel import Emitter
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.mac.packet_delivery import PacketDelivery
from sim_backends.radio.phy.transmissions import Emission
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.wifi import Wifi
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.motion import Attitude
from sim_backends.world.world import World

if TYPE_CHECKING:
    from sim_backends.radio.infrastructure.infrastructure import Infrastructure

PathLosses = Callable[[], Mapping[Pair, float]]
"""Returns path losses in dB, by transmitter and receiver."""


class RadioModel(Protocol[Payload]):
    """A radio model, which delivers packets at computed times, in ns. Times passed to it must not decrease."""

    @property
    def uses_attitudes(self) -> bool:
        """True if `place` needs the attitudes of the stations."""
        ...

    def place(
        self,
        now_ns: int,
        positions_m: Mapping[str, Vector],
        relay: str | None,
        velocities_m_s: Mapping[str, Vector] | None = None,
        attitudes: Mapping[str, Attitude] | None = None,
    ) -> None:
        """Set the current positions of the stations; stations without a position are out of range.

        Args:
            now_ns: Current time.
            positions_m: Positions in metres east, north, up.
            relay: Station whose access point relays between the others; None for direct links.
            velocities_m_s: Velocities; None if all stations are at rest.
            attitudes: Attitudes of stations; the others keep theirs, which is initially level and to the east.
        """
        ...

    def send(
        self,
        now_ns: int,
        source: str,
        payload: Payload,
        size_bytes: int,
        destination: str | None,
        *,
        packet: PacketIdentity | None = None,
        before: Delay = 0,
        dscp: int = 0,
    ) -> None:
        """Send a packet at `now_ns`.

        Args:
            now_ns: Current time.
            source: Name of the sender.
            payload: Content of the packet.
            size_bytes: Its size, without MAC header.
            destination: Name of the receiver; None for a broadcast.
            packet: Identity from which its random numbers are derived; None to number the packets of the source in
                order.
            before: Delay that the packet already has, for example from an earlier hop.
            dscp: Its DSCP, for stations with access categories.

        Raises:
            KeyError: There is no link from `source` towards `destination`.
        """
        ...

    def next_event_ns(self) -> int | None:
        """Return the time of the next event that `deliveries` processes, or None if there is none."""
        ...

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return the packets that arrived up to `now_ns` and were not returned before, in order of arrival."""
        ...

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return the current counters of each link."""
        ...

    def use_meter(self) -> None:
        """Start the counters of the radio drivers, for `sample`."""
        ...

    def sample(self, now_ns: int, utc_ns: int) -> dict[str, LinkSample]:
        """Return the driver statistics of each station since `use_meter`, with the timestamp `utc_ns`."""
        ...

    def log_losses(self, log: LossLog | None) -> None:
        """Pass every later loss to `log`; None stops logging."""
        ...

    def disturb(self, now_ns: int, off: Set[str], cut: Set[Pair]) -> None:
        """Set the stations whose radios are off and the links that are cut, replacing earlier ones.

        Args:
            now_ns: Current time.
            off: Stations whose radio is off. Packets queued at a station that is switched off are lost.
            cut: Pairs of stations that cannot receive each other at any distance; a pair means both directions.
        """
        ...

    def jam(self, now_ns: int, emitters: Sequence[Emitter]) -> None:
        """Set the jammers that send noise until the next call.

        Raises:
            ConfigurationError: There are jammers, and the model does not support noise.
        """
        ...

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Pass every later transmission attempt to `log`; None stops logging. Fixed links have no attempts."""
        ...


class WifiInWorld(Wifi[Payload]):
    """Wi-Fi stations in a world.

    Args:
        seed: Seed of all random draws.
        options: Radio options.
        antennas: The stations.
        world: Obstacles between the stations; None for open ground.
        path_losses_db: Returns the mean losses that replace losses in the world, by transmitter and receiver; None if
            there are none.
    """

    def __init__(
        self,
        seed: int,
        options: RadioOptions,
        antennas: Mapping[str, Antenna],
        world: World | None,
        *,
        path_losses_db: PathLosses | None = None,
    ) -> None:
        self._infrastructure: Infrastructure | None = None
        make_delivery: type[PacketDelivery[Payload]] = PacketDelivery
        if options.has_infrastructure and antennas:
            # Radios without infrastructure do not import these modules.
            from sim_backends.radio.infrastructure import infrastructure, managed_delivery  # noqa: PLC0415

            make_delivery = managed_delivery.ManagedDelivery
            self._infrastructure = infrastructure.Infrastructure(seed, options, antennas, world)
            antennas = self._infrastructure.antennas
        self._world_channel = WorldChannel(seed, antennas, options, world)
        self._names = tuple(antennas)
        self._path_losses_db = path_losses_db
        super().__init__(self._world_channel, seed, queue_packets=options.queue_packets, make_delivery=make_delivery)
        if self._infrastructure is not None:
            self._infrastructure.start(self._world_channel, self._exchange)
            self._robots, self._linked_names = self._infrastructure.robots, self._infrastructure.linked_names

    @property
    def uses_attitudes(self) -> bool:
        """Implement `RadioModel.uses_attitudes`."""
        return self._world_channel.uses_attitudes

    def place(
        self,
        now_ns: int,
        positions_m: Mapping[str, Vector],
        relay: str | None,
        velocities_m_s: Mapping[str, Vector] | None = None,
        attitudes: Mapping[str, Attitude] | None = None,
    ) -> None:
        """Implement `RadioModel.place`."""
        self.advance(now_ns)
        if self._path_losses_db is not None:
            self._world_channel.use_path_losses(self._path_losses_db())
        infrastructure = self._infrastructure
        if infrastructure is not None and infrastructure.positions_m:
            positions_m = {**positions_m, **infrastructure.positions_m}
        self._world_channel.move(now_ns, positions_m, velocities_m_s, attitudes)
        self.set_relay(relay)
        if infrastructure is not None and infrastructure.roaming is not None:
            infrastructure.roaming.start(now_ns)

    @override
    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Implement `RadioModel.log_attempts`; management frames and frames of neighbours are omitted."""
        infrastructure = self._infrastructure
        super().log_attempts(
            log if log is None or infrastructure is None else partial(infrastructure.log_packet, log)
        )

    @override
    def set_relay(self, name: str | None) -> None:
        super().set_relay(name)
        if self._infrastructure is not None:
            self._infrastructure.use_power_save()

    @override
    def _cells(self) -> Mapping[int, int | None] | None:
        roaming = None if self._infrastructure is None else self._infrastructure.roaming
        return None if roaming is None else roaming.cells

    def disturb(self, now_ns: int, off: Set[str], cut: Set[Pair]) -> None:
        """Implement `RadioModel.disturb`."""
        self.switch_off(now_ns, off)
        self._world_channel.cut([*cut, *product(off, self._names)])

    def jam(self, now_ns: int, emitters: Sequence[Emitter]) -> None:
        """Implement `RadioModel.jam`."""
        if self._infrastructure is not None:
            self.advance(now_ns)
            self._infrastructure.jam(now_ns, emitters)
            return
        received_mw = self._world_channel.received_mw
        self.set_emissions(
            now_ns,
            {
                emitter.name: Emission(now_ns, received_mw(emitter.position_m, emitter.power_dbm))
                for emitter in emitters
            },
        )
