"""Sources of interference: transmitters of neighbouring networks, and microwave ovens."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.radio.infrastructure.managed_delivery import ManagedDelivery, ManagementFrame
from sim_backends.radio.mac.channel import Emitter
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.phy.modes import Band, basic_mode

NEIGHBOUR: Final = "neighbour"

_FRAME_BYTES: Final = 1536
"""Size of an Ethernet payload with MAC header and FCS."""
_MAX_WAITING: Final = 10
"""Maximum number of frames that a neighbour queues; it discards further frames."""


class NeighbourTraffic:
    """Frames of neighbouring networks, which arrive at random (a Poisson process) at their transmitters.

    Args:
        seed: Seed of the arrivals.
        band: Band of the channel.
        events: Scheduled events.
        delivery: Sends the frames.
        duties: Share of the time in which each transmitter sends if it never waits, by index.
        names: Names of all stations.
    """

    def __init__(
        self,
        seed: int,
        band: Band,
        events: EventQueue,
        delivery: ManagedDelivery[Any],
        *,
        duties: Mapping[int, float],
        names: Sequence[str],
    ) -> None:
        self._events = events
        self._delivery = delivery
        airtime_ns = basic_mode(band).airtime_ns(_FRAME_BYTES)
        self._mean_ns = {index: airtime_ns / duty for index, duty in duties.items()}
        self._draws = {index: RandomStream(seed, names[index], NEIGHBOUR) for index in duties}
        for index in duties:
            self._schedule(0, index, 0)

    def _schedule(self, now_ns: int, index: int, number: int) -> None:
        wait_ns = -self._mean_ns[index] * math.log(1 - self._draws[index].draw(number))
        self._events.schedule(now_ns + max(round(wait_ns), 1), self._send, index, number)

    def _send(self, now_ns: int, index: int, number: int) -> None:
        if self._delivery.count_waiting_management(index) < _MAX_WAITING:
            self._delivery.send_management(now_ns, index, None, ManagementFrame(NEIGHBOUR), _FRAME_BYTES)
        self._schedule(now_ns, index, number + 1)


class MicrowaveOven:
    """A microwave oven, which sends noise in one half of each mains cycle.

    Args:
        seed: Seed of the phase of the mains.
        emitter: Name and position of the oven, and its power in the channel.
        mains_hz: Frequency of the mains.
        events: Scheduled events.
        switch: Called when the noise starts or ends, with the time, the oven, and the end of the noise (None if the
            noise ends now).

    Attributes:
        is_on: True while it sends noise.
    """

    def __init__(
        self,
        seed: int,
        emitter: Emitter,
        mains_hz: float,
        events: EventQueue,
        switch: "Callable[[int, MicrowaveOven, int | None], None]",
    ) -> None:
        self.emitter = emitter
        self.is_on = False
        self._half_ns = round(0.5e9 / mains_hz)
        self._events = events
        self._switch = switch
        events.schedule(int(RandomStream(seed, emitter.name, "mains").draw(0) * 2 * self._half_ns), self._turn_on)

    def _turn_on(self, now_ns: int) -> None:
        self.is_on = True
        self._events.schedule(now_ns + self._half_ns, self._turn_off)
        self._switch(now_ns, self, now_ns + self._half_ns)

    def _turn_off(self, now_ns: int) -> None:
        self.is_on = False
        self._events.schedule(now_ns + self._half_ns, self._turn_on)
        self._switch(now_ns, self, None)
