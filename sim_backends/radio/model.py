"""Radio models behind one interface: packets in, packets out, at the nanosecond that the model says."""

from collections.abc import Callable, Mapping, Sequence, Set
from itertools import product
from typing import Protocol

from fieldkit.core.model import LinkSample, Vector
from sim_backends.radio.delay import Delay, Delivery, Payload
from sim_backends.radio.frames import Emission, TransmissionAttempt
from sim_backends.radio.jamming import Emitter
from sim_backends.radio.links import LinkCounters, Pair
from sim_backends.radio.losses import LossLog
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.random_streams import PacketIdentity
from sim_backends.radio.wifi import Wifi
from sim_backends.radio.world_channel import Antenna, WorldChannel
from sim_backends.world.world import World


class RadioModel(Protocol[Payload]):
    """Packets in, packets out, at the nanosecond the models say; the caller brings the time, and never an earlier."""

    def place(
        self,
        now_ns: int,
        places_m: Mapping[str, Vector],
        relay: str | None,
        velocities_m_s: Mapping[str, Vector] | None = None,
    ) -> None:
        """Let stations be where they are now; those without a place are out of everybody's range.

        Args:
            now_ns: Now.
            places_m: Metres east, north, up.
            relay: Whose access point relays between the others; None for direct links.
            velocities_m_s: How they move; None for standing.
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
    ) -> None:
        """Send a packet at `now_ns`.

        Args:
            now_ns: Now.
            source: Who sends it.
            payload: What it carries.
            size_bytes: Its size, without MAC header.
            destination: To whom; None is everyone.
            packet: What the draws that decide over it are keyed by; None for the packets of a source as they come.
            before: What it was delayed by until now.

        Raises:
            KeyError: There is no way from `source` towards `destination`.
        """
        ...

    def next_event_ns(self) -> int | None:
        """Return when `deliveries` has something to do next, None when nothing is under way."""
        ...

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return what arrived up to `now_ns` and was not returned before, in order of arrival."""
        ...

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return what happened on each link so far."""
        ...

    def use_meter(self) -> None:
        """Count from now on what drivers of radios count, for `sample`."""
        ...

    def sample(self, now_ns: int, utc_ns: int) -> dict[str, LinkSample]:
        """Return what each station's driver tells at `now_ns` of its links since `use_meter`; `utc_ns` is noted."""
        ...

    def log_losses(self, log: LossLog | None) -> None:
        """Hand `log` every loss from now on, or nobody."""
        ...

    def disturb(self, now_ns: int, off: Set[str], cut: Set[Pair]) -> None:
        """Let the radios of these stations be off from now on, and these links be cut, but no others.

        Args:
            now_ns: Now.
            off: Whose radio is off. What waits at one that was on is lost.
            cut: Who is out of each other's range wherever they are; a pair stands for both directions.
        """
        ...

    def jam(self, now_ns: int, emitters: Sequence[Emitter]) -> None:
        """Let nobody but these send noise from now on.

        Raises:
            ConfigurationError: There are some, and the model knows no noise.
        """
        ...

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Hand `log` every transmission attempt that ends from now on, or nobody; fixed links make none."""
        ...


class WifiInWorld(Wifi[Payload]):
    """Wi-Fi stations in a world.

    Args:
        seed: Of all random draws.
        options: What the air does.
        antennas: The stations.
        world: What stands between them; None for open ground.
    """

    def __init__(
        self, seed: int, options: RadioOptions, antennas: Mapping[str, Antenna], world: World | None
    ) -> None:
        self._world_channel = WorldChannel(seed, antennas, options, world)
        self._names = tuple(antennas)
        super().__init__(self._world_channel, seed, queue_packets=options.queue_packets)

    def place(
        self,
        now_ns: int,
        places_m: Mapping[str, Vector],
        relay: str | None,
        velocities_m_s: Mapping[str, Vector] | None = None,
    ) -> None:
        """See `RadioModel.place`."""
        self.advance(now_ns)
        self._world_channel.move(now_ns, places_m, velocities_m_s)
        self.relay(relay)

    def disturb(self, now_ns: int, off: Set[str], cut: Set[Pair]) -> None:
        """See `RadioModel.disturb`."""
        self.switch_off(now_ns, off)
        self._world_channel.cut([*cut, *product(off, self._names)])

    def jam(self, now_ns: int, emitters: Sequence[Emitter]) -> None:
        """See `RadioModel.jam`."""
        heard_mw = self._world_channel.heard_mw
        self.hear(
            now_ns,
            {emitter.name: Emission(now_ns, heard_mw(emitter.place_m, emitter.power_dbm)) for emitter in emitters},
        )
