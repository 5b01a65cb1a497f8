"""The infrastructure around robots: access points, neighbouring networks and microwave ovens."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.radio.infrastructure.interference import MicrowaveOven, NeighbourTraffic
from sim_backends.radio.infrastructure.managed_delivery import ManagedDelivery, ManagementFrame
from sim_backends.radio.infrastructure.roaming import MONITOR_NS, Roaming
from sim_backends.radio.infrastructure_options import AccessPointOptions, NeighbourNetworkOptions
from sim_backends.radio.mac.channel import Emitter
from sim_backends.radio.mac.frame_exchange import FrameExchange
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.mac.power_save import BEACON_INTERVAL_NS
from sim_backends.radio.phy.modes import BAND_2_4, ENERGY_DETECTION_DBM
from sim_backends.radio.phy.transmissions import Emission
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel, milliwatt
from sim_backends.world.obstacles import Place
from sim_backends.world.world import World

_JAMMER: Final = "jammer "
_OVEN: Final = "oven "


def conflict(options: RadioOptions, robots: Collection[str], *, has_relay: bool) -> str | None:
    """Return the reason why access points and neighbours cannot be combined with these robots, or None."""
    names = [*robots, *options.access_points, *options.neighbours]
    duplicate = next((name for name in names if names.count(name) > 1), None)
    if duplicate is not None:
        return f"two of the robots, radio.access_points and radio.neighbours have the name {duplicate}"
    if options.access_points and has_relay:
        return "with radio.access_points no robot can be an access point: use the topology masterless"
    return None


def station_place_m(at_m: Place, height_m: float, world: World | None) -> Vector:
    """Return the position of a station at a height above the ground, which is flat without a world."""
    east_m, north_m = (float(metres) for metres in at_m)
    ground_m = 0.0 if world is None else world.ground_m((east_m, north_m))
    return east_m, north_m, ground_m + height_m


class Infrastructure:
    """Stations and sources of noise that are not robots.

    Args:
        seed: Seed of all random draws.
        options: Radio options.
        robots: Radios of the robots.
        world: The ground below the stations; None for flat ground.

    Attributes:
        antennas: All stations: robots, access points, neighbours.
        positions_m: Positions of the stations that are not robots.
        robots: Indices of the robots.
        roaming: The association of the robots; None without access points.

    Raises:
        ConfigurationError: Two stations have the same name.
    """

    def __init__(self, seed: int, options: RadioOptions, robots: Mapping[str, Antenna], world: World | None) -> None:
        if problem := conflict(options, robots, has_relay=False):
            raise ConfigurationError(problem, remedy="rename one of them")
        self._seed = seed
        self._options = options
        self._world = world
        # The other stations have the radio of the first robot, without power save and with an isotropic antenna.
        first = next(iter(robots.values()))
        phy = None if first.phy is None else replace(first.phy, power_save_timeout_ns=None)
        stations: dict[str, AccessPointOptions | NeighbourNetworkOptions] = {
            **options.access_points,
            **options.neighbours,
        }
        self.antennas: dict[str, Antenna] = dict(robots) | {
            name: replace(first, tx_power_dbm=float(station.tx_power_dbm), phy=phy, pattern=None)
            for name, station in stations.items()
        }
        self.positions_m = {
            name: self._position_m(station.at_m, station.height) for name, station in stations.items()
        }
        self.robots: Sequence[int] = range(len(robots))
        self.roaming: Roaming | None = None
        self._access_points: Sequence[int] = ()
        self._ovens: list[MicrowaveOven] = []
        self._jammers: Mapping[str, Emission] = {}
        self._channel: WorldChannel
        self._exchange: FrameExchange[Any]

    def start(self, channel: WorldChannel, exchange: FrameExchange[Any]) -> None:
        """Start beacons, neighbours and ovens on a channel with all `antennas`."""
        options, delivery = self._options, exchange.delivery
        assert isinstance(delivery, ManagedDelivery)
        self._channel, self._exchange = channel, exchange
        index = {name: number for number, name in enumerate(channel.names)}
        delivery.robots = self.robots
        delivery.access_points = self._access_points = [index[name] for name in options.access_points]
        if options.access_points:
            phases_ns = {
                index[name]: int(RandomStream(self._seed, name, "beacon").draw(0) * BEACON_INTERVAL_NS)
                for name in options.access_points
            } | {
                robot: int(RandomStream(self._seed, channel.names[robot], "beacon monitor").draw(0) * MONITOR_NS)
                for robot in self.robots
            }
            first = next(iter(self.antennas.values()))
            delivery.handler = self.roaming = Roaming(
                channel,
                exchange.events,
                delivery,
                options.roaming,
                phases_ns,
                high_throughput=first.phy is not None or first.standard == "802.11n",
            )
        if options.neighbours:
            duties = {index[name]: neighbour.duty for name, neighbour in options.neighbours.items()}
            # The scheduled events keep a reference to the object.
            NeighbourTraffic(self._seed, channel.band, exchange.events, delivery, duties=duties, names=channel.names)
        if channel.band is BAND_2_4:
            self._ovens = [
                MicrowaveOven(
                    self._seed,
                    Emitter(_OVEN + name, self._position_m(oven.at_m, oven.height), float(oven.power_dbm)),
                    float(oven.mains_hz),
                    exchange.events,
                    self._on_oven,
                )
                for name, oven in options.microwave_ovens.items()
            ]

    def jam(self, now_ns: int, emitters: Iterable[Emitter]) -> None:
        """Set the jammers that send noise until the next call."""
        self._jammers = {_JAMMER + emitter.name: self._emission(now_ns, emitter) for emitter in emitters}
        self._set_emissions(now_ns)

    @staticmethod
    def log_packet(log: Callable[[TransmissionAttempt], None], attempt: TransmissionAttempt) -> None:
        """Pass an attempt to `log`, unless its frame is a management frame or a frame of a neighbour."""
        if not isinstance(attempt.payload, ManagementFrame):
            log(attempt)

    def use_power_save(self) -> None:
        """Make the access points buffer packets for robots with power save."""
        power_save = self._exchange.delivery.power_save
        if power_save is not None and self.roaming is not None:
            power_save.access_points = self._access_points

    @property
    def linked_names(self) -> Sequence[str]:
        """Names of robots and access points, which have links."""
        neighbours = self._options.neighbours
        return [name for name in self.antennas if name not in neighbours]

    def _on_oven(self, now_ns: int, oven: MicrowaveOven, until_ns: int | None) -> None:
        self._set_emissions(now_ns)
        meter = self._exchange.meter
        if meter is not None and until_ns is not None:
            powers_mw = self._channel.received_mw(oven.emitter.position_m, oven.emitter.power_dbm)
            threshold_mw = milliwatt(ENERGY_DETECTION_DBM)
            meter.on_busy(now_ns, until_ns, [index for index in self.robots if powers_mw[index] >= threshold_mw])

    def _set_emissions(self, now_ns: int) -> None:
        ovens = {oven.emitter.name: self._emission(now_ns, oven.emitter) for oven in self._ovens if oven.is_on}
        self._exchange.reception.set_emissions(now_ns, {**self._jammers, **ovens})
        if not self._jammers and not ovens:
            for station in self._exchange.stations:
                self._exchange.retry_when_idle(now_ns, station)

    def _emission(self, now_ns: int, emitter: Emitter) -> Emission:
        return Emission(now_ns, self._channel.received_mw(emitter.position_m, emitter.power_dbm))

    def _position_m(self, at_m: Place, height_m: float) -> Vector:
        return station_place_m(at_m, height_m, self._world)
