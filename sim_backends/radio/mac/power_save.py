"""Power save of stations of an access point (IEEE 802.11-2020, 11.2.3), as a delay of the frames to them.

A station dozes when it has sent and received nothing for a time. The access point buffers frames for it until the
next beacon, which wakes the station. A frame from the station also ends its doze, and the access point then sends the
buffered frames immediately: pings to a Raspberry Pi are slow, pings from it are not. If any station uses power save,
broadcasts wait for the next beacon with a DTIM, after which all stations listen. Beacons, null frames and PS-Polls
take no airtime here, every beacon is received, and a station wakes up in no time.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final, Generic

from sim_backends.radio.core.links import Payload
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.mac.frames import Frame
from sim_backends.radio.mac.stations import Station

BEACON_INTERVAL_NS: Final = 102_400_000
"""100 time units of 1.024 ms: the default of access points."""

DTIM_PERIOD: Final = 2
"""Every second beacon has a DTIM: the default of hostapd."""

Release = Callable[[int, Station[Payload], Frame[Payload]], None]
"""Called with the time, the transmitter and a frame that the transmitter may send now."""


class PowerSave(Generic[Payload]):
    """The dozing stations, and the frames that the access point buffers for them.

    Args:
        timeouts_ns: Time from the last frame until a station dozes, by index of the station; others never doze.
        beacon_phase_ns: Time of the first beacon with a DTIM.
        events: Scheduled events.
        release: Queues a frame at its transmitter.

    Attributes:
        access_points: Indices of the stations that buffer frames; none if stations send directly to each other.
    """

    def __init__(
        self,
        timeouts_ns: Mapping[int, int],
        beacon_phase_ns: int,
        events: EventQueue,
        release: Release[Payload],
    ) -> None:
        self._timeouts_ns = timeouts_ns
        self._phase_ns = beacon_phase_ns
        self._events = events
        self._release = release
        self._awake_until_ns = dict.fromkeys(timeouts_ns, 0)
        # Buffered frames, each with its transmitter, by receiver; None for broadcasts.
        self._buffers: dict[int | None, list[tuple[Station[Payload], Frame[Payload]]]] = {}
        self.access_points: Collection[int] = ()

    def buffer(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> bool:
        """Buffer a frame if its transmitter must not send it yet; return False if the frame may be sent now."""
        if not self.access_points:
            return False
        if station.index not in self.access_points:
            self._wake(now_ns, station.index)
            return False
        receiver = frame.receiver
        # A station without a timeout is always awake.
        if receiver is not None and now_ns < self._awake_until_ns.get(receiver, now_ns + 1):
            self._wake(now_ns, receiver)
            return False
        buffered = self._buffers.setdefault(receiver, [])
        buffered.append((station, frame))
        if len(buffered) == 1:
            self._events.schedule(
                self._beacon_ns(now_ns, DTIM_PERIOD if receiver is None else 1), self._on_beacon, receiver
            )
        return True

    def discard(self, station: Station[Payload]) -> Sequence[Frame[Payload]]:
        """Remove and return the frames that a station has buffered."""
        frames = [frame for buffered in self._buffers.values() for holder, frame in buffered if holder is station]
        for receiver, buffered in self._buffers.items():
            self._buffers[receiver] = [entry for entry in buffered if entry[0] is not station]
        return frames

    def withdraw(self, receiver: int) -> Sequence[tuple[Station[Payload], Frame[Payload]]]:
        """Remove and return the frames that are buffered for a station, each with its transmitter."""
        return self._buffers.pop(receiver, [])

    def _beacon_ns(self, now_ns: int, period: int) -> int:
        interval_ns = period * BEACON_INTERVAL_NS
        return now_ns + (self._phase_ns - now_ns) % interval_ns

    def _on_beacon(self, now_ns: int, receiver: int | None) -> None:
        if receiver is None:
            self._flush(now_ns, None)
        elif self._buffers.get(receiver):
            self._wake(now_ns, receiver)

    def _wake(self, now_ns: int, index: int) -> None:
        timeout_ns = self._timeouts_ns.get(index)
        if timeout_ns is not None:
            self._awake_until_ns[index] = now_ns + timeout_ns
            if self._buffers.get(index):
                self._flush(now_ns, index)

    def _flush(self, now_ns: int, receiver: int | None) -> None:
        for station, frame in self._buffers.pop(receiver, []):
            self._release(now_ns, station, frame)
