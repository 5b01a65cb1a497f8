"""What stations make of frames on the air: carrier sense, whose preamble they follow, what they decode."""

from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

from sim_backends.radio.air import PREAMBLE_SNR_DB, OnAir, decibel, success
from sim_backends.radio.channel import Channel
from sim_backends.radio.contention import BLIND_NS
from sim_backends.radio.draws import Counter
from sim_backends.radio.modes import BASIC, DIFS_NS, SIFS_NS, ack_ns
from sim_backends.radio.stations import Station

Payload = TypeVar("Payload")

_EIFS_EXTRA_NS: Final = SIFS_NS + ack_ns(BASIC)


class Reception(Generic[Payload]):
    """The frames on one channel, and the ears of all stations.

    Args:
        channel: How they hear each other.
        seed: Of the draws that decide what is decoded.
        stations: By index.
        contend: Called with the time and a station that waits to send and must wait longer.
    """

    def __init__(
        self,
        channel: Channel,
        seed: int,
        stations: Sequence[Station[Payload]],
        contend: Callable[[int, Station[Payload]], None],
    ) -> None:
        self._channel = channel
        self._seed = seed
        self._stations = stations
        self._contend = contend
        self._on_air: list[OnAir] = []
        self._draws: dict[tuple[int, int, str], Counter] = {}

    def begin(self, air: OnAir, reserved_ns: int) -> None:
        """Put a frame on the air; who hears it keeps silent until `reserved_ns`."""
        station, now_ns, end_ns = self._stations[air.transmitter], air.start_ns, air.end_ns
        air.powers_mw = powers_mw = self._channel.powers_mw(air.transmitter, now_ns)
        before = self._on_air
        for other in before:
            other.others.append(air)
        air.others.extend(before)
        if station.following is not None:
            station.following.followed_by.discard(station.index)
            station.following = None
        station.sending_until_ns = end_ns
        station.contention.sent(end_ns)
        sensitivity_mw = self._channel.sensitivity_mw
        for hearer in self._stations:
            index = hearer.index
            if powers_mw[index] < sensitivity_mw[index] or hearer is station:
                continue
            if hearer.following is None and hearer.sending_until_ns <= now_ns and self._detects(index, air):
                hearer.following = air
                air.followed_by.add(index)
            grant_ns = hearer.grant_ns
            if grant_ns is None:
                hearer.contention.sensed(now_ns, reserved_ns, waiting=False)
            elif grant_ns > now_ns + BLIND_NS:
                hearer.contention.sensed(now_ns, reserved_ns, waiting=True)
                self._contend(now_ns, hearer)
        before.append(air)

    def end(self, now_ns: int, air: OnAir) -> None:
        """Take a frame off the air; who heard it without understanding it waits for an ACK that it could not see."""
        self._on_air.remove(air)
        for index in air.followed_by:
            self._stations[index].following = None
        if air.others:
            until_ns = now_ns + _EIFS_EXTRA_NS + DIFS_NS
            for hearer in self._stations:
                index = hearer.index
                heard = air.powers_mw[index] >= self._channel.sensitivity_mw[index]
                if heard and index not in air.followed_by and hearer.sending_until_ns < now_ns:
                    hearer.contention.deferred(until_ns)
                    if hearer.grant_ns is not None:
                        self._contend(now_ns, hearer)
            air.others.clear()

    def decodes(self, index: int, air: OnAir, purpose: str) -> bool:
        """Return whether a station decodes a frame whose end has come; to be asked once, before `end`.

        Args:
            index: Of the station.
            air: The frame.
            purpose: Names the stream of draws: frames of data and ACKs have fates of their own.
        """
        if index not in air.followed_by:
            return False
        return self._fate(air.transmitter, index, purpose) < success(air, index, self._channel.noise_mw[index])

    def _detects(self, index: int, air: OnAir) -> bool:
        noise_mw = self._channel.noise_mw[index] + sum(other.powers_mw[index] for other in air.others)
        return decibel(air.powers_mw[index] / noise_mw) >= PREAMBLE_SNR_DB

    def _fate(self, transmitter: int, receiver: int, purpose: str) -> float:
        key = transmitter, receiver, purpose
        if key not in self._draws:
            names = self._channel.names
            self._draws[key] = Counter(self._seed, names[transmitter], names[receiver], purpose)
        return self._draws[key].draw()
