"""What carries packets between stations: Wi-Fi in a world, or fixed links, behind one interface."""

from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar

from sim_backends.radio.airspace import Airspace, Antenna, Velocity
from sim_backends.radio.delay import Delay
from sim_backends.radio.engine import Delivery, Engine
from sim_backends.radio.frames import Attempt
from sim_backends.radio.links import mesh
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.parameters import LinkCounters, Pair, Position
from sim_backends.radio.wifi import Wifi
from sim_backends.world.world import World

Payload = TypeVar("Payload")


class Ether(Protocol[Payload]):
    """Packets in, packets out, at the nanosecond the models say; the caller brings the time, and never an earlier."""

    def place(
        self,
        now_ns: int,
        places_m: Mapping[str, Position],
        relay: str | None,
        velocities_m_s: Mapping[str, Velocity] | None = None,
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
        before: Delay = 0,
    ) -> None:
        """Send a packet at `now_ns`; `destination` None is everyone, `before` what it was delayed by until now.

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

    def tell(self, log: Callable[[Attempt], None] | None) -> None:
        """Tell `log` of every transmission attempt that ends from now on, or nobody; fixed links make none."""
        ...


class FixedLinks(Engine[Payload]):
    """Links that do the same wherever stations stand.

    Args:
        seed: Of all random draws.
        options: What every link does.
    """

    def __init__(self, seed: int, options: RadioOptions) -> None:
        super().__init__(seed)
        self._options = options

    def place(
        self,
        now_ns: int,  # noqa: ARG002 (see Ether)
        places_m: Mapping[str, Position],
        relay: str | None,
        velocities_m_s: Mapping[str, Velocity] | None = None,  # noqa: ARG002
    ) -> None:
        """See `Ether.place`."""
        self.connect(mesh(self._options, places_m), relay)

    def tell(self, log: Callable[[Attempt], None] | None) -> None:
        """See `Ether.tell`."""


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
        self._space = Airspace(seed, antennas, options, world)
        super().__init__(self._space, seed, queue_packets=options.queue_packets)

    def place(
        self,
        now_ns: int,
        places_m: Mapping[str, Position],
        relay: str | None,
        velocities_m_s: Mapping[str, Velocity] | None = None,
    ) -> None:
        """See `Ether.place`."""
        self.advance(now_ns)
        self._space.move(now_ns, places_m, velocities_m_s)
        self.relay(relay)
